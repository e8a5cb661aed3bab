//! A lock file that was removed, and that another process has locked since.

use std::fs::{self, File};
use std::path::Path;

use checkpoint_store::{CheckJob, OpenError, Store, StoreError};

use super::{checkpoint, entry, names, place, started};

fn check(store: &mut Store) {
    if let Some(done) = store.check_job().map(CheckJob::run) {
        let _ = store.checked(done);
    }
}

fn assert_refused(path: &Path) {
    let error = Store::open(path)
        .err()
        .expect("a second store must be refused");
    assert!(matches!(error, OpenError::Locked { .. }), "{error}");
}

/// Checks that the files are in their places and complete.
fn assert_whole(path: &Path, mut store: Store) {
    let reason = store.unprotected().unwrap().to_owned();
    assert!(reason.contains("c.yaml"), "{reason}");
    store.begin(&checkpoint(store.seq())).unwrap();
    store.append(&[entry(9)]).unwrap();
    check(&mut store);
    assert_eq!(store.unprotected(), None);
    assert_refused(path);
    let seq = store.seq();
    drop(store);
    let (store, loaded) = Store::open(path).unwrap();
    assert!(loaded.unwrap().exact);
    assert_eq!(store.seq(), seq);
}

/// The other process is like one in another container, which does not see the socket.
#[test]
fn recording_resumes_when_another_process_gives_the_lock_back() {
    let (folder, path) = place();
    let mut store = started(&path, 3);
    let lock = folder.path().join("c.yaml.lock");
    fs::remove_file(&lock).unwrap();
    fs::write(&lock, "4711\n").unwrap();
    let other = File::open(&lock).unwrap();
    other.lock().unwrap();
    check(&mut store);
    for _ in 0..2 {
        let error = store.begin(&checkpoint(store.seq())).unwrap_err();
        assert!(matches!(
            error,
            StoreError::Taken {
                holder: Some(4711),
                ..
            }
        ));
        assert!(store.append(&[entry(4)]).is_err());
    }
    assert_eq!(names(folder.path()), ["c.yaml", "c.yaml.lock"]);
    // A process that another test is starting may have a copy of the open file for a moment.
    other.unlock().unwrap();
    assert_whole(&path, store);
}
