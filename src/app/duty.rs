//! What the computer does that has the master: recovery, and what roscore does besides.

use std::{
    path::PathBuf,
    sync::{Arc, atomic::AtomicU32},
    time::Duration,
};

use tokio::{
    sync::Notify,
    task::{JoinError, JoinHandle, spawn_blocking},
};
use tokio_util::sync::CancellationToken;

use crate::{
    gate,
    ledger::{Ledger, history::Rescues},
    lifecycle::{Action, Probing, Supervision},
    nodes::Nodes,
    process::{ProcessError, Rosmaster},
    recovery::{Driver, examine::Examiner, master_process::MasterProcess},
    roscore::{self, Roscore},
    status::{Board, stats::Stats},
    upstream::Upstream,
    write_queue::WriteQueue,
};

/// What the duty needs.
pub(super) struct Post {
    pub(super) ledger: Arc<Ledger>,
    pub(super) upstream: Arc<Upstream>,
    pub(super) gate_tx: gate::Tx,
    pub(super) gate: gate::Rx,
    pub(super) write_queue: WriteQueue,
    pub(super) slow: Arc<Notify>,
    pub(super) nodes: Arc<Nodes>,
    pub(super) board: Arc<Board>,
    pub(super) stats: &'static Stats,
    pub(super) supervision: Supervision,
    pub(super) probing: Probing,
    pub(super) probe_timeout: Duration,
    /// Most space for the states of rescues, in bytes.
    pub(super) history: u64,
    pub(super) uri: String,
    pub(super) checkpoint: PathBuf,
    pub(super) node_timeout: Duration,
}

impl Post {
    pub(super) fn driver(&self, process: Option<MasterProcess>) -> Driver {
        Driver::new(
            Examiner {
                ledger: self.ledger.clone(),
                upstream: self.upstream.clone(),
                gate: self.gate_tx.clone(),
                supervision: self.supervision,
                probing: self.probing,
                probe_timeout: self.probe_timeout,
                stats: self.stats,
            },
            self.write_queue.clone(),
            Arc::clone(&self.slow),
            self.nodes.clone(),
            self.board.clone(),
            process,
            Rescues::new(self.ledger.clone(), self.history),
        )
    }

    /// Does what roscore does besides, until `stop`. `seeds`: whether the run id is set if there is none.
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
        tokio::spawn(roscore::run(roscore, rosout, stop))
    }

    /// The driver of the only computer, with what is to be done first. `rosmaster` starts masters, of which the
    /// last one was at `port`; none for a master of others. `rosout`: whether it runs rosout, too; none for
    /// nothing of what roscore does. `restored`: the mirror is from a checkpoint whose session continues. At the
    /// first of `ends` rosout is ended, then the second is cancelled.
    pub(super) async fn alone(
        self,
        rosmaster: Option<Rosmaster>,
        port: Option<u16>,
        rosout: Option<bool>,
        restored: bool,
        ends: (CancellationToken, CancellationToken),
    ) -> (Driver, Vec<Action>) {
        let process = match rosmaster {
            Some(rosmaster) => {
                let starter = rosmaster.clone();
                let left = spawn_blocking(move || rosmaster.left_behind(port)).await;
                Some(MasterProcess::new(starter, port, left.unwrap_or_default()))
            }
            None => None,
        };
        let left = process.as_ref().is_some_and(MasterProcess::is_left);
        let (stop, halt) = ends;
        let duties = rosout.map(|rosout| self.roscore(rosout, !left, stop.clone()));
        tokio::spawn(async move {
            stop.cancelled().await;
            if let Some(duties) = duties {
                // A panic there must not prevent the stop.
                let _ = duties.await;
            }
            halt.cancel();
        });
        let mut driver = self.driver(process);
        let first = driver.start(restored);
        (driver, first)
    }

    /// Begins the duty of one computer among several, with a master of its own that is given the mirror's
    /// state. `rosout`: whether it runs rosout, too; none for nothing of what roscore does. `cause`: why it
    /// begins.
    pub(super) fn begin(
        &self,
        process: MasterProcess,
        rosout: Option<bool>,
        cause: &'static str,
    ) -> Duty {
        let stop = CancellationToken::new();
        let roscore_stop = stop.child_token();
        let roscore = rosout.map(|rosout| self.roscore(rosout, true, roscore_stop.clone()));
        let mut driver = self.driver(Some(process));
        let first = driver.take_over(cause);
        Duty {
            driver: tokio::spawn(driver.run(first, stop.clone())),
            roscore,
            roscore_stop,
            stop,
        }
    }
}

/// The duty of one computer among several.
pub(super) struct Duty {
    driver: JoinHandle<Result<Option<MasterProcess>, ProcessError>>,
    roscore: Option<JoinHandle<()>>,
    roscore_stop: CancellationToken,
    stop: CancellationToken,
}

impl Duty {
    /// Returns when it has ended by itself, which is an error. Cancel safe.
    pub(super) async fn failed(&mut self) -> ProcessError {
        match (&mut self.driver).await {
            Ok(Err(error)) => error,
            // It ends only by `stop` otherwise.
            Ok(Ok(_)) => std::future::pending().await,
            Err(panic) => resume(panic),
        }
    }

    /// Ends what roscore does besides, while calls still pass to the master: rosout unregisters itself there.
    pub(super) fn end_roscore(&mut self) -> impl Future<Output = ()> + Send + 'static {
        self.roscore_stop.cancel();
        let roscore = self.roscore.take();
        async move {
            if let Some(roscore) = roscore {
                // A panic there must not prevent the rest.
                let _ = roscore.await;
            }
        }
    }

    /// Ends it, and the master at once: another computer may lead, and no node is to hear this one's master any
    /// more. What is returned waits for the processes.
    pub(super) async fn end(self) -> impl Future<Output = ()> + Send + 'static {
        self.stop.cancel();
        let process = match self.driver.await {
            Ok(ended) => ended.ok().flatten(),
            Err(panic) => resume(panic),
        };
        let ended = process.map(MasterProcess::end);
        async move {
            if let Some(roscore) = self.roscore {
                // A panic there must not prevent the rest.
                let _ = roscore.await;
            }
            if let Some(ended) = ended {
                ended.await;
            }
        }
    }
}

fn resume(error: JoinError) -> ! {
    match error.try_into_panic() {
        Ok(panic) => std::panic::resume_unwind(panic),
        Err(_) => unreachable!("nobody aborts it"),
    }
}
