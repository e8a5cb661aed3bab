//! Finds and reads checkpoints. It locks and writes nothing, so it works beside a running rosrescue.

use std::{
    fs,
    io::{self, IsTerminal},
    os::unix::fs::MetadataExt,
    path::{Path, PathBuf},
};

use checkpoint_store::{
    OpenError,
    change_log::{KnownTimes, NoPast, PastState, past_state},
    history,
};
use rescue_core::checkpoint::{
    format::{RecordContent, Session},
    session,
};
use ros1_master::master::{Master, Request};
use rustix::{fs::Access, io::Errno};

use super::{
    CommandFailure, eprint_line, note,
    running::{Running, is_here},
};
use crate::{
    cli::{CheckpointArgs, ReadArgs, TargetArgs, When},
    clock, config,
    ros_env::DEFAULT_MASTER_PORT,
    status::summary::size,
};

/// Size of a file that takes about a second to read, in bytes.
const LARGE: u64 = 16 << 20;

/// A checkpoint that was read from disk.
pub(super) struct Opened {
    pub(super) path: PathBuf,
    pub(super) bytes: u64,
    /// Wall time of the last change, in seconds since 1970.
    pub(super) written: f64,
    /// Number of the last record that the snapshot includes. `None` if there is no complete snapshot.
    pub(super) snapshot_seq: Option<u64>,
    /// Methods of the calls in the journal; `session` for a change of the session.
    pub(super) journal: Vec<String>,
    pub(super) session: Session,
    pub(super) state: Master,
    pub(super) pending: Vec<Request>,
    /// Whether `state` holds everything that was recorded.
    pub(super) exact: bool,
    pub(super) torn: Option<String>,
    pub(super) damage: Vec<String>,
}

impl Opened {
    /// Describes a state of the log by its time and checkpoint.
    pub(super) fn moment(&self) -> String {
        let (time, path) = (clock::wall_text(self.written), self.path.display());
        format!("the state of {time}, from {path}")
    }
}

/// The path of the checkpoint in use, with links resolved.
pub(super) async fn present(checkpoint: &CheckpointArgs) -> PathBuf {
    let env = |name: &str| std::env::var(name).ok();
    let running = match checkpoint.checkpoint {
        None => checkpoint_of_running().await,
        Some(_) => None,
    };
    let path = running.unwrap_or_else(|| {
        let target = Running::find(&target());
        let port = target.map_or(DEFAULT_MASTER_PORT, |running| running.address.port);
        config::checkpoint_path(checkpoint.checkpoint.as_deref(), port, &env)
    });
    fs::canonicalize(&path).unwrap_or(path)
}

/// The rosrescue that `ROSRESCUE_URI` names, or else the default one.
fn target() -> TargetArgs {
    TargetArgs {
        uri: std::env::var("ROSRESCUE_URI").ok(),
    }
}

/// The checkpoint of the rosrescue that runs on this computer. Asks rosrescue, because a service may run as another
/// user, whose home folder is another one.
async fn checkpoint_of_running() -> Option<PathBuf> {
    let running = Running::find(&target()).ok()?;
    if !is_here(&running.address).await {
        return None;
    }
    Some(running.status().await.ok()?.checkpoint.into())
}

/// Refuses a checkpoint in use that this user may not read. Otherwise what is kept beside it would seem not to exist.
pub(super) fn require_access(present: &Path) -> Result<(), CommandFailure> {
    match rustix::fs::access(present, Access::READ_OK) {
        Err(Errno::ACCESS) => Err(CommandFailure::Usage(format!(
            "cannot read `{}`: {}. Run this as the user of rosrescue, or with sudo",
            present.display(),
            io::Error::from(Errno::ACCESS)
        ))),
        _ => Ok(()),
    }
}

