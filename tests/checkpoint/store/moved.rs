//! Files that are moved or changed while they are in use, or that cannot be read.

use std::fs::{self, File};
use std::os::unix::fs::FileExt;
use std::path::Path;
use std::process::Command;

use rosrescue::checkpoint::store::{CheckJob, OpenError, Store, StoreError};

use super::{checkpoint, entry, names, started};

fn check(store: &mut Store) {
    if let Some(done) = store.check_job().map(CheckJob::run) {
        let _ = store.checked(done);
    }
}

fn assert_refused(path: &Path) {
    let error = Store::open(path).err().expect("two of them");
    assert!(matches!(error, OpenError::Locked { .. }), "{error}");
}

/// The files are where they belong, and hold everything.
fn assert_whole(path: &Path, mut store: Store) {
    let reason = store.unprotected().unwrap().to_owned();
    assert!(reason.contains("c.yaml"), "{reason}");
    store.rearm(&checkpoint(store.seq())).unwrap();
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

#[test]
fn a_folder_that_is_renamed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("log/c.yaml");
    let mut store = started(&path, 3);
    fs::rename(folder.path().join("log"), folder.path().join("old")).unwrap();
    assert_refused(&path);
    check(&mut store);
    assert_whole(&path, store);
    assert_eq!(names(&folder.path().join("old")), ["c.yaml", "c.yaml.lock"]);
}

#[test]
fn a_lock_file_that_is_deleted_or_replaced() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("c.yaml");
    let mut store = started(&path, 3);
    let lock = folder.path().join("c.yaml.lock");
    fs::remove_file(&lock).unwrap();
    assert_refused(&path);
    check(&mut store);
    assert!(store.unprotected().unwrap().contains("lock file"));
    fs::write(&lock, "").unwrap();
    assert_whole(&path, store);
}

/// In another container, say, where the socket is not seen.
#[test]
fn a_lock_that_another_one_took_is_waited_for() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("c.yaml");
    let mut store = started(&path, 3);
    let lock = folder.path().join("c.yaml.lock");
    fs::remove_file(&lock).unwrap();
    fs::write(&lock, "4711\n").unwrap();
    let other = File::open(&lock).unwrap();
    other.lock().unwrap();
    check(&mut store);
    for _ in 0..2 {
        let error = store.rearm(&checkpoint(store.seq())).unwrap_err();
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
    drop(other);
    assert_whole(&path, store);
}

#[test]
fn a_file_that_is_overwritten_in_place_is_kept() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("c.yaml");
    let mut store = started(&path, 3);
    let file = File::options().write(true).open(&path).unwrap();
    // A clock that ticks 100 times a second must show that this came later.
    let written = fs::metadata(&path).unwrap().modified().unwrap();
    while fs::metadata(&path).unwrap().modified().unwrap() == written {
        file.write_all_at(b"junk", 100).unwrap();
    }
    // A write of ours between that and the check hides nothing.
    store.append(&[entry(4)]).unwrap();
    check(&mut store);
    assert!(store.unprotected().unwrap().contains("overwritten"));
    assert_whole(&path, store);
    let kept = fs::read(folder.path().join("c.yaml.broken-1")).unwrap();
    assert_eq!(&kept[100..104], b"junk");
}

#[test]
fn a_file_that_is_touched_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("c.yaml");
    let mut store = started(&path, 3);
    let file = File::options().write(true).open(&path).unwrap();
    file.set_modified(std::time::SystemTime::UNIX_EPOCH)
        .unwrap();
    check(&mut store);
    store.append(&[entry(4)]).unwrap();
    check(&mut store);
    assert_eq!((store.unprotected(), store.generation()), (None, 1));
}

/// What is found instead of the checkpoint: a folder, a pipe, a file beyond all measure.
fn unreadable() -> [fn(&Path); 3] {
    [
        |path| {
            fs::remove_file(path).unwrap();
            fs::create_dir_all(path.join("within")).unwrap();
        },
        |path| {
            fs::remove_file(path).unwrap();
            assert!(Command::new("mkfifo").arg(path).status().unwrap().success());
        },
        |path| {
            let file = File::options().write(true).open(path).unwrap();
            file.set_len((1 << 30) + 1).unwrap();
        },
    ]
}

#[test]
fn what_cannot_be_read_is_kept_and_the_previous_generation_used() {
    for spoil in unreadable() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("c.yaml");
        let mut store = started(&path, 3);
        store.begin(&checkpoint(3)).unwrap();
        drop(store);
        spoil(&path);
        let kind = fs::metadata(&path).unwrap().file_type();
        let length = fs::metadata(&path).unwrap().len();
        let (mut store, loaded) = Store::open(&path).unwrap();
        let loaded = loaded.unwrap();
        assert_eq!(loaded.records.len(), 3);
        assert!(!loaded.exact && loaded.damage[0].contains("c.yaml"));
        for _ in 0..2 {
            store.begin(&checkpoint(3)).unwrap();
        }
        let aside = folder.path().join("c.yaml.unreadable-1");
        assert_eq!(store.take_kept(), Some(aside.clone()));
        let kept = fs::metadata(&aside).unwrap();
        assert_eq!((kept.file_type(), kept.len()), (kind, length));
    }
}

/// A good checkpoint that could not be read at the start is there later.
#[test]
fn a_state_from_elsewhere_replaces_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("c.yaml");
    let mut store = started(&path, 3);
    store.begin(&checkpoint(3)).unwrap();
    drop(store);
    let read = |name: &str| fs::read(folder.path().join(name)).unwrap();
    let good = [read("c.yaml.previous"), read("c.yaml")];
    let mut store = Store::open_over(&path).unwrap();
    for _ in 0..3 {
        store.begin(&checkpoint(store.seq())).unwrap();
    }
    let kept = [read("c.yaml.unreadable-1"), read("c.yaml.unreadable-2")];
    assert_eq!(kept, good);
}
