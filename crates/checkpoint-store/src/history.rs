//! The checkpoints kept beside the present one: those of the last sessions and of the last rescues.

use std::cmp::Reverse;
use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use super::generation::append_all;
use super::names::{beside, previous};
use super::{Disk, Names, Storage};
use rescue_core::checkpoint::format::{self, Checkpoint};

/// Maximum number of earlier sessions that are kept.
const SESSIONS_MAX: usize = 5;
/// Maximum number of rescues that are kept.
const RESCUES_MAX: usize = 20;

/// The start of the names of all nodes and parameters of `rosrescue drill`. The process id of the drill follows.
pub const DRILLS: &str = "/rosrescue_drill_";

/// Why a checkpoint is kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum KeepReason {
    /// The session's last checkpoint, kept when the next session began.
    Session,
    /// Kept at a rescue: the state that the new master got.
    Rescue,
}

impl KeepReason {
    /// The name of the reason, as in file names.
    pub fn name(self) -> &'static str {
        match self {
            Self::Session => "session",
            Self::Rescue => "rescue",
        }
    }
}

/// A checkpoint that is kept beside the present one.
#[derive(Clone, Debug)]
pub struct SavedCheckpoint {
    pub kind: KeepReason,
    /// A number that grows with each file of the same kind.
    pub number: u64,
    pub path: PathBuf,
    pub bytes: u64,
    /// Wall clock time of the last record, in seconds since 1970.
    pub written: i64,
}

/// Lists the checkpoints kept beside the one at `path`: those of earlier sessions, then those of rescues, each from new
/// to old.
fn saved_checkpoints(path: &Path) -> io::Result<Vec<SavedCheckpoint>> {
    let names = names_of(path);
    let mut kept = Vec::new();
    for kind in [KeepReason::Session, KeepReason::Rescue] {
        for number in names.numbers(&Disk, kind.name())?.into_iter().rev() {
            let path = names.numbered(kind.name(), number);
            // Another process may have removed the file.
            let Ok(metadata) = fs::symlink_metadata(&path) else {
                continue;
            };
            kept.push(SavedCheckpoint {
                kind,
                number,
                path,
                bytes: metadata.len(),
                written: metadata.mtime(),
            });
        }
    }
    Ok(kept)
}

/// Lists the checkpoints kept beside the one at `path`, from new to old. Links in `path` must be resolved.
///
/// The clock may have been set back, so the numbers decide about the order of files of one kind: a file counts as no older
/// than those of its kind with lower numbers.
///
/// # Errors
///
/// If the folder cannot be read.
pub fn newest_first(path: &Path) -> io::Result<Vec<SavedCheckpoint>> {
    let mut dated: Vec<(i64, SavedCheckpoint)> = Vec::new();
    for kept in saved_checkpoints(path)?.into_iter().rev() {
        let older = dated.last().filter(|(_, older)| older.kind == kept.kind);
        let at = older.map_or(kept.written, |(at, _)| kept.written.max(*at));
        dated.push((at, kept));
    }
    dated.reverse();
    dated.sort_by_key(|(at, _)| Reverse(*at));
    Ok(dated.into_iter().map(|(_, kept)| kept).collect())
}

/// The number of the last rescue that was kept beside the checkpoint at `path`. 0 if there is none.
pub fn last_rescue(path: &Path) -> u64 {
    let numbers = names_of(path).numbers(&Disk, KeepReason::Rescue.name());
    numbers
        .ok()
        .and_then(|mut numbers| numbers.pop())
        .unwrap_or(0)
}

/// Keeps `checkpoint`, the state of rescue `number`, beside the checkpoint at `path`. Nodes and parameters of drills
/// are left out, so that `rosrescue restore` does not bring them back. The file is not synced: it is only a copy, and
/// syncs wear out memory cards.
///
/// # Errors
///
/// If the file cannot be written. Then no part of it remains.
pub fn keep_rescue(path: &Path, number: u64, mut checkpoint: Checkpoint) -> io::Result<PathBuf> {
    checkpoint.snapshot.remove_named(DRILLS);
    checkpoint.pending.retain(|write| {
        let caller = write.call.caller();
        caller.is_none_or(|caller| !caller.starts_with(DRILLS))
    });
    let names = names_of(path);
    let kept = names.numbered(KeepReason::Rescue.name(), number);
    let encoded = format::encode_checkpoint(&checkpoint, 1).map_err(io::Error::other)?;
    // If a crash leaves this file, the next start removes it.
    let fresh = beside(&kept, ".new");
    let written = Disk
        .create(&fresh)
        .and_then(|file| append_all(&Disk, &file, &encoded.bytes))
        .and_then(|()| fs::rename(&fresh, &kept));
    if written.is_err() {
        let _ = fs::remove_file(&fresh);
    }
    written.map(|()| kept)
}

