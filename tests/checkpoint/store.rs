//! The checkpoint on a real disk.

mod damage;
mod taken_lock;

use std::fs;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::{Path, PathBuf};

use checkpoint_store::{OpenError, Store, StoreError};
use rescue_core::checkpoint::format::{Checkpoint, Record, RecordContent, Session};
use ros1_master::{
    master::{Method, Request},
    xmlrpc::Value,
};
use tempfile::TempDir;

/// A new folder, and a path for a checkpoint in it.
fn place() -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("c.yaml");
    (folder, path)
}

fn seqs(records: &[Record]) -> Vec<u64> {
    records.iter().map(|record| record.seq).collect()
}

fn entry(nth: i32) -> RecordContent {
    let params = ["/n".into(), format!("/p{nth}").into(), Value::from(nth)];
    RecordContent::call(Request::new(Method::SetParam, params))
}

fn checkpoint(seq: u64) -> Checkpoint {
    let mut checkpoint = Checkpoint {
        seq,
        ..Checkpoint::default()
    };
    checkpoint.session.id = "run".to_owned();
    checkpoint
        .snapshot
        .params
        .insert("as_of".to_owned(), Value::from(seq as i32));
    checkpoint
}

/// A store at `path` that has begun, with records up to number `seq`.
fn started(path: &Path, seq: i32) -> Store {
    let (mut store, loaded) = Store::open(path).unwrap();
    assert!(loaded.is_none());
    store.begin(&checkpoint(0)).unwrap();
    for nth in 1..=seq {
        assert_eq!(store.append(&[entry(nth)]).unwrap(), nth as u64);
    }
    store
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> = fs::read_dir(folder)
        .unwrap()
        .map(|e| e.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names
}

#[test]
fn appended_records_are_there_after_a_crash() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("deep/er/latest-chkpt.yaml");
    let store = started(&path, 3);
    drop(store);
    let (store, loaded) = Store::open(&path).unwrap();
    let loaded = loaded.unwrap();
    assert_eq!(loaded.checkpoint, Some(checkpoint(0)));
    assert_eq!(
        loaded
            .records
            .iter()
            .map(|record| record.entry.clone())
            .collect::<Vec<_>>(),
        [entry(1), entry(2), entry(3)]
    );
    assert!(loaded.exact && loaded.torn.is_none() && loaded.damage.is_empty());
    assert_eq!(loaded.session().unwrap().id, "run");
    assert_eq!(store.seq(), 3);
    assert!(store.unprotected().is_some());
}

#[test]
fn a_second_store_is_refused_with_the_process_id_of_the_first() {
    let (folder, path) = place();
    let _store = started(&path, 0);
    let link = folder.path().join("other.yaml");
    symlink("c.yaml", &link).unwrap();
    for path in [&path, &link] {
        let error = Store::open(path).err().unwrap();
        let text = error.to_string();
        assert!(matches!(error, OpenError::Locked { .. }));
        assert!(
            text.contains("c.yaml") && text.contains("another rosrescue"),
            "{text}"
        );
        assert!(
            text.contains(&format!("process {}", std::process::id())),
            "{text}"
        );
    }
}

#[test]
fn files_are_accessible_to_their_owner_only() {
    let (folder, path) = place();
    let mut store = started(&path, 1);
    store.begin(&checkpoint(1)).unwrap();
    for name in names(folder.path()) {
        let mode = fs::metadata(folder.path().join(&name))
            .unwrap()
            .permissions()
            .mode();
        assert_eq!(mode & 0o777, 0o600, "{name}");
    }
    assert_eq!(
        names(folder.path()),
        ["c.yaml", "c.yaml.lock", "c.yaml.previous"]
    );
}

#[test]
fn a_symbolic_link_is_followed_and_kept() {
    let folder = tempfile::tempdir().unwrap();
    let (link, real) = (
        folder.path().join("link.yaml"),
        folder.path().join("real/c.yaml"),
    );
    symlink("real/c.yaml", &link).unwrap();
    let mut store = started(&link, 1);
    store.begin(&checkpoint(1)).unwrap();
    assert!(fs::symlink_metadata(&link).unwrap().is_symlink());
    assert!(real.is_file());
    assert_eq!(names(folder.path()), ["link.yaml", "real"]);
    symlink("loop.yaml", folder.path().join("loop.yaml")).unwrap();
    assert!(Store::open(&folder.path().join("loop.yaml")).is_err());
}

