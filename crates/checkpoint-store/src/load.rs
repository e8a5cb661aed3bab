//! Loads a checkpoint from its present and its previous generation.

use std::io;
use std::path::Path;

use super::names::Names;
use super::{BROKEN, OpenError, Present, Storage, UNREADABLE};
use rescue_core::checkpoint::format::{
    self, Checkpoint, Damage, FormatError, Framed, Record, RecordContent, Session,
};

/// Maximum size of a file that is read. No checkpoint is larger.
pub(super) const FILE_BYTES_MAX: u64 = 1 << 30;

/// The content of a checkpoint, as it was found on disk.
#[derive(Debug, Default)]
pub struct Loaded {
    /// The newest complete snapshot. Without one, only `records` is left of the state.
    pub checkpoint: Option<Checkpoint>,
    /// The undamaged records after the snapshot, in order.
    pub records: Vec<Record>,
    /// Whether snapshot and records together are exactly the recorded state. If not, a part is missing.
    pub exact: bool,
    /// Describes an append that a crash cut short. No caller was told that this append had succeeded.
    pub torn: Option<String>,
    /// Describes any other damage, one sentence each, to be logged as errors.
    pub damage: Vec<String>,
}

impl Loaded {
    pub fn session(&self) -> Option<&Session> {
        let later = self
            .records
            .iter()
            .rev()
            .find_map(|record| match &record.entry {
                RecordContent::Session(session) => Some(&**session),
                RecordContent::Call { .. } => None,
            });
        later.or_else(|| Some(&self.checkpoint.as_ref()?.session))
    }
}

/// The content for [`Loaded`], and what the store needs to continue.
#[derive(Debug, Default)]
pub(super) struct LoadedStore {
    pub(super) loaded: Loaded,
    /// The highest record number known.
    pub(super) seq: u64,
    /// The highest known number of a generation (checkpoint file).
    pub(super) generation: u64,
    /// False if the present file may lack records of the previous generation, which it must not replace in that case.
    usable: bool,
    /// The present file, if it was readable.
    pub(super) present: Option<Present>,
    /// If the previous generation cannot be used: part of the name under which to keep it.
    pub(super) bad_previous: Option<&'static str>,
    /// The bytes of an incomplete append.
    pub(super) torn: Option<Vec<u8>>,
}

/// Reads the checkpoint of `names`. `None` if there is none.
pub(super) fn load(
    storage: &impl Storage,
    names: &Names,
) -> Result<Option<LoadedStore>, OpenError> {
    let path = &names.path;
    // The id is taken before reading. So a file that replaces this one later has another id, and is kept under another
    // name.
    let id = storage.id_at(path).ok().flatten();
    let bytes = match read(storage, names, path) {
        Ok(None) => return Ok(None),
        Ok(Some(bytes)) => Ok(bytes),
        Err(error) => Err(error),
    };
    let previous = read(storage, names, &names.previous());
    let mut bad_previous = previous.is_err().then_some(UNREADABLE);
    let previous = previous.ok().flatten();
    let previous = previous.as_deref().and_then(|bytes| {
        let scanned = format::scan(bytes);
        bad_previous = scanned.is_err().then_some(BROKEN);
        scanned.ok()
    });
    let mut found = match bytes {
        Ok(bytes) => {
            let mut found = load_present(names, &bytes, previous.as_ref())?;
            found.present = id.map(|id| Present {
                id,
                usable: found.usable,
            });
            found
        }
        Err(error) => {
            let whole = previous.filter(|previous| previous.checkpoint().is_ok());
            let Some(previous) = whole else {
                return Err(error);
            };
            let why = format!(
                "{}; it will be kept under another name",
                error.without_advice()
            );
            let nothing = Framed::unreadable(&[]);
            let mut found = join(names, &nothing, Err(why), Some(&previous), &[]);
            // The next generation must not reuse the number of the unreadable file's generation.
            found.generation += 1;
            found
        }
    };
    found.bad_previous = bad_previous;
    Ok(Some(found))
}

fn load_present(
    names: &Names,
    bytes: &[u8],
    previous: Option<&Framed<'_>>,
) -> Result<LoadedStore, OpenError> {
    let path = &names.path;
    let present = match (format::scan(bytes), previous) {
        (Ok(present), _) => present,
        (Err(FormatError::OtherVersion { version }), _) => {
            let path = path.clone();
            return Err(OpenError::OtherVersion { path, version });
        }
        // A valid previous generation shows that the damaged file was a checkpoint as well.
        (Err(FormatError::NotACheckpoint), Some(_)) => Framed::unreadable(bytes),
        (Err(FormatError::NotACheckpoint), None) => {
            return Err(OpenError::NotACheckpoint { path: path.clone() });
        }
    };
    let snapshot = present.checkpoint().map_err(|why| {
        let path = path.display();
        format!("the snapshot of `{path}` cannot be used: {why}")
    });
    Ok(join(names, &present, snapshot, previous, bytes))
}

