//! The process of rosrescue. It dies, and the next one goes on with what the last one has written to the disk.

use std::{
    path::PathBuf,
    pin::Pin,
    task::{Context, Poll, Waker},
};

use checkpoint_store::{Loaded, Store, StoreError};
use rescue_core::checkpoint::session::{self, Rebuilt};
use tempfile::TempDir;

use super::*;
use crate::{recovery::examine::InAdvance, write_queue::dispatcher::Answers};

type Writing = Pin<Box<dyn Future<Output = Option<Result<(), StoreError>>>>>;

/// The disk with the checkpoint.
pub(super) struct Disk {
    folder: TempDir,
    is_writing: bool,
    /// A complete checkpoint that is being written.
    whole: Option<Writing>,
    /// Answers that wait for the disk.
    answers: Vec<Answers>,
    /// Whether it may be read-only for a while when rosrescue starts.
    may_be_read_only: bool,
    is_read_only: bool,
    has_been_read_only: bool,
}

impl Disk {
    pub(super) fn new(may_be_read_only: bool) -> Self {
        // A disk in memory, if there is one: each schedule has its own folder.
        let folder = TempDir::new_in("/dev/shm").or_else(|_| TempDir::new());
        Self {
            folder: folder.unwrap(),
            is_writing: false,
            whole: None,
            answers: Vec::new(),
            may_be_read_only,
            is_read_only: false,
            has_been_read_only: false,
        }
    }

    fn path(&self) -> PathBuf {
        self.folder.path().join("chkpt.yaml")
    }

    /// As [`begin`](crate::app::startup::begin).
    fn open(&self) -> (Option<Store>, Option<Loaded>) {
        if self.is_read_only {
            return (None, checkpoint_store::read(&self.path()).unwrap());
        }
        let (store, loaded) = Store::open(&self.path()).unwrap();
        (Some(store), loaded)
    }
}

/// The parts of rosrescue that end with its process.
pub(super) struct Parts {
    pub(super) ledger: Arc<Ledger>,
    pub(super) dispatcher: Dispatcher,
    pub(super) gate: gate::Rx,
    pub(super) recovery: Recovery,
    is_restored: bool,
}

impl Parts {
    /// Begins with what is on the disk.
    pub(super) fn begin(
        disk: Option<&Disk>,
        supervision: Supervision,
        writes: Writes,
        stats: &'static Stats,
    ) -> Self {
        let (store, loaded) = disk.map(Disk::open).unwrap_or_default();
        let rebuilt = loaded.map(|it| session::rebuild(it.checkpoint, it.records));
        let Rebuilt {
            mirror,
            session,
            pending,
            displaced,
            ..
        } = rebuilt.unwrap_or_default();
        let is_restored = session.is_some();
        let session = session.unwrap_or_else(|| Session {
            mark: "robot".to_owned(),
            ..Session::default()
        });
        let sync = SyncPolicy::Interval;
        let ledger = Arc::new(Ledger::new(mirror, session, pending, store, sync, stats));
        ledger.write_by_hand();
        if is_restored {
            ledger.set_unconfirmed();
            ledger.with_activity(|_, activity| activity.restore_displaced(displaced));
        }
        let patience = Patience::new(Duration::from_micros(PATIENCE));
        let examiner = Examiner {
            ledger: ledger.clone(),
            prepared: InAdvance::default(),
            run_id: Arc::default(),
            stats,
        };
        Self {
            dispatcher: Dispatcher::new(ledger.clone(), Arc::new(()), stats, writes, patience),
            gate: ledger.gate(),
            ledger,
            recovery: Recovery::new(examiner, supervision, is_restored),
            is_restored,
        }
    }
}

impl World {
    /// Lets the worker, whose parts are new, begin.
    pub(super) fn begin_worker(&mut self, is_restored: bool) {
        match &self.disk {
            Some(disk) if disk.is_read_only => {
                let time = 5_000 + self.dice.below(100_000);
                self.after(time, Event::DiskRecovers);
            }
            Some(_) => {
                // Before the first complete checkpoint nothing is answered.
                self.begin_checkpoint();
                self.disk_writes();
            }
            None => {}
        }
        let is_ours = self.recovery.supervision == Supervision::Ours;
        self.recover(lifecycle::Input::Start {
            left: is_ours && self.master.is_some(),
            restored: is_restored,
        });
    }

    /// The worker is killed.
    pub(super) fn worker_dies(&mut self) {
        let Some(disk) = self.disk.as_mut().filter(|_| !self.is_down) else {
            return;
        };
        // Only a living master keeps what the disk does not (decision 34).
        let is_kept = self.ledger.gate().is_open() && self.ledger.pending() == 0;
        if disk.has_been_read_only && !is_kept {
            return self.after(1_000, Event::WorkerDies);
        }
        disk.answers.clear();
        (disk.whole, disk.is_writing, self.is_down) = (None, false, true);
        self.print(|| "rosrescue dies".to_owned());
        if self.gate().is_injecting() {
            self.injection_breaks();
        }
        self.may_go_back = true;
        self.deaths += 1;
        // Clients send again what was not answered.
        let waiting = std::mem::take(&mut self.waiting).into_iter();
        let unwritten = std::mem::take(&mut self.unwritten).into_values();
        let calls = waiting.map(|it| (it.node, it.call));
        let calls: Vec<_> = calls
            .chain(unwritten.map(|it| (it.node, it.call)))
            .collect();
        for (node, call) in calls {
            if call.kind() != Kind::Read {
                self.sent_again.push(call.clone());
            }
            let time = 1_000 + self.dice.below(3_000);
            self.after(time, Event::Arrives(node, call));
        }
        self.bodies.retain(|_, event| {
            matches!(
                event,
                Event::Arrives(..)
                    | Event::MasterGets(..)
                    | Event::Heard(..)
                    | Event::MasterNotifies(..)
                    | Event::TakenFromMaster(..)
                    | Event::Dies
                    | Event::Breaks
                    | Event::Bypasses
                    | Event::NodeRestarts
                    | Event::Compares
                    | Event::WorkerDies
                    | Event::DiskFails
                    | Event::Recovery(recovery::Event::Started | recovery::Event::Exits(_))
            )
        });
        (self.in_flight, self.next_tick) = (None, None);
        // The store must release its lock.
        self.ledger.drop_jobs();
        self.replace(false);
        self.ports.clear();
        let time = 3_000 + self.dice.below(80_000);
        self.after(time, Event::WorkerStarts);
    }

