//! Determines the initial state from the checkpoint.

use std::path::Path;

use super::{RunError, life};
use crate::{
    checkpoint::{
        format::Session,
        session::{self, Decision, Evidence, Rebuilt},
        store::{self, OpenError, Store, history},
    },
    clock,
    config::Config,
    master::{Master, Request},
};

/// The initial state.
pub(super) struct Beginning {
    pub(super) mirror: Master,
    pub(super) session: Session,
    /// Writes that the session's last master may not have run.
    pub(super) pending: Vec<Request>,
    /// Not begun yet.
    pub(super) store: Option<Store>,
    pub(super) restored: bool,
    /// In words, for the operator.
    pub(super) story: String,
}

/// Reads the checkpoint and decides whether its session continues.
pub(super) async fn begin(config: &Config) -> Result<Beginning, RunError> {
    let (mut store, loaded) = match Store::open(&config.checkpoint) {
        Ok((store, loaded)) => (Some(store), loaded),
        Err(error @ OpenError::Io { .. }) => {
            // A robot without a working disk still needs its master.
            tracing::error!(
                %error,
                "unprotected: the checkpoint cannot be used; nodes run as usual, but a crash of \
                 rosrescue itself would lose the state. Choose another place with --checkpoint, or \
                 repair this one"
            );
            (None, store::read(&config.checkpoint).ok().flatten())
        }
        Err(error) => return Err(RunError::Checkpoint(error)),
    };
    let boot_id = kernel_id("/proc/sys/kernel/random/boot_id");
    let mut story = "a new session begins".to_owned();
    let mut beginning = None;
    let mut master_uri = None;
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
            trouble,
        } = session::rebuild(loaded.checkpoint, loaded.records);
        if let Some(trouble) = trouble {
            tracing::error!(
                "the checkpoint is damaged: its snapshot is no state of a master: {trouble}"
            );
        }
        let session = session.unwrap_or_default();
        let same_boot = session.boot_id == boot_id;
        let mut evidence = Evidence {
            same_boot,
            closed: session.closed,
            node_alive: false,
        };
        if session::depends_on_nodes(config.restore, evidence) {
            evidence.node_alive = life::any_alive(&mirror, same_boot).await;
        }
        match session::decide(config.restore, evidence) {
            Decision::Restore(why) => {
                story = format!("the session goes on ({why}): {}", mirror.counts());
                beginning = Some((mirror, session, pending));
            }
            Decision::Fresh(why) => {
                // A master that a crashed rosrescue left running is taken over.
                master_uri = session.master_uri.filter(|_| !session.closed);
                let kept = store.as_mut().map(|store| store.set_aside("session"));
                let kept = match kept {
                    Some(Ok(Some(path))) => {
                        format!("; the checkpoint before is kept as {}", path.display())
                    }
                    Some(Err(error)) => {
                        tracing::error!(%error, "the checkpoint of the session before could not be kept under another name");
                        String::new()
                    }
                    _ => String::new(),
                };
                story = format!("a new session begins ({why}{kept})");
            }
        }
    }
    if let Some(store) = &store
        && let Err(error) = history::trim(store.path(), config.history)
    {
        tracing::debug!(%error, "the kept checkpoints cannot be listed");
    }
    let restored = beginning.is_some();
    let (mirror, mut session, pending) = beginning.unwrap_or_default();
    if !restored || session.mark.is_empty() {
        session.master_uri = master_uri;
        session.id = kernel_id("/proc/sys/kernel/random/uuid");
        session.mark = session.id.clone();
        session.started = clock::wall_text(clock::wall_time());
    }
    session.boot_id = boot_id;
    session.closed = false;
    Ok(Beginning {
        mirror,
        session,
        pending,
        store,
        restored,
        story,
    })
}

/// An id from the kernel, or a constant if there is none: it is compared, not trusted.
pub(super) fn kernel_id(path: impl AsRef<Path>) -> String {
    std::fs::read_to_string(path).map_or_else(|_| "unknown".to_owned(), |id| id.trim().to_owned())
}
