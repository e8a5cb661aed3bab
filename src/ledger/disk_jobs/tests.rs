use std::{cell::RefCell, ops::Range, panic::resume_unwind, sync::mpsc};

use checkpoint_store::StoreError;
use ros1_master::{
    master::{Master, Method, Request, Snapshot},
    xmlrpc::Value,
};

use super::*;

struct Disk {
    folder: tempfile::TempDir,
    durable: watch::Sender<u64>,
}

impl Disk {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let durable = watch::channel(0).0;
        Self { folder, durable }
    }

    /// A journal that records everything.
    fn journal(&self, sync: SyncPolicy) -> Journal {
        let path = self.folder.path().join("c");
        let mut store = Store::open(&path).unwrap().0;
        store.begin(&Checkpoint::default()).unwrap();
        Journal::new(store, self.durable.clone(), sync)
    }

    fn reached(&self) -> u64 {
        *self.durable.borrow()
    }

    /// The state that the next start would read.
    fn found(&self, journal: Journal) -> Snapshot {
        drop(journal);
        let path = self.folder.path().join("c");
        let loaded = Store::open(&path).unwrap().1.unwrap();
        rescue_core::checkpoint::session::rebuild(loaded.checkpoint, loaded.records)
            .mirror
            .snapshot()
    }
}

fn set(value: i32) -> Request {
    let key = format!("/p{value}");
    let params = [Value::from("/n"), key.as_str().into(), value.into()];
    Request::new(Method::SetParam, params)
}

/// The number of the record that sets this value. Each test begins with 0.
fn seq(value: i32) -> u64 {
    u64::try_from(value).unwrap() + 1
}

fn append(journal: &mut Journal, value: i32) {
    journal.append(vec![RecordContent::call(set(value))], seq(value));
}

/// The complete state after these values were set.
fn whole(values: Range<i32>) -> Checkpoint {
    let mut state = Master::default();
    let last = values.end - 1;
    for value in values {
        state.apply(&set(value));
    }
    Checkpoint {
        seq: seq(last),
        snapshot: state.snapshot(),
        ..Checkpoint::default()
    }
}

/// Begins a complete checkpoint.
fn begin_whole(
    journal: &mut Journal,
    values: Range<i32>,
) -> Option<oneshot::Receiver<Result<(), StoreError>>> {
    let checkpoint = whole(values);
    let last = checkpoint.seq;
    journal.run_whole(
        last,
        || checkpoint,
        |store, checkpoint| store.begin(&checkpoint),
    )
}

/// Writes a complete checkpoint.
fn rewrite(journal: &mut Journal, values: Range<i32>) {
    let done = begin_whole(journal, values);
    journal.store_queue().work();
    done.unwrap().try_recv().unwrap().unwrap();
}

fn unprotected(journal: &Journal) -> Option<String> {
    journal.seen().unprotected
}

#[test]
fn a_record_is_awaited_until_it_is_written_or_synced() {
    let disk = Disk::new();
    let mut journal = disk.journal(SyncPolicy::Interval);
    append(&mut journal, 0);
    assert_eq!(disk.reached(), 0);
    journal.store_queue().work();
    assert_eq!(disk.reached(), 1);

    let disk = Disk::new();
    let mut journal = disk.journal(SyncPolicy::Always);
    append(&mut journal, 0);
    journal.store_queue().work();
    assert_eq!(disk.reached(), 0);
    journal.run(|store| {
        let done = store.sync_job().unwrap().run();
        store.synced(done).unwrap();
    });
    journal.store_queue().work();
    assert_eq!(disk.reached(), 1);
    let state = whole(0..1).snapshot;
    assert_eq!(disk.found(journal), state);
}

#[test]
fn records_withheld_from_a_silent_disk_are_in_the_next_complete_checkpoint() {
    let disk = Disk::new();
    let mut journal = disk.journal(SyncPolicy::Interval);
    append(&mut journal, 0);
    // Nothing has been written yet.
    journal.give_up(seq(0));
    assert_eq!(disk.reached(), 1);
    append(&mut journal, 1);
    assert_eq!(disk.reached(), 2);
    // The disk answers again: only the first record is written.
    journal.store_queue().work();
    assert_eq!(unprotected(&journal).as_deref(), Some(SILENT));
    rewrite(&mut journal, 0..2);
    assert_eq!(unprotected(&journal), None);
    append(&mut journal, 2);
    journal.store_queue().work();
    let state = whole(0..3).snapshot;
    assert_eq!(disk.found(journal), state);
}