    /// Replaces the parts that end with the process, with those of a process that reads the disk or does not. Returns
    /// whether there was a state.
    fn replace(&mut self, reads: bool) -> bool {
        let disk = self.disk.as_ref().filter(|_| reads);
        let (supervision, numbers) = (self.recovery.supervision, self.recovery.numbers());
        let parts = Parts::begin(disk, supervision, self.writes, self.stats);
        self.ledger = parts.ledger;
        (self.dispatcher, self.gate) = (parts.dispatcher, parts.gate);
        self.recovery = parts.recovery;
        self.recovery.go_on_from(numbers);
        parts.is_restored
    }

    /// The next worker starts.
    pub(super) fn worker_starts(&mut self) {
        let disk = self.disk.as_mut().filter(|disk| disk.may_be_read_only);
        if let Some(disk) = disk {
            disk.is_read_only = self.dice.one_in(2);
            disk.has_been_read_only |= disk.is_read_only;
        }
        let is_read_only = self.disk.as_ref().is_some_and(|disk| disk.is_read_only);
        self.print(|| format!("rosrescue starts, the disk is read-only: {is_read_only}"));
        let is_restored = self.replace(true);
        self.is_down = false;
        self.begin_worker(is_restored);
    }

    /// Gives answers once the disk has what they need.
    pub(super) fn give(&mut self, answers: Answers) {
        match &mut self.disk {
            Some(disk) if (answers.mark, answers.version) != (None, None) => {
                disk.answers.push(answers);
            }
            _ => answers.give(true),
        }
    }

    /// Lets the disk begin what is due.
    pub(super) fn wake_disk(&mut self) {
        let Some(disk) = &self.disk else { return };
        if !disk.is_read_only && disk.whole.is_none() && self.ledger.checkpoint_due() {
            self.begin_checkpoint();
        }
        let Some(disk) = &mut self.disk else { return };
        if !disk.is_writing && self.ledger.has_jobs() {
            disk.is_writing = true;
            let time = match self.dice.below(30) {
                0 => self.dice.below(200_000),
                1..4 => self.dice.below(10_000),
                _ => 10 + self.dice.below(100),
            };
            self.after(time, Event::DiskWrites);
        }
        self.give_safe();
    }

    pub(super) fn disk_writes(&mut self) {
        self.ledger.run_jobs();
        let Some(disk) = &mut self.disk else { return };
        disk.is_writing = false;
        self.poll_checkpoint();
        self.give_safe();
        self.disk_has_written();
    }

    pub(super) fn disk_fails(&mut self) {
        // Only a living master keeps what the disk does not.
        if !self.is_down && self.gate().is_open() {
            if self.ledger.pending() > 0 {
                return self.after(1_000, Event::DiskFails);
            }
            self.print(|| "the disk fails".to_owned());
            // If the journal does not know which writes the master has run, and the next process does not learn it either,
            // it runs them again (decision 53).
            self.ledger.record_acknowledged();
            self.ledger.run_jobs();
            self.ledger.give_up_disk();
            let time = 5_000 + self.dice.below(100_000);
            self.after(time, Event::DiskRecovers);
        }
    }

    pub(super) fn disk_recovers(&mut self) {
        if self.is_down {
            return;
        }
        let disk = self.disk.as_mut().filter(|disk| disk.is_read_only);
        if let Some(disk) = disk {
            disk.is_read_only = false;
            self.ledger
                .set_store(Store::open_over(&disk.path()).unwrap());
        }
        self.begin_checkpoint();
    }

    fn begin_checkpoint(&mut self) {
        let ledger = self.ledger.clone();
        let write = async move {
            ledger
                .on_store_whole(|store, checkpoint| store.begin(&checkpoint))
                .await
        };
        if let Some(disk) = &mut self.disk {
            disk.whole = Some(Box::pin(write));
        }
        self.poll_checkpoint();
    }

    fn poll_checkpoint(&mut self) {
        let disk = self.disk.as_mut();
        let Some(whole) = disk.and_then(|disk| disk.whole.as_mut()) else {
            return;
        };
        let context = &mut Context::from_waker(Waker::noop());
        if let Poll::Ready(result) = whole.as_mut().poll(context) {
            let result = result.expect("there is a store");
            self.ledger.set_attempted(result.as_ref().map(|_| ()));
            if let Some(disk) = &mut self.disk {
                disk.whole = None;
            }
        }
    }

    fn give_safe(&mut self) {
        let Some(disk) = &mut self.disk else { return };
        let (safe, waiting): (Vec<_>, Vec<_>) = std::mem::take(&mut disk.answers)
            .into_iter()
            .partition(|answers| {
                let waits = answers.mark.and_then(|mark| self.ledger.to_await(mark));
                let is_written = |version| self.ledger.has_attempted(version);
                waits.is_none() && answers.version.is_none_or(is_written)
            });
        disk.answers = waiting;
        for answers in safe {
            answers.give(true);
        }
        self.collect();
    }
}
