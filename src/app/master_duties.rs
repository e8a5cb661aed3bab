//! Recovery and roscore's other duties while this computer, one of several, has the master.

use tokio::task::{JoinError, JoinHandle};
use tokio_util::sync::CancellationToken;

use crate::{process::ProcessError, recovery::master_process::MasterProcess};

/// Runs recovery and roscore's other duties (rosout and the run id) while this computer, one of several, has the
/// master.
pub(super) struct MasterDuties {
    pub(super) driver: JoinHandle<Result<Option<MasterProcess>, ProcessError>>,
    pub(super) roscore: Option<JoinHandle<()>>,
    pub(super) roscore_stop: CancellationToken,
    pub(super) stop: CancellationToken,
}

impl MasterDuties {
    /// Waits until recovery fails by itself, and returns the error. Cancel safe.
    pub(super) async fn failed(&mut self) -> ProcessError {
        match (&mut self.driver).await {
            Ok(Err(error)) => error,
            // Without an error the driver ends only after `stop`.
            Ok(Ok(_)) => std::future::pending().await,
            Err(panic) => resume(panic),
        }
    }

    /// Stops roscore's other duties while calls still pass to the master, because rosout unregisters itself when it
    /// stops.
    pub(super) fn end_roscore(&mut self) -> impl Future<Output = ()> + Send + 'static {
        self.roscore_stop.cancel();
        let roscore = self.roscore.take();
        async move {
            if let Some(roscore) = roscore {
                // A panic in that task must not prevent the rest.
                let _ = roscore.await;
            }
        }
    }

    /// Stops recovery and roscore's other duties, and kills the master at once: another computer may lead, and no node
    /// may hear from this computer's master any more. The returned future waits for the processes.
    pub(super) async fn stop_and_kill_master(self) -> impl Future<Output = ()> + Send + 'static {
        self.stop.cancel();
        let process = match self.driver.await {
            Ok(ended) => ended.ok().flatten(),
            Err(panic) => resume(panic),
        };
        let ended = process.map(MasterProcess::kill_and_wait);
        async move {
            if let Some(roscore) = self.roscore {
                // A panic in that task must not prevent the rest.
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
        Err(_) => unreachable!("the task is never aborted"),
    }
}
