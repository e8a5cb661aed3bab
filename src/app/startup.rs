//! Determines the initial state from the checkpoint.

use std::{
    path::{Path, PathBuf},
    time::Duration,
};

use checkpoint_store::{Loaded, OpenError, Store, folder, history};
use rescue_core::checkpoint::{
    format::{PendingWrite, Session},
    session::{self, Decision, Rebuilt, SessionEvidence},
};
use ros1_master::master::{Displaced, Master};

use super::{RunError, life};
use crate::{clock, config::Config, guardian::handover, process, wait};

/// How long the disk may take to open the checkpoint. Calls wait during this time.
const OPENING: Duration = Duration::from_secs(20);

/// The state that rosrescue starts with.
pub(super) struct Beginning {
    pub(super) mirror: Master,
    pub(super) session: Session,
    /// Recorded writes that the session's last master may not have run.
    pub(super) pending: Vec<PendingWrite>,
    /// Replaced nodes that may still need a `shutdown`.
    pub(super) displaced: Vec<Displaced>,
    /// The store, to which no checkpoint has been written yet.
    pub(super) store: Option<Store>,
    pub(super) restored: bool,
    /// Whether the session continues after its last process died, without a reboot of this computer.
    pub(super) died: bool,
    /// What happened at the start, for the operator.
    pub(super) story: String,
}

/// Reads the checkpoint and decides whether its session continues.
pub(super) async fn begin(config: &Config) -> Result<Beginning, RunError> {
    let (mut store, loaded) = open(config).await?;
    let boot_id = process::boot_id();
    let mut story = "a new session begins".to_owned();
    let mut beginning = None;
    let mut master_uri = None;
    let mut died = false;
    let mut token = (String::new(), 0);
    if let Some(loaded) = loaded {
        for sentence in loaded.torn.iter() {
            tracing::info!("checkpoint: {sentence}");
        }
        for sentence in &loaded.damage {
            tracing::error!("the checkpoint is damaged: {sentence}");
        }
        let Rebuilt {
            mirror,
            session,
            pending,
            displaced,
            trouble,
        } = session::rebuild(loaded.checkpoint, loaded.records);
        if let Some(trouble) = trouble {
            tracing::error!(
                "the checkpoint is damaged: its snapshot is not a valid master state: {trouble}"
            );
        }
        let session = session.unwrap_or_default();
        let same_boot = session.boot_id == boot_id;
        died = same_boot && !session.closed;
        let mut evidence = SessionEvidence {
            same_boot,
            closed: session.closed,
            node_alive: false,
            restarted: handover::continues(),
        };
        if session::depends_on_nodes(config.restore, evidence) {
            evidence.node_alive = life::any_alive(&mirror, same_boot).await;
        }
        match session::decide(config.restore, evidence) {
            Decision::Restore(why) => {
                story = format!("the session continues ({why}): {}", mirror.counts());
                beginning = Some((mirror, session, pending, displaced));
            }
            Decision::Fresh(why) => {
                // A crashed rosrescue may have left its master running. That master is adopted.
                master_uri = session.master_uri.filter(|_| !session.closed);
                // The new session keeps this token and counts on, so that its masters show that a copy of the old
                // checkpoint is older.
                token = (session.mark, session.incarnation);
                let kept;
                (store, kept) = set_aside(store).await;
                let kept = kept
                    .map(|path| format!("; the previous checkpoint is kept as {}", path.display()));
                let kept = kept.unwrap_or_default();
                story = format!("a new session begins ({why}{kept})");
            }
        }
    }
    if let Some(store) = &store {
        let (path, most) = (store.path().to_owned(), config.checkpoint_bytes());
        crate::task::spawn_blocking(move || {
            if let Err(error) = history::trim(&path, most) {
                tracing::debug!(%error, "cannot list the kept checkpoints");
            }
        });
    }
    let restored = beginning.is_some();
    let died = restored && died;
    let (mirror, mut session, pending, displaced) = beginning.unwrap_or_default();
    if !restored || session.mark.is_empty() {
        session.master_uri = master_uri;
        session.id = process::new_id();
        (session.mark, session.incarnation) = token;
        if session.mark.is_empty() {
            session.mark.clone_from(&session.id);
        }
        session.started = clock::wall_text(clock::wall_time());
    }
    session.boot_id = boot_id;
    session.port = config.advertised.port;
    session.closed = false;
    Ok(Beginning {
        mirror,
        session,
        pending,
        displaced,
        store,
        restored,
        died,
        story,
    })
}