#[test]
fn a_whole_checkpoint_from_before_the_second_silence_protects_nothing() {
    let disk = Disk::new();
    let mut journal = disk.journal(SyncPolicy::Interval);
    journal.give_up(0);
    append(&mut journal, 0);
    let _done = begin_whole(&mut journal, 0..1);
    append(&mut journal, 1);
    journal.give_up(seq(1));
    append(&mut journal, 2);
    journal.store_queue().work();
    assert_eq!(unprotected(&journal).as_deref(), Some(SILENT));
    rewrite(&mut journal, 0..3);
    assert_eq!(unprotected(&journal), None);
    let state = whole(0..3).snapshot;
    assert_eq!(disk.found(journal), state);
}

#[test]
fn a_disk_that_is_given_too_much_is_given_up() {
    let disk = Disk::new();
    let mut journal = disk.journal(SyncPolicy::Interval);
    for value in 0..=2048 {
        append(&mut journal, value);
    }
    assert_eq!(unprotected(&journal).as_deref(), Some(SILENT));
    assert!(journal.run(|_| ()).is_none());
    journal.store_queue().work();
    rewrite(&mut journal, 0..2049);
    assert_eq!(unprotected(&journal), None);
    let state = whole(0..2049).snapshot;
    assert_eq!(disk.found(journal), state);
}

/// One thread runs all jobs. Another thread that arrives meanwhile does not wait for the disk.
#[test]
fn a_thread_that_comes_meanwhile_leaves_its_job_to_the_first() {
    let disk = Disk::new();
    let mut journal = disk.journal(SyncPolicy::Interval);
    let (go_on, hangs) = mpsc::sync_channel::<()>(1);
    let (began, begins) = mpsc::sync_channel::<()>(1);
    journal.run(move |_| {
        began.send(()).unwrap();
        hangs.recv().unwrap();
    });
    let queue = journal.store_queue();
    let first = thread::spawn(move || queue.work());
    begins.recv().unwrap();
    append(&mut journal, 0);
    journal.store_queue().work();
    assert_eq!(disk.reached(), 0);
    go_on.send(()).unwrap();
    first.join().unwrap();
    assert_eq!(disk.reached(), 1);
}

thread_local! {
    /// Dropped when its thread ends.
    static END: RefCell<Option<mpsc::SyncSender<()>>> = const { RefCell::new(None) };
}

#[test]
fn the_disks_thread_runs_jobs_as_they_come_and_ends_with_the_journal() {
    let disk = Disk::new();
    let mut journal = disk.journal(SyncPolicy::Interval);
    let (ended, ends) = mpsc::sync_channel(1);
    let mut end = Some(ended);
    for value in 0..3 {
        append(&mut journal, value);
        let (began, begins) = mpsc::sync_channel(1);
        let end = end.take();
        journal.run(move |_| {
            if end.is_some() {
                END.set(end);
            }
            began.send(thread::current().id()).unwrap();
        });
        journal.store_queue().wake();
        assert_ne!(begins.recv().unwrap(), thread::current().id());
        assert_eq!(disk.reached(), seq(value));
    }
    drop(journal);
    ends.recv().unwrap_err();
}

/// Queues a job that panics, without a message on standard error.
fn panic(journal: &Journal) -> oneshot::Receiver<()> {
    journal.run(|_| resume_unwind(Box::new("a bug"))).unwrap()
}

/// The job may have written half a record, after which no other one could be read.
#[test]
fn after_a_panic_records_are_in_the_next_complete_checkpoint() {
    for sync in [SyncPolicy::Interval, SyncPolicy::Always] {
        let disk = Disk::new();
        let mut journal = disk.journal(sync);
        let mut panicked = panic(&journal);
        append(&mut journal, 0);
        journal.store_queue().work();
        panicked.try_recv().unwrap_err();
        // No answer waits, and the status says why nothing is recorded.
        assert_eq!(disk.reached(), seq(0));
        assert!(unprotected(&journal).unwrap().contains(PANICKED));
        rewrite(&mut journal, 0..1);
        assert_eq!(unprotected(&journal), None);
        append(&mut journal, 1);
        journal.store_queue().work();
        let state = whole(0..2).snapshot;
        assert_eq!(disk.found(journal), state);
    }
}

#[test]
fn the_disks_thread_runs_jobs_after_one_that_panicked() {
    let disk = Disk::new();
    let journal = disk.journal(SyncPolicy::Interval);
    for _ in 0..3 {
        let panicked = panic(&journal);
        journal.store_queue().wake();
        panicked.blocking_recv().unwrap_err();
        let (ran, runs) = mpsc::sync_channel(1);
        journal.run(move |_| ran.send(()).unwrap());
        journal.store_queue().wake();
        runs.recv_timeout(Duration::from_secs(60)).unwrap();
    }
}