fn read(storage: &impl Storage, names: &Names, path: &Path) -> Result<Option<Vec<u8>>, OpenError> {
    let failed = |source| OpenError::Io {
        doing: "read",
        path: path.to_owned(),
        source,
    };
    match names.read(storage, path) {
        Ok(bytes) => Ok(Some(bytes)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(failed(error)),
    }
}

fn join(
    names: &Names,
    present: &Framed<'_>,
    snapshot: Result<Checkpoint, String>,
    previous: Option<&Framed<'_>>,
    bytes: &[u8],
) -> LoadedStore {
    let path = &names.path;
    let mut damage = Vec::new();
    let mut damaged = present.damaged.clone();
    let whole = snapshot.is_ok();
    let checkpoint = match snapshot {
        Ok(checkpoint) => Some(checkpoint),
        Err(why) => {
            damage.push(why);
            fall_back(&names.previous(), previous, &mut damage)
        }
    };
    let base = checkpoint.as_ref().map_or(0, |checkpoint| checkpoint.seq);

    // The previous generation may have records that the present one has lost, or lacks after a loss of power just after
    // a compaction.
    let mut records = present.records(base, &mut damaged);
    let own = records.len();
    // The records of the previous generation are used only if its number is lower. If a user has copied an old file
    // to the path, that file's number can be the lower one.
    let generation = |framed: &Framed<'_>| framed.header.map(|header| header.generation);
    let older = previous.filter(|previous| {
        generation(present).is_none_or(|present| generation(previous).is_some_and(|g| g < present))
    });
    if let Some(previous) = older {
        let mut ignored: Vec<Damage> = Vec::new();
        records.extend(previous.records(base, &mut ignored));
        // The sort is stable, so of two records with the same number the present generation's is kept.
        records.sort_by_key(|record| record.seq);
        records.dedup_by_key(|record| record.seq);
    }
    damage.extend(damaged.into_iter().map(|Damage { offset, why }| {
        format!("`{}` is damaged at byte {offset}: {why}", path.display())
    }));

    // The record number at which the present generation begins.
    let begun = present.header.map(|header| header.seq);
    let begun = begun.or_else(|| Some(present.lines.first()?.seq.saturating_sub(1)));
    let mut exact = checkpoint.is_some() && !present.end_lost && begun.is_some();
    let mut expected = base.saturating_add(1);
    for record in &records {
        if checkpoint.is_some() && record.seq != expected {
            let last = record.seq.saturating_sub(1);
            damage.push(format!("the records {expected} to {last} are lost"));
            exact = false;
        }
        expected = record.seq.saturating_add(1);
    }
    if let Some(begun) = begun.filter(|begun| checkpoint.is_some() && *begun >= expected) {
        damage.push(format!("the records {expected} to {begun} are lost"));
        exact = false;
        expected = begun.saturating_add(1);
    }
    let torn = present.torn.clone();
    // No new record may get a number that a record in one of the two files has, usable or not. Parts of these files may
    // remain beside later generations, and must not be taken for records of those.
    let last = |framed: &Framed<'_>| framed.lines.last().map(|line| line.seq);
    let seen = last(present).max(previous.and_then(last)).unwrap_or(0);
    LoadedStore {
        seq: seen.max(expected - 1),
        generation: previous
            .and_then(generation)
            .max(generation(present))
            .unwrap_or(0),
        // A file that lacks records of the previous generation must not replace it.
        usable: whole && records.len() == own,
        present: None,
        bad_previous: None,
        torn: torn
            .clone()
            .and_then(|range| bytes.get(range).map(<[u8]>::to_vec)),
        loaded: Loaded {
            checkpoint,
            records,
            exact,
            torn: torn.map(|range| {
                let length = range.len();
                format!(
                    "`{}` ends in {length} bytes of an append that was cut short",
                    path.display()
                )
            }),
            damage,
        },
    }
}

fn fall_back(
    path: &Path,
    previous: Option<&Framed<'_>>,
    damage: &mut Vec<String>,
) -> Option<Checkpoint> {
    let Some(previous) = previous else {
        damage.push(format!(
            "there is no previous generation `{}` to fall back on",
            path.display()
        ));
        return None;
    };
    match previous.checkpoint() {
        Ok(checkpoint) => {
            damage.push(format!(
                "the snapshot of the previous generation `{}` is used instead",
                path.display()
            ));
            Some(checkpoint)
        }
        Err(why) => {
            damage.push(format!(
                "the snapshot of the previous generation `{}` cannot be used: {why}",
                path.display()
            ));
            None
        }
    }
}
