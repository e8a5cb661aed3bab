//! Crashes at every operation, losses of power, and disks that fail.

use std::path::Path;

use super::generation::MEANWHILE_BYTES_MAX;
use super::sim::{Fault, SimFs};
use super::*;
use crate::record::{Checkpoint, Entry, Session};
use crate::xmlrpc::{Call, Value};

const PATH: &str = "/log/latest-chkpt.yaml";
const EIO: i32 = 5;
const ENOSPC: i32 = 28;
const EROFS: i32 = 30;

/// The model: record `n` sets the parameter `n`, so a state is the set of the numbers it contains.
#[derive(Default)]
struct Model {
    session: &'static str,
    applied: Vec<u64>,
    /// The last record that was said to be recorded.
    acked: u64,
    /// The last record that was said to survive a loss of power.
    synced: u64,
    /// Which calls of [`Model::sync`] do nothing, a bit each.
    lazy: u32,
}

impl Model {
    fn checkpoint(&self, seq: u64) -> Checkpoint {
        let mut checkpoint = Checkpoint {
            seq,
            ..Checkpoint::default()
        };
        checkpoint.session.id = self.session.to_owned();
        checkpoint.snapshot.params = self
            .applied
            .iter()
            .map(|n| (n.to_string(), Value::Bool(true)))
            .collect();
        checkpoint
    }

    fn append(&mut self, store: &mut Store<SimFs>, count: u64) {
        let numbers: Vec<u64> = (1..=count).map(|nth| store.seq() + nth).collect();
        let entries: Vec<Entry> = numbers.iter().map(|n| entry(*n)).collect();
        self.applied.extend(numbers);
        if let Ok(seq) = store.append(&entries) {
            self.acked = seq;
        }
    }

    fn sync(&mut self, store: &mut Store<SimFs>) {
        self.lazy = self.lazy.rotate_right(1);
        if self.lazy >> 31 == 1 {
            return;
        }
        if let Some(job) = store.sync_job() {
            let _ = store.synced(job.run());
        }
        self.synced = store.synced_seq();
    }

    fn begin(&mut self, store: &mut Store<SimFs>) -> bool {
        let done = store.begin(&self.checkpoint(store.seq())).is_ok();
        if done {
            // All that had not been recorded while the disk failed is now.
            self.acked = store.seq();
            self.synced = store.seq();
        }
        done
    }
}

fn entry(number: u64) -> Entry {
    Entry::Call(Call::new("setParam", vec![number.to_string().into()]))
}

/// The set of numbers, in order of their application.
fn state(loaded: &Loaded) -> Vec<u64> {
    let snapshot = loaded
        .checkpoint
        .iter()
        .flat_map(|checkpoint| checkpoint.snapshot.params.keys());
    let mut numbers: Vec<u64> = snapshot.map(|key| key.parse().unwrap()).collect();
    for record in &loaded.records {
        match &record.entry {
            Entry::Call(call) => numbers.push(call.params[0].as_str().unwrap().parse().unwrap()),
            Entry::Session(_) => {}
        }
    }
    numbers
}

fn open(fs: &SimFs) -> Result<(Store<SimFs>, Option<Loaded>), OpenError> {
    Store::open_on(fs.clone(), Path::new(PATH))
}

/// Everything that a store does in its life. Each step goes on whatever became of the one before.
fn life(fs: &SimFs, model: &mut Model) {
    model.session = "a";
    let Ok((mut store, _)) = open(fs) else { return };
    model.begin(&mut store);
    model.append(&mut store, 1);
    model.append(&mut store, 3);
    model.sync(&mut store);
    model.append(&mut store, 1);
    // A compaction, with records before, while and after its file is written.
    if let Ok(job) = store.begin_compaction(model.checkpoint(store.seq())) {
        model.append(&mut store, 1);
        model.sync(&mut store);
        let done = job.run();
        model.append(&mut store, 2);
        model.sync(&mut store);
        model.append(&mut store, 1);
        let protected = store.unprotected().is_none();
        if store.finish_compaction(done).is_ok() && !protected {
            model.acked = store.seq();
        }
    }
    model.append(&mut store, 1);
    model.sync(&mut store);
    model.append(&mut store, 2);
    model.begin(&mut store);
    model.append(&mut store, 1);
    // A compaction that a new beginning overtakes.
    if let Ok(job) = store.begin_compaction(model.checkpoint(store.seq())) {
        model.append(&mut store, 1);
        model.begin(&mut store);
        model.append(&mut store, 1);
        let _ = store.finish_compaction(job.run());
    }
    model.append(&mut store, 1);
    model.sync(&mut store);
    // The process ends without a farewell, and another one goes on with what it finds.
    drop(store);
    let Ok((mut store, loaded)) = open(fs) else {
        return;
    };
    check(model, loaded.as_ref(), model.acked, "the second process");
    model.applied = loaded.as_ref().map(state).unwrap_or_default();
    model.begin(&mut store);
    model.append(&mut store, 2);
    let _ = store.close(&model.checkpoint(store.seq()));
}

