//! What the tasks of this process share, and how recovery and roscore's other duties are started from it.

use std::{
    path::PathBuf,
    sync::{Arc, atomic::AtomicU32},
    time::Duration,
};

use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use super::master_duties::MasterDuties;
use crate::{
    gate,
    ledger::{Ledger, history::Rescues},
    nodes::{Nodes, served::Served},
    process::Rosmaster,
    recovery::{
        Driver,
        course::Step,
        examine::{Examiner, InAdvance},
        live_master::Reach,
        master_process::MasterProcess,
    },
    roscore::{self, Roscore},
    status::{Board, stats::Stats},
    wait,
    write_queue::WriteQueue,
};

/// How long a start searches all processes for a rosmaster that an earlier rosrescue left running. Reading one process's
/// environment can take 200 ms on a busy computer.
const SEARCH: Duration = Duration::from_secs(10);

/// What the tasks of this process share, and the settings of the tasks that manage the master.
pub(super) struct Context {
    pub(super) ledger: Arc<Ledger>,
    pub(super) gate: gate::Rx,
    pub(super) write_queue: WriteQueue,
    pub(super) nodes: Arc<Nodes>,
    pub(super) served: Served,
    pub(super) board: Arc<Board>,
    pub(super) stats: &'static Stats,
    pub(super) reach: Reach,
    /// Maximum disk space for the checkpoints kept from rescues, in bytes.
    pub(super) history: u64,
    pub(super) uri: String,
    pub(super) checkpoint: PathBuf,
    pub(super) node_timeout: Duration,
}

impl Context {
    pub(super) fn driver(&self, process: Option<MasterProcess>) -> Driver {
        Driver::new(
            Examiner {
                ledger: self.ledger.clone(),
                prepared: InAdvance::default(),
                run_id: Arc::default(),
                stats: self.stats,
            },
            self.reach.clone(),
            self.write_queue.clone(),
            self.nodes.clone(),
            self.board.clone(),
            process,
            Rescues::new(self.ledger.clone(), self.history),
        )
    }

    /// Starts roscore's other duties, until `stop`. If `seeds` is true and there is no run id, a new run id is set.
    pub(super) fn roscore(
        &self,
        rosout: bool,
        seeds: bool,
        stop: CancellationToken,
    ) -> JoinHandle<()> {
        let roscore = Roscore {
            ledger: self.ledger.clone(),
            write_queue: self.write_queue.clone(),
            gate: self.gate.clone(),
            uri: self.uri.clone(),
            checkpoint: self.checkpoint.clone(),
            node_timeout: self.node_timeout,
            rosout: AtomicU32::new(0),
        };
        if seeds {
            roscore::seed_run_id(&roscore);
        }
        crate::task::spawn(roscore::run(roscore, rosout, stop))
    }

    /// Creates the driver of a single computer, with its first actions.
    ///
    /// `rosmaster` starts masters, and is `None` for an external master. The last master was at `port`. `rosout` says
    /// whether to run rosout; `None` skips all of roscore's other duties. `restored` says whether the mirror comes from
    /// a checkpoint whose session continues. When the first token of `ends` is cancelled, rosout is stopped, and then
    /// the second token is cancelled.
    pub(super) async fn start_single(
        &self,
        rosmaster: Option<Rosmaster>,
        port: Option<u16>,
        rosout: Option<bool>,
        restored: bool,
        ends: (CancellationToken, CancellationToken),
    ) -> (Driver, Vec<Step>) {
        let process = match rosmaster {
            Some(rosmaster) => {
                let mut process = MasterProcess::new(rosmaster.clone(), port);
                let writable = self.ledger.seen_store().is_some();
                let claim = move || rosmaster.claim_orphan(port, writable);
                if let Some(orphan) = wait::within(SEARCH, claim).await.flatten() {
                    process.adopt(orphan, &self.ledger, &self.reach.upstream);
                }
                Some(process)
            }
            None => None,
        };
        let has_orphan = process.as_ref().is_some_and(MasterProcess::is_orphan);
        let (stop, halt) = ends;
        let duties = rosout.map(|rosout| self.roscore(rosout, !has_orphan, stop.clone()));
        crate::task::spawn(async move {
            stop.cancelled().await;
            if let Some(duties) = duties {
                // A panic in that task must not prevent the stop.
                let _ = duties.await;
            }
            halt.cancel();
        });
        let mut driver = self.driver(process);
        if restored {
            driver.continues_session();
        }
        let first = driver.start(restored);
        (driver, first)
    }

    /// Starts recovery on one computer of several: a new master gets the mirror's state.
    ///
    /// `rosout` says whether to run rosout; `None` skips all of roscore's other duties. `cause` is the reason that
    /// reports give.
    pub(super) fn begin(
        &self,
        process: MasterProcess,
        rosout: Option<bool>,
        cause: &'static str,
    ) -> MasterDuties {
        let stop = CancellationToken::new();
        let roscore_stop = stop.child_token();
        let roscore = rosout.map(|rosout| self.roscore(rosout, true, roscore_stop.clone()));
        let mut driver = self.driver(Some(process));
        let first = driver.take_over(cause);
        MasterDuties {
            driver: crate::task::spawn(driver.run(first, stop.clone())),
            roscore,
            roscore_stop,
            stop,
        }
    }
}