/// Opens the checkpoint and reads what it holds. Without a store, the state will not be recorded.
async fn open(config: &Config) -> Result<(Option<Store>, Option<Loaded>), RunError> {
    let own = config.clone();
    let opened = wait::within(OPENING, move || {
        let path = &own.checkpoint;
        let found = Folder::inspect(path);
        let mut opened = Store::open(path);
        if let Ok((store, _)) = &mut opened {
            store.keep_log(own.log_bytes());
        }
        found.report(opened.is_ok());
        opened.map_err(|error| {
            (
                checkpoint_store::read(path).ok().flatten().map(Box::new),
                error,
            )
        })
    });
    match opened.await {
        Some(Ok((store, loaded))) => Ok((Some(store), loaded)),
        Some(Err((loaded, error @ OpenError::Io { .. }))) => {
            // Continue without a checkpoint: a robot with a broken disk still needs its master.
            tracing::error!(
                %error,
                "unprotected: the checkpoint cannot be used; nodes run as usual, but a crash of \
                 rosrescue itself would lose the state. Choose another place with --checkpoint, or \
                 repair this one"
            );
            Ok((None, loaded.map(|loaded| *loaded)))
        }
        Some(Err((_, error))) => Err(RunError::Checkpoint(error)),
        None => {
            log_silent_disk(&config.checkpoint);
            Ok((None, None))
        }
    }
}

fn log_silent_disk(checkpoint: &Path) {
    tracing::error!(
        checkpoint = %checkpoint.display(),
        "unprotected: the disk has not opened the checkpoint within {OPENING:?}; starting without it, and \
         recording begins when the disk answers"
    );
}

/// Keeps the previous session's checkpoint under another name, and returns that name. The store is `None` if the disk
/// does not answer.
async fn set_aside(store: Option<Store>) -> (Option<Store>, Option<PathBuf>) {
    let Some(mut store) = store else {
        return (None, None);
    };
    let path = store.path().to_owned();
    let work = move || {
        let kept = store.set_aside("session");
        (store, kept)
    };
    match wait::within(OPENING, work).await {
        Some((store, Ok(kept))) => (Some(store), kept),
        Some((store, Err(error))) => {
            tracing::error!(%error, "could not keep the previous session's checkpoint under another name");
            (Some(store), None)
        }
        None => {
            log_silent_disk(&path);
            (None, None)
        }
    }
}

/// Problems of the checkpoint's folder.
struct Folder<'a> {
    checkpoint: &'a Path,
    is_missing: bool,
}

impl<'a> Folder<'a> {
    fn inspect(checkpoint: &'a Path) -> Self {
        let folder = checkpoint
            .parent()
            .filter(|folder| !folder.as_os_str().is_empty());
        Self {
            checkpoint,
            is_missing: folder.is_some_and(|folder| !folder.exists()),
        }
    }

    /// Logs the problems. `is_open` says whether the checkpoint could be opened.
    fn report(&self, is_open: bool) {
        let checkpoint = self.checkpoint.display();
        if self.is_missing && is_open {
            tracing::warn!(
                %checkpoint,
                "the checkpoint's folder did not exist and was created; if it is not the right one, correct \
                 --checkpoint"
            );
        }
        if let Some((folder, why)) = folder::open_to_others(self.checkpoint) {
            tracing::warn!(
                %checkpoint,
                "other users may change the robot's state in {}: {why}; choose another folder with --checkpoint",
                folder.display()
            );
        }
    }
}