/// What was found is all that was acknowledged up to `least`, and nothing that never was.
fn check(model: &Model, loaded: Option<&Loaded>, least: u64, context: &str) {
    let Some(loaded) = loaded else {
        assert_eq!(least, 0, "{context}: nothing is left");
        return;
    };
    let found = state(loaded);
    let known = found.len() as u64;
    let missing = model
        .applied
        .iter()
        .find(|n| **n <= least && !found.contains(n));
    assert_eq!(missing, None, "{context}: lost; {loaded:?}");
    if loaded.exact {
        assert_eq!(
            found,
            model.applied[..found.len()],
            "{context}: {known} records"
        );
    } else {
        assert!(!loaded.damage.is_empty(), "{context}: silent");
        assert!(
            found.iter().all(|n| model.applied.contains(n)),
            "{context}: invented"
        );
        assert!(found.is_sorted(), "{context}: out of order");
    }
}

/// Starts anew on `fs`, records one more, and finds all of it again.
fn go_on(fs: &SimFs, context: &str) {
    let (mut store, loaded) = open(fs).unwrap();
    let mut model = Model {
        session: "a",
        ..Model::default()
    };
    model.applied = loaded.as_ref().map(state).unwrap_or_default();
    assert!(model.begin(&mut store), "{context}");
    model.append(&mut store, 2);
    drop(store);
    let loaded = open(fs).unwrap().1.unwrap();
    assert!(
        loaded.exact && loaded.damage.is_empty(),
        "{context}: {loaded:?}"
    );
    assert_eq!(state(&loaded), model.applied, "{context}");
}

/// The number of operations in a whole [`life`].
fn operations() -> usize {
    let fs = SimFs::default();
    let mut model = Model::default();
    life(&fs, &mut model);
    let operations = fs.ops();
    let loaded = open(&fs).unwrap().1.unwrap();
    assert_eq!(state(&loaded), model.applied);
    assert_eq!(model.acked, model.applied.last().copied().unwrap());
    assert!(loaded.exact && loaded.damage.is_empty() && loaded.torn.is_none());
    operations
}

#[test]
fn killed_at_every_operation_nothing_acknowledged_is_lost() {
    let mut crashes = 0;
    let shares: &[usize] = if cfg!(debug_assertions) {
        &[0, 4]
    } else {
        &[0, 1, 4, 7, 8]
    };
    for at in 0..operations() {
        for &eighths in shares {
            let fs = SimFs::default();
            fs.arm(at, Fault::Kill(eighths));
            let mut model = Model::default();
            life(&fs, &mut model);
            let context = format!("killed at operation {at} with {eighths}/8 written");
            let loaded = open(&fs.after_kill()).unwrap().1;
            check(&model, loaded.as_ref(), model.acked, &context);
            if let Some(loaded) = &loaded {
                assert!(
                    loaded.exact && loaded.damage.is_empty(),
                    "{context}: {loaded:?}"
                );
            }
            go_on(&fs.after_kill(), &context);
            crashes += 1;

            // And killed again at every operation of the next start.
            let again = fs.after_kill();
            drop(open(&again).unwrap());
            for second in 0.. {
                let again = fs.after_kill();
                again.arm(second, Fault::Kill(4));
                if let Ok((mut store, loaded)) = open(&again) {
                    let mut model = Model {
                        session: "a",
                        ..Model::default()
                    };
                    model.applied = loaded.as_ref().map(state).unwrap_or_default();
                    model.begin(&mut store);
                }
                let reached = again.disarm();
                let loaded = open(&again.after_kill()).unwrap().1;
                let context = format!("{context}, then at operation {second}");
                check(&model, loaded.as_ref(), model.acked, &context);
                crashes += 1;
                if !reached {
                    break;
                }
            }
        }
    }
    println!("{crashes} crashes");
}

