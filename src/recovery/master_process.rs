//! The supervised rosmaster: a child of ours, or one that an earlier rosrescue left to us.

use tokio::sync::mpsc;

use crate::{
    lifecycle::Input,
    proxy::Proxy,
    ros_env::MasterUri,
    supervisor::{self, Rosmaster, SupervisorError},
};

/// A child's process id, and how it ended.
type End = (u32, String);

/// The master that we start, and end.
#[derive(Debug)]
pub struct MasterProcess {
    rosmaster: Rosmaster,
    /// Port of the last master; tried first, so that whoever looks finds it where it was.
    port: Option<u16>,
    /// Our child, while it has not been reported gone.
    child: Option<u32>,
    /// Our child, while nobody has spoken to it.
    new: Option<i32>,
    /// Ends of children.
    ends: (mpsc::Sender<End>, mpsc::Receiver<End>),
    /// What a command to spawn came to; to be fed to the lifecycle next.
    news: Option<Input>,
}

impl MasterProcess {
    /// Starts masters with `rosmaster`; one may run at `remembered` already.
    pub fn new(rosmaster: Rosmaster, remembered: Option<u16>) -> Self {
        Self {
            rosmaster,
            port: remembered,
            child: None,
            new: None,
            ends: mpsc::channel(4),
            news: None,
        }
    }

    /// Whether a master of an earlier rosrescue may be there.
    pub fn is_remembered(&self) -> bool {
        self.port.is_some()
    }

    /// Starts a master and tells `proxy` where it is.
    pub fn spawn(&mut self, proxy: &Proxy) -> Result<(), SupervisorError> {
        let port = self.rosmaster.choose_port(self.port)?;
        let address = MasterUri {
            host: "127.0.0.1".to_owned(),
            port,
        };
        let uri = address.to_string();
        proxy.upstream.relocate(address);
        if proxy.shadow.session().master_uri.as_ref() != Some(&uri) {
            // Before it runs: a rosrescue that dies now leaves a master that the next one can find.
            proxy
                .shadow
                .update_session(|session| session.master_uri = Some(uri));
        }
        let mut child = self.rosmaster.spawn(port)?;
        let pid = child.id().unwrap_or_default();
        tracing::info!(pid, port, "started rosmaster");
        let ends = self.ends.0.clone();
        tokio::spawn(async move {
            let how = match child.wait().await {
                Ok(status) => supervisor::describe(status),
                Err(error) => error.to_string(),
            };
            // The receiver is gone only when nobody cares any more.
            let _ = ends.send((pid, how)).await;
        });
        self.port = Some(port);
        self.child = Some(pid);
        self.new = i32::try_from(pid).ok();
        self.news = Some(Input::Spawned);
        Ok(())
    }

    /// The process id of a master that was started and not asked for before.
    pub fn take_new(&mut self) -> Option<i32> {
        self.new.take()
    }

    /// The lifecycle is to hear that no master could be started.
    pub fn report_failure(&mut self) {
        self.news = Some(Input::SpawnFailed);
    }

    /// What the last command came to, once.
    pub fn take_news(&mut self) -> Option<Input> {
        self.news.take()
    }

    /// Returns when the child has ended. Cancel safe.
    pub async fn exited(&mut self) {
        loop {
            match self.ends.1.recv().await {
                Some((pid, how)) if Some(pid) == self.child => {
                    tracing::warn!(pid, how, "rosmaster has ended");
                    self.child = None;
                    self.new = None;
                    return;
                }
                Some(_) => {}
                // We hold a sender.
                None => std::future::pending().await,
            }
        }
    }

    /// Kills the master: our child, else the process that called itself `pid`, if it is a rosmaster.
    pub fn kill(&mut self, pid: Option<i32>) {
        if let Some(pid) = self.pid(pid) {
            tracing::warn!(pid, "killing the master");
            supervisor::signal_process(pid, rustix::process::Signal::KILL);
        }
    }

    /// Ends the master in order.
    pub async fn stop(mut self, pid: Option<i32>) {
        let Some(pid) = self.pid(pid) else { return };
        let child = self.child == Some(pid);
        supervisor::stop(pid, || match child {
            // It is reaped by the task that waits for it.
            true => self.ends.1.try_recv().is_ok_and(|(ended, _)| ended == pid),
            false => !supervisor::is_alive(pid),
        })
        .await;
    }

    fn pid(&self, said: Option<i32>) -> Option<u32> {
        let said = said.and_then(|pid| u32::try_from(pid).ok());
        self.child
            .or(said)
            .filter(|pid| supervisor::runs(*pid, "rosmaster") || self.child == Some(*pid))
    }

    /// The end of what the last master wrote.
    pub fn last_words(&self) -> String {
        self.rosmaster.last_words()
    }
}
