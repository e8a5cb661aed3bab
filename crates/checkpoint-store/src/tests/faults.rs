//! Disks that fail, and jobs that finish too late.

use super::*;

const EIO: i32 = 5;
const ENOSPC: i32 = 28;
/// A disk quota is used up.
const EDQUOT: i32 = 122;
const EROFS: i32 = 30;

#[test]
fn a_failing_disk_loses_only_records_that_were_reported_as_unprotected() {
    let mut failures = 0;
    for errno in [ENOSPC, EIO, EROFS] {
        for fault in [Fault::Errno(errno), Fault::Once(errno), Fault::Short(errno)] {
            for at in 0..operations() {
                let fs = SimFs::default();
                fs.arm(at, fault);
                let mut model = Model::default();
                life(&fs, &mut model);
                let context = format!("{fault:?} at operation {at}");
                // Simulates a kill now: everything acknowledged must be there.
                let loaded = open(&fs.after_kill()).unwrap().1;
                check(&model, loaded.as_ref(), model.acked, &context);
                go_on(&fs.after_kill(), &context);
                failures += 1;
            }
        }
    }
    println!("{failures} failures");
}

#[test]
fn an_unprotected_store_reports_it_and_can_be_rearmed() {
    for fault in [Fault::Errno(ENOSPC), Fault::Short(ENOSPC)] {
        let fs = SimFs::default();
        let mut model = Model::default();
        let (mut store, _) = open(&fs).unwrap();
        model.begin(&mut store);
        model.append(&mut store, 2);
        fs.arm(0, fault);
        model.append(&mut store, 3);
        assert_eq!((model.acked, store.seq()), (2, 5));
        assert!(store.unprotected().unwrap().contains("latest-chkpt.yaml"));
        // The store does not try that file again, and a new file fails as well.
        model.append(&mut store, 1);
        assert!(store.sync_job().is_none() && !store.wants_compaction());
        assert!(store.begin(&model.checkpoint(store.seq())).is_err());
        assert!(store.unprotected().is_some());
        fs.disarm();

        // Records that come while the new file is written are in it.
        let job = store
            .begin_compaction(model.checkpoint(store.seq()))
            .unwrap();
        model.append(&mut store, 2);
        assert_eq!(model.acked, 2);
        store.finish_compaction(job.run()).unwrap();
        assert_eq!(store.unprotected(), None);
        model.append(&mut store, 1);
        assert_eq!(model.acked, 9);
        drop(store);
        let loaded = open(&fs).unwrap().1.unwrap();
        assert!(loaded.exact && loaded.damage.is_empty());
        assert_eq!(state(&loaded), model.applied);
    }
}

#[test]
fn record_numbers_from_an_unprotected_time_are_never_used_again() {
    // If numbers were used again, the undamaged records of a failed batch in the previous generation would count as
    // new.
    let fs = SimFs::default();
    let mut model = Model::default();
    let (mut store, _) = open(&fs).unwrap();
    model.begin(&mut store);
    model.append(&mut store, 1);
    fs.arm(0, Fault::Short(ENOSPC));
    model.append(&mut store, 10);
    fs.disarm();
    store.begin(&model.checkpoint(store.seq())).unwrap();
    model.append(&mut store, 1);
    assert_eq!(model.acked, 12);
    drop(store);
    let loaded = open(&fs).unwrap().1.unwrap();
    assert_eq!(state(&loaded), model.applied);
    assert_eq!(loaded.records.len(), 1);
}

#[test]
fn a_compaction_that_cannot_keep_up_is_dropped_at_a_memory_limit() {
    let fs = SimFs::default();
    let mut model = Model::default();
    let (mut store, _) = open(&fs).unwrap();
    model.begin(&mut store);
    let job = store.begin_compaction(model.checkpoint(0)).unwrap();
    let large = RecordContent::call(Request::new(Method::SetParam, ["x".repeat(1 << 20)]));
    for _ in 0..20 {
        store.append(std::slice::from_ref(&large)).unwrap();
        assert!(store.pending.as_ref().unwrap().meanwhile.len() <= MEANWHILE_BYTES_MAX);
    }
    let error = store.finish_compaction(job.run()).unwrap_err();
    assert!(matches!(error, StoreError::Overtaken { .. }));
    // No record is lost, and the compaction is not repeated at once.
    assert!(store.unprotected().is_none() && !store.wants_compaction());
    drop(store);
    assert_eq!(open(&fs).unwrap().1.unwrap().records.len(), 20);
}

#[test]
fn an_obsolete_or_lost_job_does_not_disturb_the_next_one() {
    let fs = SimFs::default();
    let mut model = Model::default();
    let (mut store, _) = open(&fs).unwrap();
    store.keep_log(0);
    model.begin(&mut store);
    let lost = store.begin_compaction(model.checkpoint(0)).unwrap();
    let busy = store.begin_compaction(model.checkpoint(0)).map(|_| ());
    assert!(matches!(busy, Err(StoreError::Busy)));
    drop(lost);
    let late = store.begin_compaction(model.checkpoint(0)).unwrap();
    model.append(&mut store, 1);
    model.begin(&mut store);
    let names = fs.list(Path::new("/log")).unwrap();
    let previous = fs
        .read(Path::new("/log/latest-chkpt.yaml.previous"), 0)
        .unwrap();
    let error = store.finish_compaction(late.run()).unwrap_err();
    assert!(matches!(error, StoreError::Overtaken { .. }));
    assert_eq!(fs.list(Path::new("/log")).unwrap(), names);
    assert!(
        fs.read(Path::new("/log/latest-chkpt.yaml.previous"), 0)
            .unwrap()
            == previous
    );
}

