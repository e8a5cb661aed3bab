//! What happens when another process changes the files while they are in use.

use super::*;

const FOREIGN: &[u8] = b"use_sim_time: true\n";

fn path() -> &'static Path {
    Path::new(PATH)
}

/// Runs the check that the checkpointer makes in each round.
fn check(store: &mut Store<SimFs>) {
    if let Some(job) = store.check_job() {
        let _ = store.checked(job.run());
    }
}

/// A store with two records, on a disk of its own.
fn started() -> (SimFs, Model, Store<SimFs>) {
    let (fs, mut model) = (SimFs::default(), Model::default());
    let (mut store, _) = open(&fs).unwrap();
    model.begin(&mut store);
    model.append(&mut store, 2);
    check(&mut store);
    assert_eq!(store.unprotected(), None);
    (fs, model, store)
}

/// Runs `check` on every disk that a crash at operation `at` may leave. Also checks that the next start does not touch
/// `kept`.
fn at_each_image(fs: &SimFs, at: usize, kept: &[u8], check: impl Fn(&SimFs, &str)) {
    let mut images = fs.after_power_loss(4_096);
    images.push(fs.after_kill());
    for (nth, image) in images.iter().enumerate() {
        let context = format!("operation {at}, image {nth}");
        assert!(image.has(kept), "{context}");
        check(image, &context);
        go_on(image, &context);
        assert!(image.has(kept), "{context}");
    }
}

/// The complete file with one byte changed.
fn changed(fs: &SimFs) -> Vec<u8> {
    let mut bytes = fs.read(path(), 1 << 20).unwrap();
    bytes[200] ^= 1;
    bytes
}

type Change = fn(&SimFs);

const CHANGES: [(&str, &str, Change); 7] = [
    ("removed", "removed or renamed", |fs| fs.take_away(path())),
    ("replaced", "another file", |fs| {
        fs.overwrite(path(), FOREIGN, false);
    }),
    ("replaced by its like", "another file", |fs| {
        let bytes = fs.read(path(), 1 << 20).unwrap();
        fs.overwrite(path(), &bytes, false);
    }),
    ("cut off", "has 0 bytes instead of", |fs| {
        fs.overwrite(path(), b"", true);
    }),
    ("written to", "bytes instead of", |fs| {
        let more = [fs.read(path(), 1 << 20).unwrap(), b"# note\n".to_vec()].concat();
        fs.overwrite(path(), &more, true);
    }),
    ("overwritten", "overwritten", |fs| {
        fs.overwrite(path(), &changed(fs), true);
    }),
    ("unlocked", "lock file", |fs| {
        fs.take_away(Path::new("/log/latest-chkpt.yaml.lock"));
    }),
];

#[test]
fn any_change_of_the_file_by_another_process_is_noticed_and_repaired() {
    // Each change happens once while no calls come, and once while calls come.
    for ((what, word, change), traffic) in CHANGES.into_iter().flat_map(|it| [(it, 0), (it, 1)]) {
        let (fs, mut model, mut store) = started();
        change(&fs);
        model.append(&mut store, traffic);
        check(&mut store);
        let reason = store.unprotected().expect(what);
        assert!(reason.contains(word) && reason.contains(PATH), "{reason}");

        store.begin(&model.checkpoint(store.seq())).unwrap();
        model.append(&mut store, 1);
        check(&mut store);
        assert_eq!(store.unprotected(), None, "{what}");
        drop(store);
        let loaded = open(&fs.after_kill()).unwrap().1.unwrap();
        assert!(loaded.exact && loaded.damage.is_empty(), "{what}");
        assert_eq!(state(&loaded), model.applied, "{what}");
    }
}

/// At any moment a process finds one of the two locks.
#[test]
fn a_removed_lock_file_is_replaced_before_the_old_one_is_closed() {
    let (fs, _, mut store) = started();
    let lock = Names { path: PATH.into() }.lock();
    fs.take_away(&lock);
    check(&mut store);
    assert!(store.unprotected().is_some());
    assert!(fs.id_at(&lock).unwrap().is_some());
}

#[test]
fn no_record_is_acknowledged_after_another_processs_bytes() {
    let (fs, mut model, mut store) = started();
    fs.overwrite(path(), b"", true);
    model.append(&mut store, 1);
    assert_eq!(model.acked, 2);
    assert_eq!(fs.read(path(), 10).unwrap(), b"");
}

#[test]
fn a_file_that_was_only_touched_stays_in_use() {
    let (fs, mut model, mut store) = started();
    let bytes = fs.read(path(), 1 << 20).unwrap();
    fs.overwrite(path(), &bytes, true);
    model.append(&mut store, 1);
    check(&mut store);
    assert_eq!((store.unprotected(), store.generation()), (None, 1));
    assert_eq!(model.acked, 3);
}