#[test]
fn without_power_at_every_operation_nothing_synced_is_lost() {
    let mut images = 0;
    let limit = if cfg!(debug_assertions) { 10 } else { 4_096 };
    // Synced always, never, and now and then.
    for lazy in [0, u32::MAX, 0b0110_0110, 0b1110_1110] {
        for at in 0..=operations() {
            let fs = SimFs::default();
            fs.arm(at, Fault::Kill(4));
            let mut model = Model {
                lazy,
                ..Model::default()
            };
            life(&fs, &mut model);
            for (nth, image) in fs.after_power_loss(limit).iter().enumerate() {
                let context = format!("no power at operation {at}, syncs {lazy:b}, image {nth}");
                let loaded = open(image)
                    .unwrap_or_else(|error| panic!("{context}: {error}"))
                    .1;
                check(&model, loaded.as_ref(), model.synced, &context);
                go_on(image, &context);
                images += 1;
            }
        }
    }
    println!("{images} images");
    assert!(images > 1_000);
}

#[test]
fn a_failing_disk_costs_only_what_was_said_to_be_unprotected() {
    let mut failures = 0;
    for errno in [ENOSPC, EIO, EROFS] {
        for fault in [Fault::Errno(errno), Fault::Once(errno), Fault::Short(errno)] {
            for at in 0..operations() {
                let fs = SimFs::default();
                fs.arm(at, fault);
                let mut model = Model::default();
                life(&fs, &mut model);
                let context = format!("{fault:?} at operation {at}");
                // A kill now: whatever had been acknowledged is there.
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
fn an_unprotected_store_says_so_and_can_be_rearmed() {
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
        // Nothing is tried on that file again, and a new one does not work either.
        model.append(&mut store, 1);
        assert!(store.sync_job().is_none() && !store.wants_compaction());
        assert!(store.rearm(&model.checkpoint(store.seq())).is_err());
        assert!(store.unprotected().is_some());
        fs.disarm();

        // Beside traffic: what comes while the new file is written is in it.
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
fn numbers_of_an_unprotected_time_are_never_used_again() {
    // Else the previous generation's whole records of a batch that failed would pass for new ones.
    let fs = SimFs::default();
    let mut model = Model::default();
    let (mut store, _) = open(&fs).unwrap();
    model.begin(&mut store);
    model.append(&mut store, 1);
    fs.arm(0, Fault::Short(ENOSPC));
    model.append(&mut store, 10);
    fs.disarm();
    store.rearm(&model.checkpoint(store.seq())).unwrap();
    model.append(&mut store, 1);
    assert_eq!(model.acked, 12);
    drop(store);
    let loaded = open(&fs).unwrap().1.unwrap();
    assert_eq!(state(&loaded), model.applied);
    assert_eq!(loaded.records.len(), 1);
}

#[test]
fn a_compaction_that_cannot_keep_up_is_given_up_in_bounded_memory() {
    let fs = SimFs::default();
    let mut model = Model::default();
    let (mut store, _) = open(&fs).unwrap();
    model.begin(&mut store);
    let job = store.begin_compaction(model.checkpoint(0)).unwrap();
    let large = Entry::Call(Call::new("setParam", vec!["x".repeat(1 << 20).into()]));
    for _ in 0..20 {
        store.append(std::slice::from_ref(&large)).unwrap();
        assert!(store.pending.as_ref().unwrap().meanwhile.len() <= MEANWHILE_BYTES_MAX);
    }
    let error = store.finish_compaction(job.run()).unwrap_err();
    assert!(matches!(error, StoreError::Overtaken { .. }));
    // Nothing is lost, and it is not tried again at once.
    assert!(store.unprotected().is_none() && !store.wants_compaction());
    drop(store);
    assert_eq!(open(&fs).unwrap().1.unwrap().records.len(), 20);
}

#[test]
fn a_job_that_was_overtaken_or_lost_is_in_nobodys_way() {
    let fs = SimFs::default();
    let mut model = Model::default();
    let (mut store, _) = open(&fs).unwrap();
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
fn a_session_is_set_aside_whole_or_not_at_all() {
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