/// The checkpoint that `file` stands for: a path, or a name or number from the history.
pub(super) async fn find(
    file: &Path,
    checkpoint: &CheckpointArgs,
) -> Result<PathBuf, CommandFailure> {
    match fs::canonicalize(file) {
        Ok(path) => return Ok(path),
        Err(error) if error.kind() == io::ErrorKind::NotFound => {}
        Err(error) => {
            let why = format!("cannot read `{}`: {error}", file.display());
            return Err(CommandFailure::Usage(why));
        }
    }
    let present = present(checkpoint).await;
    require_access(&present)?;
    let listed = list(&present);
    let wanted = file.to_string_lossy();
    let named = |(number, kept): (usize, &Listed)| {
        let is_meant = kept.name == wanted || (number + 1).to_string() == wanted;
        is_meant.then(|| kept.path.clone())
    };
    listed.iter().enumerate().find_map(named).ok_or_else(|| {
        CommandFailure::Usage(format!(
            "there is no file `{wanted}`, and no checkpoint with that name or number beside `{}`. `rosrescue history` \
             lists the checkpoints",
            present.display()
        ))
    })
}

/// An entry of the history.
pub(super) struct Listed {
    /// The entry's name, such as `present`, `session-3` or `rescue-7`.
    pub(super) name: String,
    pub(super) path: PathBuf,
    pub(super) written: i64,
}

/// The checkpoint at `present` and those kept beside it, newest first.
pub(super) fn list(present: &Path) -> Vec<Listed> {
    let mut listed: Vec<_> = history::newest_first(present)
        .unwrap_or_default()
        .into_iter()
        .map(|kept| Listed {
            name: format!("{}-{}", kept.kind.name(), kept.number),
            path: kept.path,
            written: kept.written,
        })
        .collect();
    if let Ok(metadata) = fs::metadata(present) {
        let first = Listed {
            name: "present".to_owned(),
            path: present.to_owned(),
            written: metadata.mtime(),
        };
        listed.insert(0, first);
    }
    listed
}

/// Reads the checkpoint at `path`, damaged or not.
pub(super) fn open(path: &Path) -> Result<Opened, CommandFailure> {
    let shown = path.display();
    let metadata = fs::metadata(path)
        .map_err(|error| CommandFailure::Usage(format!("cannot read `{shown}`: {error}")))?;
    if metadata.is_dir() {
        let why = format!("`{shown}` is a folder: give the checkpoint file in it");
        return Err(CommandFailure::Usage(why));
    }
    if metadata.len() > LARGE && io::stderr().is_terminal() {
        eprint_line(&format!("reading `{shown}`, {} …", size(metadata.len())));
    }
    let loaded = checkpoint_store::read(path).map_err(|error| {
        CommandFailure::Usage(match error {
            OpenError::NotACheckpoint { .. } => format!("`{shown}` is not a rosrescue checkpoint"),
            OpenError::OtherVersion { version, .. } => format!(
                "`{shown}` has checkpoint format {version} of another version of rosrescue: use that one"
            ),
            other => other.without_advice(),
        })
    })?;
    let gone = || CommandFailure::Usage(format!("there is no file `{shown}` any more"));
    let loaded = loaded.ok_or_else(gone)?;
    let snapshot_seq = loaded.checkpoint.as_ref().map(|checkpoint| checkpoint.seq);
    let entries = loaded.records.iter().map(|record| match &record.entry {
        RecordContent::Call { call, .. } => call.method().name().to_owned(),
        RecordContent::Session(_) => "session".to_owned(),
    });
    let journal = entries.collect();
    let mut damage = loaded.damage;
    let rebuilt = session::rebuild(loaded.checkpoint, loaded.records);
    let exact = loaded.exact && rebuilt.trouble.is_none();
    damage.extend(rebuilt.trouble.map(not_valid));
    Ok(Opened {
        path: path.to_owned(),
        bytes: metadata.len(),
        written: metadata.mtime() as f64,
        snapshot_seq,
        journal,
        session: rebuilt.session.unwrap_or_default(),
        state: rebuilt.mirror,
        pending: rebuilt
            .pending
            .into_iter()
            .map(|write| write.call)
            .collect(),
        exact,
        torn: loaded.torn,
        damage,
    })
}

