//! Crashes at every operation, losses of power, and failing disks.

mod change_log;
mod faults;
mod moved;

use std::path::Path;

use super::generation::MEANWHILE_BYTES_MAX;
use super::sim::{Fault, SimFs};
use super::*;
use rescue_core::checkpoint::format::{Checkpoint, RecordContent, Session};
use ros1_master::{
    master::{Method, Request},
    xmlrpc::Value,
};

const PATH: &str = "/log/latest-chkpt.yaml";

/// What a store must contain. Record `n` sets the parameter `n`, so a state is a list of numbers.
#[derive(Default)]
struct Model {
    session: &'static str,
    applied: Vec<u64>,
    /// The last record that was acknowledged.
    acked: u64,
    /// The last record reported to survive a loss of power.
    synced: u64,
    /// Which calls of [`Model::sync`] do nothing, one bit per call.
    lazy: u32,
}

impl Model {
    fn checkpoint(&self, seq: u64) -> Checkpoint {
        let mut checkpoint = Checkpoint {
            seq,
            follows: true,
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
        let entries: Vec<RecordContent> = numbers.iter().map(|n| entry(*n)).collect();
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
            // A new generation also holds everything that could not be recorded while the disk failed.
            self.acked = store.seq();
            self.synced = store.seq();
        }
        done
    }
}

fn entry(number: u64) -> RecordContent {
    RecordContent::call(Request::new(Method::SetParam, [number.to_string()]))
}

/// The numbers that a loaded state contains, in the order in which they were applied.
fn state(loaded: &Loaded) -> Vec<u64> {
    let snapshot = loaded
        .checkpoint
        .iter()
        .flat_map(|checkpoint| checkpoint.snapshot.params.keys());
    let mut numbers: Vec<u64> = snapshot.map(|key| key.parse().unwrap()).collect();
    for record in &loaded.records {
        match &record.entry {
            RecordContent::Call { call, .. } => {
                numbers.push(call.text(0).unwrap().parse().unwrap())
            }
            RecordContent::Session(_) => {}
        }
    }
    numbers
}

fn open(fs: &SimFs) -> Result<(Store<SimFs>, Option<Loaded>), OpenError> {
    let opened = Store::open_on(fs.clone(), Path::new(PATH));
    opened.map(|(mut store, loaded)| {
        store.keep_log(1 << 20);
        (store, loaded)
    })
}

/// Does everything that a store does in its life. Each step runs whatever the result of the step before.
fn life(fs: &SimFs, model: &mut Model) {
    model.session = "a";
    let Ok((mut store, _)) = open(fs) else { return };
    model.begin(&mut store);
    model.append(&mut store, 1);
    model.append(&mut store, 3);
    model.sync(&mut store);
    model.append(&mut store, 1);
    // A compaction. Records are appended before, during and after the writing of its file.
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
    // A compaction that becomes obsolete because of a new `begin`.
    if let Ok(job) = store.begin_compaction(model.checkpoint(store.seq())) {
        model.append(&mut store, 1);
        model.begin(&mut store);
        model.append(&mut store, 1);
        let _ = store.finish_compaction(job.run());
    }
    model.append(&mut store, 1);
    model.sync(&mut store);
    // The process ends without closing the store, and another one continues with what it finds.
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

/// Checks that the loaded state has everything acknowledged up to `least`, and nothing that was never recorded.
fn check(model: &Model, loaded: Option<&Loaded>, least: u64, context: &str) {
    let Some(loaded) = loaded else {
        assert_eq!(least, 0, "{context}: no checkpoint is left");
        return;
    };
    let found = state(loaded);
    let known = found.len() as u64;
    let missing = model
        .applied
        .iter()
        .find(|n| **n <= least && !found.contains(n));
    assert_eq!(missing, None, "{context}: this record was lost; {loaded:?}");
    if loaded.exact {
        assert_eq!(
            found,
            model.applied[..found.len()],
            "{context}: the {known} records found"
        );
    } else {
        assert!(
            !loaded.damage.is_empty(),
            "{context}: the damage is not reported"
        );
        assert!(
            found.iter().all(|n| model.applied.contains(n)),
            "{context}: {found:?} has records that were never written"
        );
        assert!(found.is_sorted(), "{context}: {found:?} is out of order");
    }
}

/// Starts again on `fs`, appends two more records, and checks that a later start finds everything.
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

/// Number of operations in a complete [`life`].
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

/// Starts from what is left of `fs` and is killed, once at each operation of the start. Checks each time that
/// everything up to `least` is still there. Returns the number of kills.
fn starts_killed(fs: &SimFs, least: u64, context: &str) -> usize {
    let mut model = Model {
        session: "a",
        ..Model::default()
    };
    let loaded = open(&fs.after_kill()).unwrap().1;
    model.applied = loaded.as_ref().map(state).unwrap_or_default();
    for at in 0.. {
        let again = fs.after_kill();
        again.arm(at, Fault::Kill(4));
        if let Ok((mut store, _)) = open(&again) {
            model.begin(&mut store);
        }
        let reached = again.disarm();
        let loaded = open(&again.after_kill()).unwrap().1;
        let context = format!("{context}, then killed at operation {at}");
        check(&model, loaded.as_ref(), least, &context);
        if !reached {
            return at + 1;
        }
    }
    unreachable!("the start has a last operation")
}

#[test]
fn a_kill_at_any_operation_loses_nothing_that_was_acknowledged() {
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
            let context = format!("killed at operation {at}, with {eighths}/8 of the write done");
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

            crashes += starts_killed(&fs.after_kill(), model.acked, &context);
        }
    }
    println!("{crashes} crashes");
}

#[test]
fn a_loss_of_power_at_any_operation_loses_nothing_that_was_synced() {
    let mut images = 0;
    let limit = if cfg!(debug_assertions) { 10 } else { 4_096 };
    // Syncs always, never, and from time to time.
    for lazy in [0, u32::MAX, 0b0110_0110, 0b1110_1110, 0b1000] {
        for at in 0..=operations() {
            let fs = SimFs::default();
            fs.arm(at, Fault::Kill(4));
            let mut model = Model {
                lazy,
                ..Model::default()
            };
            life(&fs, &mut model);
            for (nth, image) in fs.after_power_loss(limit).iter().enumerate() {
                let context =
                    format!("power lost at operation {at}, skipped syncs {lazy:b}, image {nth}");
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
