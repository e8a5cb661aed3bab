//! The supervised rosmaster: a child of ours, or one that an earlier rosrescue left to us.

use tokio::sync::mpsc;

use crate::{
    ledger::Ledger,
    process::{self, ProcessError, Rosmaster},
    ros_env::MasterUri,
    upstream::Upstream,
};

/// A child's process id, and how it ended.
type End = (u32, String);

/// The master that we start, and end.
#[derive(Debug)]
pub(crate) struct MasterProcess {
    rosmaster: Rosmaster,
    /// Port of the last master; tried first, so that whoever looks finds it where it was.
    port: Option<u16>,
    /// Our child, or what was left to us, while it has not been reported gone.
    current: Option<u32>,
    /// Our child, while nobody has spoken to it.
    new: Option<i32>,
    /// Ends of processes.
    ends: (mpsc::Sender<End>, mpsc::Receiver<End>),
}

impl MasterProcess {
    /// Starts masters with `rosmaster`; the last one was at `port`, and may be there still.
    pub(crate) fn new(rosmaster: Rosmaster, port: Option<u16>) -> Self {
        let left = rosmaster.left_behind(port);
        let this = Self {
            rosmaster,
            port,
            current: left,
            new: None,
            ends: mpsc::channel(4),
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

    /// Whether a master of an earlier rosrescue is there.
    pub(crate) fn is_left(&self) -> bool {
        self.current.is_some()
    }

    /// Tells of the end of `pid`, which `end` waits for.
    fn watch(&self, pid: u32, end: impl Future<Output = String> + Send + 'static) {
        let ends = self.ends.0.clone();
        tokio::spawn(async move {
            // The receiver is gone only when nobody cares any more.
            let _ = ends.send((pid, end.await)).await;
        });
    }

    /// Starts a master, and tells where it is.
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
            // Before it runs: a rosrescue that dies now leaves a master that the next one can find.
            ledger.update_session(|session| session.master_uri = Some(uri));
        }
        let mut child = self.rosmaster.spawn(port)?;
        let pid = child.id().unwrap_or_default();
        tracing::info!(pid, port, "started rosmaster");
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

    /// The process id of a master that was started and not asked for before.
    pub(crate) fn take_new(&mut self) -> Option<i32> {
        self.new.take()
    }

    /// Returns when the master has ended. Cancel safe.
    pub(crate) async fn exited(&mut self) {
        let how = self.gone().await;
        tracing::warn!(pid = self.current, how, "rosmaster has ended");
        self.current = None;
        self.new = None;
    }

    /// Returns when the master has ended: how. Cancel safe.
    async fn gone(&mut self) -> String {
        loop {
            match self.ends.1.recv().await {
                Some((pid, how)) if Some(pid) == self.current => return how,
                Some(_) => {}
                // We hold a sender.
                None => std::future::pending().await,
            }
        }
    }

    pub(crate) fn kill(&self) {
        // Until its end is told nobody else can have its process id; of one that was left to us that
        // holds but for the moment between the two.
        if let Some(pid) = self.current {
            tracing::warn!(pid, "killing the master");
            process::signal_process(pid, rustix::process::Signal::KILL);
        }
    }

    /// Ends the master in order.
    pub(crate) async fn stop(mut self) {
        if let Some(pid) = self.current {
            process::stop(pid, self.gone()).await;
        }
    }

    /// The end of what the last master wrote.
    pub(crate) fn last_words(&self) -> String {
        self.rosmaster.last_words()
    }
}