/// Removes surplus kept checkpoints: all but the last 5 sessions and 20 rescues, and of these the oldest until the
/// others take `bytes_most` or less. The last session always stays.
///
/// # Errors
///
/// If the folder cannot be read.
pub fn trim(path: &Path, bytes_most: u64) -> io::Result<()> {
    let all = saved_checkpoints(path)?;
    let (mut sessions, mut rescues): (Vec<_>, Vec<_>) = all
        .into_iter()
        .partition(|kept| kept.kind == KeepReason::Session);
    let mut surplus = sessions.split_off(SESSIONS_MAX.min(sessions.len()));
    surplus.extend(rescues.split_off(RESCUES_MAX.min(rescues.len())));
    // Ranks by age: first the newest of each kind, then the second newest of each kind, and so on.
    let mut ranked: Vec<_> = sessions.into_iter().enumerate().collect();
    ranked.extend(rescues.into_iter().enumerate());
    ranked.sort_by_key(|(rank, _)| *rank);
    let mut total: u64 = 0;
    for (rank, kept) in ranked {
        total = total.saturating_add(kept.bytes);
        let last_session = kept.kind == KeepReason::Session && rank == 0;
        if total > bytes_most && !last_session {
            surplus.push(kept);
        }
    }
    for kept in surplus {
        // A failed removal must not prevent anything else.
        let _ = fs::remove_file(&kept.path);
        let _ = fs::remove_file(previous(&kept.path));
    }
    Ok(())
}