#[test]
fn records_made_during_a_compaction_are_in_both_files() {
    let (folder, path) = place();
    let mut store = started(&path, 2);
    let job = store.begin_compaction(checkpoint(2)).unwrap();
    assert!(matches!(
        store.begin_compaction(checkpoint(2)),
        Err(StoreError::Busy)
    ));
    store.append(&[entry(3)]).unwrap();
    let done = job.run();
    store.append(&[entry(4)]).unwrap();
    let journal = store.journal_bytes();
    store.finish_compaction(done).unwrap();
    assert!(store.journal_bytes() < journal);
    store.append(&[entry(5)]).unwrap();
    drop(store);
    let (store, loaded) = Store::open(&path).unwrap();
    let loaded = loaded.unwrap();
    assert_eq!(loaded.checkpoint, Some(checkpoint(2)));
    assert_eq!(seqs(&loaded.records), [3, 4, 5]);
    assert!(loaded.exact);
    assert_eq!(store.generation(), 2);
    let previous = checkpoint_store::read(&folder.path().join("c.yaml.previous"))
        .unwrap()
        .unwrap();
    assert_eq!(seqs(&previous.records), [1, 2, 3, 4]);
}

#[test]
fn compaction_is_wanted_when_the_journal_outgrows_the_snapshot() {
    let folder = tempfile::tempdir().unwrap();
    let mut store = started(&folder.path().join("c.yaml"), 0);
    let mut appended = 0;
    while !store.wants_compaction() {
        appended += 1;
        store.append(&[entry(appended)]).unwrap();
        assert!(appended < 5_000);
    }
    assert!(store.journal_bytes() > 64 * 1024);
    store.begin(&checkpoint(appended as u64)).unwrap();
    assert!(!store.wants_compaction());
    let stale = store.begin(&checkpoint(3)).unwrap_err();
    assert!(matches!(stale, StoreError::Stale { snapshot: 3, .. }));
    assert!(store.unprotected().is_none());
}

#[test]
fn a_session_that_was_set_aside_does_not_affect_the_next() {
    let (folder, path) = place();
    let mut store = started(&path, 2);
    store.begin(&checkpoint(2)).unwrap();
    for nth in 1..=12 {
        let aside = store.set_aside("session").unwrap().unwrap();
        assert_eq!(aside, folder.path().join(format!("c.yaml.session-{nth}")));
        assert!(store.append(&[entry(0)]).is_err());
        store.begin(&checkpoint(store.seq())).unwrap();
        store.append(&[entry(nth)]).unwrap();
        store.begin(&checkpoint(store.seq())).unwrap();
    }
    // Only the last ten are kept.
    let kept = names(folder.path())
        .iter()
        .filter(|name| name.contains("session-"))
        .count();
    assert_eq!(kept, 10);
    store.set_aside("session").unwrap();
    assert_eq!(store.set_aside("session").unwrap(), None);
    drop(store);
    assert!(Store::open(&path).unwrap().1.is_none());
}

#[test]
fn a_session_that_was_set_aside_is_no_fallback_for_the_next() {
    let (_folder, path) = place();
    let mut store = started(&path, 2);
    store.begin(&checkpoint(2)).unwrap();
    store.set_aside("session").unwrap();
    store.begin(&checkpoint(2)).unwrap();
    drop(store);
    let mut broken = fs::read(&path).unwrap();
    broken[200] ^= 4;
    fs::write(&path, broken).unwrap();
    let loaded = Store::open(&path).unwrap().1.unwrap();
    assert!(loaded.checkpoint.is_none() && loaded.records.is_empty() && !loaded.exact);
}

#[test]
fn the_state_of_a_file_that_the_operator_removed_is_not_restored() {
    let (folder, path) = place();
    let mut store = started(&path, 2);
    store.begin(&checkpoint(2)).unwrap();
    drop(store);
    fs::remove_file(&path).unwrap();
    let (mut store, loaded) = Store::open(&path).unwrap();
    assert!(loaded.is_none());
    store.begin(&checkpoint(0)).unwrap();
    drop(store);
    let loaded = Store::open(&path).unwrap().1.unwrap();
    assert!(loaded.exact && loaded.records.is_empty());
    assert_eq!(
        names(folder.path()),
        ["c.yaml", "c.yaml.lock", "c.yaml.old-1"]
    );
}

#[test]
fn a_clean_stop_is_recorded_in_the_file() {
    let (_folder, path) = place();
    let mut store = started(&path, 1);
    let session = Session {
        closed: true,
        ..Session::default()
    };
    store
        .close(&Checkpoint {
            session,
            ..checkpoint(1)
        })
        .unwrap();
    assert!(store.append(&[entry(2)]).is_err());
    drop(store);
    let loaded = Store::open(&path).unwrap().1.unwrap();
    assert!(loaded.session().unwrap().closed && loaded.records.is_empty());
}

#[test]
fn the_store_knows_the_last_synced_record() {
    let folder = tempfile::tempdir().unwrap();
    let mut store = started(&folder.path().join("c.yaml"), 2);
    assert_eq!(store.synced_seq(), 0);
    let job = store.sync_job().unwrap();
    store.append(&[entry(3)]).unwrap();
    store.synced(job.run()).unwrap();
    assert_eq!(store.synced_seq(), 2);
    let job = store.sync_job().unwrap();
    store.synced(job.run()).unwrap();
    assert_eq!(store.synced_seq(), 3);
    assert!(store.sync_job().is_none());
}