/// The state of the checkpoint in use at an earlier time, rebuilt from the log of changes. `now` stands for its end,
/// whatever the clock shows.
pub(super) async fn read_at(at: When, args: &ReadArgs) -> Result<Opened, CommandFailure> {
    let path = present(&args.checkpoint).await;
    let time = match at {
        When::Now => u64::MAX,
        at => at.millis(clock::wall_millis()),
    };
    let shown = path.display();
    match past_state(&path, time, &mut KnownTimes::default()) {
        Ok(past) => opened_at(past, args),
        Err(NoPast::Folder(error)) => Err(CommandFailure::Usage(format!(
            "cannot read the log beside `{shown}`: {error}"
        ))),
        Err(NoPast::Later(unread)) => {
            for sentence in unread {
                note(&sentence);
            }
            let time = clock::wall_text_millis(time.min(clock::wall_millis()));
            Err(CommandFailure::Usage(format!(
                "`{shown}` and the log beside it have no state of {time} or earlier. `rosrescue log -n 0` shows the \
                 oldest one"
            )))
        }
    }
}

fn opened_at(past: PastState, args: &ReadArgs) -> Result<Opened, CommandFailure> {
    let PastState { path, moment, .. } = past;
    if past.is_set_back {
        note(&format!(
            "the clock was set back: changes after record {} have this time or an earlier one, and are not shown. \
             `rosrescue log` lists them in their order",
            moment.seq
        ));
    }
    let rebuilt = moment.rebuilt;
    let mut damage = past.unread;
    if !moment.exact {
        damage.push(format!(
            "`{}` lacks records before that time",
            path.display()
        ));
    }
    damage.extend(rebuilt.trouble.map(not_valid));
    if let Some(first) = damage.first().filter(|_| !args.damaged) {
        return Err(CommandFailure::Usage(format!(
            "the log is damaged: {first}. --damaged uses the readable part"
        )));
    }
    for sentence in &damage {
        note(sentence);
    }
    Ok(Opened {
        path,
        bytes: past.bytes,
        written: moment.at as f64 / 1e3,
        snapshot_seq: Some(moment.snapshot_seq),
        journal: moment.journal,
        session: rebuilt.session.unwrap_or_default(),
        state: rebuilt.mirror,
        pending: rebuilt
            .pending
            .into_iter()
            .map(|write| write.call)
            .collect(),
        exact: damage.is_empty(),
        torn: None,
        damage,
    })
}

fn not_valid(why: String) -> String {
    format!("the snapshot is not a valid master state: {why}")
}

/// Reads the state at a time, if there is one, or else the checkpoint that `file` stands for.
pub(super) async fn read_either(
    file: Option<&Path>,
    at: Option<When>,
    args: &ReadArgs,
) -> Result<Opened, CommandFailure> {
    match (file, at) {
        (_, Some(at)) => read_at(at, args).await,
        (Some(file), None) => read(file, args).await,
        (None, None) => read(&present(&args.checkpoint).await, args).await,
    }
}

/// Reads the checkpoint that `file` stands for. Refuses a damaged one without `--damaged`.
pub(super) async fn read(file: &Path, args: &ReadArgs) -> Result<Opened, CommandFailure> {
    let opened = open(&find(file, &args.checkpoint).await?)?;
    let path = opened.path.display();
    if !opened.exact && !args.damaged {
        let why = opened
            .damage
            .first()
            .map_or("records are missing", String::as_str);
        return Err(CommandFailure::Usage(format!(
            "`{path}` is damaged: {why}. `rosrescue verify` shows the readable part, and --damaged uses it"
        )));
    }
    for sentence in &opened.damage {
        note(sentence);
    }
    Ok(opened)
}