fn names_of(path: &Path) -> Names {
    Names {
        path: path.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, SystemTime};

    use super::*;
    use rescue_core::checkpoint::format::PendingWrite;
    use ros1_master::{
        master::{Method, Request, SnapshotNode},
        xmlrpc::Value,
    };

    fn scratch_path() -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("c.yaml");
        (folder, path)
    }

    fn file(path: &Path, name: &str, bytes: usize) {
        fs::write(beside(path, &format!(".{name}")), vec![b'x'; bytes]).unwrap();
    }

    fn set(caller: &str, key: &str, value: i32) -> Request {
        let params = [Value::from(caller), key.into(), value.into()];
        Request::new(Method::SetParam, params)
    }

    fn listed(path: &Path) -> Vec<String> {
        let kept = saved_checkpoints(path).unwrap().into_iter();
        kept.map(|kept| format!("{}-{}", kept.kind.name(), kept.number))
            .collect()
    }

    #[test]
    fn only_the_last_sessions_and_rescues_are_kept() {
        let (_folder, path) = scratch_path();
        for number in 1..=7 {
            file(&path, &format!("session-{number}"), 1);
        }
        for number in 5..=30 {
            file(&path, &format!("rescue-{number}"), 1);
        }
        file(&path, "session-1.previous", 1);
        file(&path, "rescue-31.new", 1);
        file(&path, "broken-1", 1);
        trim(&path, 100).unwrap();
        let sessions = (3..=7).rev().map(|number| format!("session-{number}"));
        let rescues = (11..=30).rev().map(|number| format!("rescue-{number}"));
        assert_eq!(listed(&path), sessions.chain(rescues).collect::<Vec<_>>());
        assert!(!beside(&path, ".session-1.previous").exists());
        assert!(beside(&path, ".broken-1").exists());
    }

    /// Robots start without a battery-backed clock.
    #[test]
    fn the_newest_file_of_a_kind_comes_first_even_if_the_clock_was_set_back() {
        let (_folder, path) = scratch_path();
        let files = [
            ("session-1", 100),
            ("rescue-1", 150),
            ("session-2", 200),
            ("rescue-2", 0),
            ("session-3", 50),
            ("rescue-3", 300),
        ];
        for (name, written) in files {
            file(&path, name, 1);
            let kept = fs::File::open(beside(&path, &format!(".{name}"))).unwrap();
            kept.set_modified(SystemTime::UNIX_EPOCH + Duration::from_secs(written))
                .unwrap();
        }
        let found = newest_first(&path).unwrap();
        let names = found
            .iter()
            .map(|kept| format!("{}-{}", kept.kind.name(), kept.number));
        let expected = [
            "rescue-3",
            "session-3",
            "session-2",
            "rescue-2",
            "rescue-1",
            "session-1",
        ];
        assert_eq!(names.collect::<Vec<_>>(), expected);
        assert_eq!(
            found[1].written, 50,
            "the time that people see is the file's"
        );
    }

    #[test]
    fn the_oldest_files_are_removed_to_meet_the_size_limit_but_the_last_session_stays() {
        let (_folder, path) = scratch_path();
        for number in 1..=3 {
            file(&path, &format!("session-{number}"), 10);
            file(&path, &format!("rescue-{number}"), 10);
        }
        trim(&path, 40).unwrap();
        let left = ["session-3", "session-2", "rescue-3", "rescue-2"];
        assert_eq!(listed(&path), left);
        trim(&path, 5).unwrap();
        assert_eq!(listed(&path), ["session-3"]);
        trim(&path, 0).unwrap();
        assert_eq!(listed(&path), ["session-3"]);
    }

    #[test]
    fn the_state_of_a_rescue_is_kept_as_a_whole_checkpoint_with_its_number() {
        let (_folder, path) = scratch_path();
        let checkpoint = Checkpoint {
            seq: 7,
            ..Checkpoint::default()
        };
        for number in 1..=2 {
            let kept = keep_rescue(&path, number, checkpoint.clone()).unwrap();
            assert_eq!(kept, beside(&path, &format!(".rescue-{number}")));
            let loaded = super::super::read(&kept).unwrap().unwrap();
            assert!(loaded.exact && loaded.damage.is_empty());
            assert_eq!(loaded.checkpoint, Some(checkpoint.clone()));
        }
        assert_eq!(listed(&path), ["rescue-2", "rescue-1"]);
        let nowhere = path.join("nowhere/c.yaml");
        assert!(keep_rescue(&nowhere, 1, checkpoint).is_err());
    }

    #[test]
    fn the_state_of_a_rescue_is_kept_without_the_drill_that_caused_it() {
        let (_folder, path) = scratch_path();
        let list = |nodes: &[&str]| nodes.iter().map(|node| (*node).to_owned()).collect();
        let robot = || {
            let mut checkpoint = Checkpoint::default();
            let snapshot = &mut checkpoint.snapshot;
            snapshot
                .nodes
                .insert("/n".to_owned(), SnapshotNode::default());
            snapshot
                .subscribers
                .insert("/scan".to_owned(), list(&["/n"]));
            snapshot.params.insert("speed".to_owned(), 3.into());
            let (seq, call) = (1, set("/n", "/speed", 3));
            checkpoint.pending = vec![PendingWrite { seq, call }];
            checkpoint
        };
        let mut with_drill = robot();
        let drill = format!("{DRILLS}7");
        let snapshot = &mut with_drill.snapshot;
        snapshot
            .nodes
            .insert(drill.clone(), SnapshotNode::default());
        snapshot
            .subscribers
            .insert("/scan".to_owned(), list(&["/n", &drill]));
        snapshot
            .subscribers
            .insert("/odom".to_owned(), list(&[&drill]));
        snapshot
            .publishers
            .insert(format!("{drill}/topic"), list(&[&drill]));
        snapshot
            .topic_types
            .insert(format!("{drill}/topic"), "x/Y".to_owned());
        snapshot
            .param_subscribers
            .insert("/".to_owned(), list(&[&drill]));
        snapshot
            .params
            .insert("rosrescue_drill_7".to_owned(), 1.into());
        let (seq, call) = (2, set(&drill, &drill, 1));
        with_drill.pending.push(PendingWrite { seq, call });
        let kept = keep_rescue(&path, 1, with_drill).unwrap();
        let loaded = super::super::read(&kept).unwrap().unwrap();
        assert_eq!(loaded.checkpoint, Some(robot()));
    }
}