#[test]
fn a_late_check_of_an_earlier_generation_is_ignored() {
    let (_, mut model, mut store) = started();
    let late = store.check_job().unwrap();
    model.begin(&mut store);
    store.checked(late.run()).unwrap();
    assert_eq!(store.unprotected(), None);
}

/// A file found at the path is kept, even if the process is killed meanwhile or the power fails. From the first new
/// generation on, the state is always in a file.
#[test]
fn a_file_found_at_the_path_is_kept_whenever_a_crash_happens() {
    for at in 0.. {
        let (fs, mut model, mut store) = started();
        model.begin(&mut store);
        fs.overwrite(path(), FOREIGN, false);
        fs.arm(at, Fault::Kill(4));
        check(&mut store);
        let done = model.begin(&mut store);
        model.sync(&mut store);
        drop(store);
        let reached = fs.disarm();
        at_each_image(&fs, at, FOREIGN, |image, context| {
            let loaded = open(image).unwrap().1;
            assert!(
                !done || loaded.is_some_and(|loaded| loaded.exact),
                "{context}"
            );
        });
        if !reached {
            assert!(done && at > 5);
            break;
        }
    }
}

#[test]
fn storing_a_state_from_elsewhere_destroys_no_file() {
    let (fs, mut model, mut store) = started();
    model.begin(&mut store);
    drop(store);
    let names = Names { path: PATH.into() };
    let good = [names.path.clone(), names.previous()].map(|path| fs.read(&path, 1 << 20).unwrap());
    for at in 0.. {
        let fs = fs.after_kill();
        fs.arm(at, Fault::Kill(4));
        let mut model = Model::default();
        if let Ok(mut store) = Store::open_over_on(fs.clone(), path()) {
            assert_eq!(store.seq(), 2);
            model.begin(&mut store);
            model.append(&mut store, 1);
            model.begin(&mut store);
            model.begin(&mut store);
        }
        let reached = fs.disarm();
        let after = fs.after_kill();
        assert!(good.iter().all(|bytes| after.has(bytes)), "operation {at}");
        if !reached {
            let names = fs.list(Path::new("/log")).unwrap();
            let kept = names.iter().filter(|name| name.contains(".unreadable-"));
            assert_eq!(kept.count(), 2);
            let loaded = open(&after).unwrap().1.unwrap();
            assert_eq!(state(&loaded), model.applied);
            break;
        }
    }
}

#[test]
fn an_unreadable_file_is_kept_and_the_previous_generation_is_restored() {
    let (disk, mut model, mut store) = started();
    model.sync(&mut store);
    model.begin(&mut store);
    drop(store);
    let unread = disk.read(path(), 1 << 20).unwrap();
    disk.make_unreadable(path());
    for at in 0.. {
        let fs = disk.after_kill();
        fs.arm(at, Fault::Kill(4));
        if let Ok((mut store, loaded)) = open(&fs) {
            let loaded = loaded.unwrap();
            assert_eq!(state(&loaded), model.applied);
            assert!(!loaded.exact && loaded.damage[0].contains("cannot read"));
            model.begin(&mut store);
            model.begin(&mut store);
        }
        let reached = fs.disarm();
        at_each_image(&fs, at, &unread, |image, context| {
            let loaded = open(image).unwrap().1.unwrap();
            assert_eq!(state(&loaded), model.applied, "{context}");
        });
        if !reached {
            let names = fs.list(Path::new("/log")).unwrap();
            assert!(names.contains(&"latest-chkpt.yaml.unreadable-1".to_owned()));
            break;
        }
    }
}

/// Without a previous generation nothing is known about the state, so nothing is changed.
#[test]
fn an_unreadable_file_without_a_previous_generation_is_left_alone() {
    let (fs, mut model, mut store) = started();
    model.begin(&mut store);
    drop(store);
    let names = Names { path: PATH.into() };
    fs.make_unreadable(&names.path);
    fs.make_unreadable(&names.previous());
    let before = fs.ops();
    assert!(matches!(open(&fs), Err(OpenError::Io { .. })));
    assert_eq!(fs.ops(), before);
}

#[test]
fn an_unreadable_previous_generation_is_kept() {
    let (fs, mut model, mut store) = started();
    model.begin(&mut store);
    drop(store);
    let names = Names { path: PATH.into() };
    let unread = fs.read(&names.previous(), 1 << 20).unwrap();
    fs.make_unreadable(&names.previous());
    let (mut store, loaded) = open(&fs).unwrap();
    assert!(loaded.unwrap().exact);
    model.begin(&mut store);
    model.begin(&mut store);
    assert!(fs.has(&unread));
}