#[test]
fn a_session_is_set_aside_completely_or_not_at_all() {
    let run = |fs: &SimFs| {
        let Ok((mut store, loaded)) = open(fs) else {
            return;
        };
        assert!(loaded.is_some());
        if store.set_aside("session").is_err() {
            return;
        }
        let mut next = Model {
            session: "b",
            ..Model::default()
        };
        next.begin(&mut store);
        next.append(&mut store, 2);
        next.sync(&mut store);
        next.begin(&mut store);
        next.append(&mut store, 1);
        next.sync(&mut store);
    };
    let prepared = || {
        let fs = SimFs::default();
        let mut model = Model {
            session: "a",
            ..Model::default()
        };
        let (mut store, _) = open(&fs).unwrap();
        model.begin(&mut store);
        model.append(&mut store, 2);
        model.begin(&mut store);
        model.append(&mut store, 1);
        model.sync(&mut store);
        fs.arm(usize::MAX / 2, Fault::Kill(0));
        fs
    };
    let fs = prepared();
    let before = fs.ops();
    run(&fs);
    for at in 0..=fs.ops() - before {
        let fs = prepared();
        fs.arm(at, Fault::Kill(4));
        run(&fs);
        let mut images = fs.after_power_loss(400);
        images.push(fs.after_kill());
        for image in images {
            let Some(loaded) = open(&image).unwrap().1 else {
                continue;
            };
            assert!(loaded.exact, "at operation {at}: {loaded:?}");
            let expected: &[u64] = match loaded.session() {
                Some(Session { id, .. }) if id == "a" => &[1, 2, 3],
                Some(Session { id, .. }) if id == "b" => &[4, 5, 6],
                other => panic!("at operation {at}: {other:?}"),
            };
            let found = state(&loaded);
            assert!(expected.starts_with(&found), "at operation {at}: {found:?}");
        }
    }
}

/// rosrescue would refuse to read a larger file.
#[test]
fn a_file_that_would_become_too_large_is_rewritten() {
    let fs = SimFs::default();
    let mut model = Model::default();
    let (mut store, _) = open(&fs).unwrap();
    model.begin(&mut store);
    model.append(&mut store, 1);
    store.file_bytes_max = store.snapshot_bytes() + store.journal_bytes() + 10;
    model.append(&mut store, 1);
    assert_eq!(model.acked, 1);
    assert!(store.unprotected().unwrap().contains("too large"));
    store.begin(&model.checkpoint(store.seq())).unwrap();
    drop(store);
    assert_eq!(state(&open(&fs).unwrap().1.unwrap()), [1, 2]);
}

/// The previous generation is dropped, the present one is not.
#[test]
fn on_a_full_disk_the_previous_generation_makes_room_for_the_next() {
    for full in [ENOSPC, EDQUOT] {
        the_previous_generation_makes_room(full);
    }
}

fn the_previous_generation_makes_room(full: i32) {
    let fs = SimFs::default();
    let mut model = Model::default();
    let (mut store, _) = open(&fs).unwrap();
    for _ in 0..3 {
        assert!(model.begin(&mut store));
    }
    let names = store.place.names.clone();
    assert!(fs.read(&names.previous(), 1 << 20).is_ok());
    fs.arm(0, Fault::Once(full));
    assert!(model.begin(&mut store));
    fs.arm(0, Fault::Errno(full));
    model.append(&mut store, 1);
    assert!(!model.begin(&mut store));
    fs.disarm();
    assert!(fs.read(&names.path, 1 << 20).is_ok());
}

/// A store that has just been compacted. Some synced records are durable only in the previous generation.
fn just_compacted() -> (SimFs, Model, Store<SimFs>) {
    let fs = SimFs::default();
    let mut model = Model::default();
    let (mut store, _) = open(&fs).unwrap();
    model.begin(&mut store);
    model.append(&mut store, 1);
    let job = store
        .begin_compaction(model.checkpoint(store.seq()))
        .unwrap();
    model.append(&mut store, 2);
    model.sync(&mut store);
    store.finish_compaction(job.run()).unwrap();
    assert_eq!(model.synced, 3);
    (fs, model, store)
}

/// A loss of power just after a compaction can leave some records only in the previous generation. A start that is
/// killed must not replace that file before the next generation is complete.
#[test]
fn records_only_in_the_previous_generation_survive_starts_that_are_killed() {
    let (fs, model, store) = just_compacted();
    drop(store);
    for (nth, image) in fs.after_power_loss(4_096).iter().enumerate() {
        let context = format!("image {nth}");
        let loaded = open(&image.after_kill()).unwrap().1;
        check(&model, loaded.as_ref(), 3, &context);
        starts_killed(image, 3, &context);
    }
}

/// The present file cannot be synced, so records may be durable in the previous generation only. The next generation must
/// not replace it.
#[test]
fn a_present_file_that_cannot_be_synced_never_replaces_the_previous_generation() {
    let (fs, mut model, mut store) = just_compacted();
    fs.arm(0, Fault::Once(EIO));
    let job = store
        .begin_compaction(model.checkpoint(store.seq()))
        .unwrap();
    assert!(store.finish_compaction(job.run()).is_err());
    assert!(fs.disarm() && store.unprotected().is_some());
    for (nth, image) in fs.after_power_loss(4_096).iter().enumerate() {
        let context = format!("image {nth}");
        let loaded = open(image).unwrap().1;
        check(&model, loaded.as_ref(), 3, &context);
    }
    // The next generation has all records.
    assert!(model.begin(&mut store));
    for image in fs.after_power_loss(4_096) {
        check(&model, open(&image).unwrap().1.as_ref(), 3, "afterwards");
    }
}
