//! The log of replaced generations under kills and failing disks.

use std::collections::BTreeSet;

use super::*;
use crate::change_log::files_on;
use rescue_core::checkpoint::format;

/// The numbers of all records in the history, from the files of the log and the checkpoint. Checks that each snapshot
/// and record is what was written.
fn history(fs: &SimFs, model: &Model, context: &str) -> BTreeSet<u64> {
    let names = Names { path: PATH.into() };
    let mut numbers = BTreeSet::new();
    for file in files_on(fs, &names).unwrap() {
        let Ok(bytes) = file.read_on(fs) else {
            continue;
        };
        let decoded = format::decode(&bytes).unwrap_or_else(|_| panic!("{context}: {file:?}"));
        assert!(decoded.damaged.is_empty(), "{context}: {decoded:?}");
        let loaded = Loaded {
            checkpoint: decoded.checkpoint.ok(),
            records: decoded.records,
            ..Loaded::default()
        };
        let Some(first) = loaded.checkpoint.as_ref().map(|checkpoint| checkpoint.seq) else {
            continue;
        };
        let found = state(&loaded);
        assert_eq!(found, model.applied[..found.len()], "{context}: {file:?}");
        numbers.extend(found.into_iter().filter(|number| *number > first));
    }
    numbers
}

#[test]
fn a_kill_at_any_operation_loses_no_record_of_the_history() {
    for at in 0..operations() {
        let fs = SimFs::default();
        fs.arm(at, Fault::Kill(4));
        let mut model = Model::default();
        life(&fs, &mut model);
        let fs = fs.after_kill();
        let context = format!("killed at operation {at}");
        let missing = |fs: &SimFs, model: &Model| {
            let history = history(fs, model, &context);
            (1..=model.acked).find(|number| !history.contains(number))
        };
        assert_eq!(missing(&fs, &model), None, "{context}");
        // The next process adds what the log lacks, and goes on.
        let (mut store, loaded) = open(&fs).unwrap();
        let mut model = Model {
            session: "a",
            acked: model.acked,
            ..Model::default()
        };
        model.applied = loaded.as_ref().map(state).unwrap_or_default();
        for _ in 0..4 {
            assert!(model.begin(&mut store));
            model.append(&mut store, 1);
        }
        assert_eq!(store.take_log_trouble(), None, "{context}");
        drop(store);
        assert_eq!(missing(&fs, &model), None, "{context}, then continued");
    }
}

#[test]
fn records_that_follow_share_a_part_and_a_change_without_a_record_begins_another() {
    let fs = SimFs::default();
    let mut model = Model {
        session: "a",
        ..Model::default()
    };
    let (mut store, _) = open(&fs).unwrap();
    let parts = |fs: &SimFs| {
        let names = Names { path: PATH.into() };
        names.log_parts(fs).unwrap()
    };
    for _ in 0..5 {
        model.begin(&mut store);
        model.append(&mut store, 2);
    }
    assert_eq!(parts(&fs), [(1, false)]);
    let changed = Checkpoint {
        follows: false,
        ..model.checkpoint(store.seq())
    };
    store.begin(&changed).unwrap();
    model.append(&mut store, 2);
    for _ in 0..2 {
        model.begin(&mut store);
        model.append(&mut store, 2);
    }
    assert_eq!(parts(&fs), [(1, true), (2, false)]);
    assert_eq!(history(&fs, &model, "").len(), model.applied.len());
}

#[test]
fn the_oldest_parts_are_removed_and_a_full_disk_costs_the_log_and_nothing_else() {
    let fs = SimFs::default();
    let mut model = Model {
        session: "a",
        ..Model::default()
    };
    let (mut store, _) = open(&fs).unwrap();
    store.keep_log(4096);
    let names = Names { path: PATH.into() };
    for _ in 0..40 {
        model.begin(&mut store);
        model.append(&mut store, 5);
        model.applied.truncate(10);
        let parts = names.log_parts(&fs).unwrap().into_iter();
        let size = parts.map(|(number, closed)| match closed {
            true => fs.length_at(&names.closed_log_part(number)).unwrap(),
            false => fs.length_at(&names.log_part(number)).unwrap(),
        });
        assert!(size.sum::<u64>() <= 4096);
    }
    let parts = names.log_parts(&fs).unwrap();
    assert!(parts.len() > 1 && parts[0].0 > 1, "{parts:?}");
    // One of the next operations is the write of the new generation.
    let is_over = |at: usize| {
        fs.arm(at, Fault::Once(28));
        let begun = model.begin(&mut store);
        fs.disarm();
        let trouble = store.take_log_trouble();
        let removed = trouble.is_some_and(|trouble| trouble.contains("the disk is full"));
        assert!(!removed || begun && store.unprotected().is_none());
        removed
    };
    assert!((0..9).any(is_over));
    assert!(names.log_parts(&fs).unwrap().len() <= 1);
}

#[test]
fn a_failure_of_any_operation_on_the_log_leaves_the_checkpoint_whole() {
    for at in 0..operations() {
        let fs = SimFs::default();
        fs.arm(at, Fault::Once(5));
        let mut model = Model::default();
        life(&fs, &mut model);
        let context = format!("operation {at} failed once");
        let loaded = open(&fs.after_kill()).unwrap().1;
        check(&model, loaded.as_ref(), model.acked, &context);
    }
}
