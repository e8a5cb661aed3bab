//! The supervised rosmaster: our child, or one that an earlier rosrescue left running.

use std::time::Duration;

use tokio::{sync::mpsc, time::Instant};

use crate::{
    ledger::Ledger,
    limit::rarely,
    process::{self, ProcessError, Rosmaster, Spare},
    ros_env::MasterUri,
    upstream::Upstream,
    wait,
};

/// A spare is started so long after a master: a recovery and the health check need the processor.
const SPARE_AFTER: Duration = Duration::from_secs(2);

/// A child's process id, and how it ended.
type End = (u32, String);

/// The master that rosrescue starts and ends.
#[derive(Debug)]
pub(crate) struct MasterProcess {
    rosmaster: Rosmaster,
    /// Port of the last master. Tried first, so that the address stays the same.
    port: Option<u16>,
    /// Our child, or the master that was left running, until its end is reported.
    current: Option<u32>,
    /// Our child, until it is called for the first time.
    new: Option<i32>,
    ends: (mpsc::Sender<End>, mpsc::Receiver<End>),
    spare: Option<Spare>,
    /// When to start one.
    spare_at: Option<Instant>,
    /// How the last master ended, until it is reported.
    end: Option<String>,
}

impl MasterProcess {
    /// Starts masters with `rosmaster`. The last one was at `port`, and still runs as process `left`, if that is
    /// given.
    pub(crate) fn new(rosmaster: Rosmaster, port: Option<u16>, left: Option<u32>) -> Self {
        let this = Self {
            rosmaster,
            port,
            current: left,
            new: None,
            ends: mpsc::channel(4),
            spare: None,
            spare_at: left.map(|_| Instant::now() + SPARE_AFTER),
            end: None,
        };
        if let (Some(pid), Some(port)) = (left, port) {
            tracing::info!(pid, port, "an earlier rosrescue left its rosmaster running");
            this.watch(pid, async move {
                process::ended(pid).await;
                "it was no child of this rosrescue".to_owned()
            });
        }
        this
    }

    /// Whether a master of an earlier rosrescue is running.
    pub(crate) fn is_left(&self) -> bool {
        self.current.is_some()
    }

    /// Reports the end of `pid`, for which `end` waits.
    fn watch(&self, pid: u32, end: impl Future<Output = String> + Send + 'static) {
        let ends = self.ends.0.clone();
        tokio::spawn(async move {
            // The receiver is gone only at shutdown.
            let _ = ends.send((pid, end.await)).await;
        });
    }

    /// Starts a master and returns its address.
    pub(crate) fn spawn(
        &mut self,
        ledger: &Ledger,
        upstream: &Upstream,
    ) -> Result<(), ProcessError> {
        let port = self.rosmaster.choose_port(self.port)?;
        let address = MasterUri {
            host: "127.0.0.1".to_owned(),
            port,
        };
        let uri = address.to_string();
        upstream.relocate(address);
        if ledger.session().master_uri.as_ref() != Some(&uri) {
            // Recorded before it runs: if rosrescue dies now, the next one can find the master.
            ledger.update_session(|session| session.master_uri = Some(uri));
        }
        let mut child = match self.spare.take().and_then(|spare| spare.go(port)) {
            Some(child) => child,
            None => self.rosmaster.spawn(port)?,
        };
        self.spare_at = Some(Instant::now() + SPARE_AFTER);
        let pid = child.id().unwrap_or_default();
        rarely!(info, pid, port, "started rosmaster");
        self.watch(pid, async move {
            match child.wait().await {
                Ok(status) => process::describe(status),
                Err(error) => error.to_string(),
            }
        });
        self.port = Some(port);
        self.current = Some(pid);
        self.new = i32::try_from(pid).ok();
        Ok(())
    }

    /// The process id of a master that was started since the last call.
    pub(crate) fn take_new(&mut self) -> Option<i32> {
        self.new.take()
    }

    /// How the last master ended, once.
    pub(crate) fn take_end(&mut self) -> Option<String> {
        self.end.take()
    }

    /// Returns when the master has ended. Cancel safe.
    pub(crate) async fn exited(&mut self) {
        let how = loop {
            let spare_at = self.spare_at;
            tokio::select! {
                how = self.gone() => break how,
                () = wait::until(spare_at) => {
                    self.spare_at = None;
                    self.spare = self.rosmaster.spawn_spare();
                }
            }
        };
        rarely!(warn, pid = self.current, how, "rosmaster has ended");
        self.end = Some(how);
        self.current = None;
        self.new = None;
    }

    /// Returns how the master ended, when it has ended. Cancel safe.
    async fn gone(&mut self) -> String {
        loop {
            match self.ends.1.recv().await {
                Some((pid, how)) if Some(pid) == self.current => return how,
                Some(_) => {}
                // Never: we hold a sender.
                None => std::future::pending().await,
            }
        }
    }

    pub(crate) fn kill(&self) {
        // A child's process id cannot be reused before its end is reported. For a master that was left
        // running this holds except for a moment between its end and the report.
        if let Some(pid) = self.current {
            rarely!(
                warn,
                pid,
                "the master does not answer, and is killed; a new one is started"
            );
            process::signal_process(pid, rustix::process::Signal::KILL);
        }
    }

    /// Stops the master in order.
    pub(crate) async fn stop(mut self) {
        self.spare = None;
        if let Some(pid) = self.current {
            process::stop(pid, self.gone()).await;
        }
    }

    /// The last output of the last master.
    pub(crate) fn last_words(&self) -> String {
        self.rosmaster.last_words()
    }
}
