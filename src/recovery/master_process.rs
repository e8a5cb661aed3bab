//! The supervised rosmaster: a child of this process, or one that an earlier rosrescue left
//! running.

use tokio::sync::mpsc;

use crate::{
    ledger::Ledger,
    limit::{AlarmLimit, alarm, all_clear, rarely},
    process::{self, Orphan, ProcessError, Rosmaster, Stat},
    ros_env::MasterUri,
    upstream::Upstream,
};

/// Limits the log lines about the end of a master, and about the start of a new one.
static ENDED: AlarmLimit = AlarmLimit::new();

/// Process id of a child, and how it ended.
type End = (u32, String);

/// The master that rosrescue starts and ends.
#[derive(Debug)]
pub(crate) struct MasterProcess {
    rosmaster: Rosmaster,
    /// Port of the last master. It is tried first, so that the address stays the same.
    port: Option<u16>,
    /// Process id of the child, or of the master that an earlier rosrescue left running. Set until its end is reported.
    current: Option<u32>,
    /// Process id of a master that an earlier rosrescue had just started. It has no state, so it is used instead of a
    /// new master.
    starting: Option<u32>,
    /// Process id of a new child, until rosrescue begins to examine it.
    new: Option<i32>,
    ends: (mpsc::Sender<End>, mpsc::Receiver<End>),
    /// How the last master ended, until a report has taken it.
    end: Option<String>,
    /// Whether rosrescue killed the present master.
    killed: bool,
}

impl MasterProcess {
    /// Starts masters with `rosmaster`. The last one was at `port`.
    pub(crate) fn new(rosmaster: Rosmaster, port: Option<u16>) -> Self {
        Self {
            rosmaster,
            port,
            current: None,
            starting: None,
            new: None,
            ends: mpsc::channel(4),
            end: None,
            killed: false,
        }
    }

    /// Takes over `orphan` before any other master is started.
    pub(crate) fn adopt(&mut self, orphan: Orphan, ledger: &Ledger, upstream: &Upstream) {
        let Orphan { pid, port, serves } = orphan;
        if serves {
            tracing::info!(pid, port, "an earlier rosrescue left its rosmaster running");
            self.current = Some(pid);
        } else {
            tracing::info!(
                pid,
                port,
                "using a rosmaster that an earlier rosrescue had just started"
            );
            self.starting = Some(pid);
        }
        self.is_at(port, ledger, upstream);
        self.watch(pid, async move {
            process::wait_until_ended(pid).await;
            "exit status unknown: an earlier rosrescue started it".to_owned()
        });
    }

    /// Notes that the master is at `port`, and records it.
    fn is_at(&mut self, port: u16, ledger: &Ledger, upstream: &Upstream) {
        let address = MasterUri {
            host: "127.0.0.1".to_owned(),
            port,
        };
        let uri = address.to_string();
        upstream.relocate(address);
        if ledger.session().master_uri.as_ref() != Some(&uri) {
            ledger.update_session(|session| session.master_uri = Some(uri));
        }
        self.port = Some(port);
    }

    /// Process id of the present master.
    pub(crate) fn pid(&self) -> Option<u32> {
        self.current
    }

    /// Whether a master of an earlier rosrescue is running and may hold a state.
    pub(crate) fn is_orphan(&self) -> bool {
        self.current.is_some()
    }

    /// Waits for `end` in a task, then reports how `pid` ended. Meanwhile limits what the process sends to other computers.
    fn watch(&self, pid: u32, end: impl Future<Output = String> + Send + 'static) {
        let ends = self.ends.0.clone();
        let timeout = self.rosmaster.socket_timeout();
        crate::task::spawn(async move {
            let limited = async {
                match timeout {
                    Some(timeout) => process::unsent::keep_limited(pid, timeout).await,
                    None => std::future::pending().await,
                }
            };
            let how = tokio::select! {
                how = end => how,
                never = limited => match never {},
            };
            // The receiver is gone only at shutdown.
            let _ = ends.send((pid, how)).await;
        });
    }

    /// Starts a master, or takes one that is already starting.
    pub(crate) async fn spawn(
        &mut self,
        ledger: &Ledger,
        upstream: &Upstream,
    ) -> Result<(), ProcessError> {
        let pid = match self.starting.take() {
            Some(pid) => pid,
            None => self.start(ledger, upstream).await?,
        };
        self.current = Some(pid);
        Ok(())
    }

    /// Starts a master and returns its process id.
    async fn start(&mut self, ledger: &Ledger, upstream: &Upstream) -> Result<u32, ProcessError> {
        let port = self.rosmaster.choose_port(self.port)?;
        // Recorded before the master runs. If rosrescue dies now, its successor can find the master.
        self.is_at(port, ledger, upstream);
        let mut child = self.rosmaster.start(port).await?;
        let pid = child.id().unwrap_or_default();
        all_clear!(info, ENDED, pid, port, "started rosmaster");
        self.watch(pid, async move {
            match child.wait().await {
                Ok(status) => process::describe(status),
                Err(error) => error.to_string(),
            }
        });
        self.new = i32::try_from(pid).ok();
        Ok(pid)
    }

    /// The master that was started since the last [`Self::take_new`]: its process id and port, and whether it is ROS's
    /// own rosmaster.
    pub(crate) fn new_one(&self) -> Option<(u32, u16, bool)> {
        let pid = u32::try_from(self.new?).ok()?;
        Some((pid, self.port?, self.rosmaster.is_ros_rosmaster()))
    }

    /// Notes that another program has taken the master's port.
    pub(crate) fn port_taken(&mut self, by: Option<u32>) {
        rarely!(
            warn,
            port = self.port,
            by,
            "another program took the port before rosmaster could listen; starting rosmaster at another port"
        );
        self.port = None;
    }

    /// Takes the process id of a master that was started since this function was last called.
    pub(crate) fn take_new(&mut self) -> Option<i32> {
        self.new.take()
    }

    /// Takes the description of how the last master ended.
    pub(crate) fn take_end(&mut self) -> Option<String> {
        self.end.take()
    }

    /// Waits until the master has ended. Cancel safe.
    pub(crate) async fn exited(&mut self) {
        let how = gone(&mut self.ends.1, self.current).await;
        let how = match std::mem::take(&mut self.killed) {
            true => format!("{how}, sent by rosrescue"),
            false => how,
        };
        alarm!(warn, ENDED, pid = self.current, how, "rosmaster has ended");
        self.end = Some(how);
        self.current = None;
        self.new = None;
    }

    pub(crate) fn kill(&mut self) {
        // A child's process id is not reused before its end is reported. For an adopted master this also holds, except
        // for a moment between its end and the report.
        if let Some(pid) = self.current {
            // A master that is ending does not answer either, but did not end because of rosrescue.
            let runs = Stat::read(pid).is_some_and(Stat::is_alive);
            if runs && self.port.is_some() {
                alarm!(
                    warn,
                    ENDED,
                    pid,
                    "the master does not answer; killing it and starting a new one"
                );
            }
            process::unsent::kill(pid);
            self.killed |= runs;
        }
    }

    /// Stops the master cleanly.
    pub(crate) async fn stop(mut self) {
        self.current = self.current.or(self.starting);
        if let Some(pid) = self.current {
            process::stop(pid, gone(&mut self.ends.1, self.current)).await;
        }
    }

    /// Kills the master at once, so that it notifies no more nodes. The returned future waits for its end.
    pub(crate) fn kill_and_wait(mut self) -> impl Future<Output = ()> + Send + 'static {
        self.current = self.current.or(self.starting);
        if let Some(pid) = self.current {
            process::unsent::kill(pid);
        }
        async move {
            if self.current.is_some() {
                gone(&mut self.ends.1, self.current).await;
            }
        }
    }

    /// The last output of the last master.
    pub(crate) async fn last_words(&self) -> String {
        self.rosmaster.last_words().await
    }
}

/// Waits until the master `current` has ended, and returns how it ended. Cancel safe.
async fn gone(ends: &mut mpsc::Receiver<End>, current: Option<u32>) -> String {
    loop {
        match ends.recv().await {
            Some((pid, how)) if Some(pid) == current => return how,
            Some(_) => {}
            // Does not happen, because the caller holds a sender.
            None => std::future::pending().await,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::{path::Path, process::Command, time::Duration};

    use super::*;
    use crate::config::SupervisedConfig;

    #[test]
    fn a_master_that_was_ending_already_is_not_called_killed() {
        let config = SupervisedConfig {
            port: None,
            rosmaster: Some("/bin/sleep".into()),
            numworkers: 3,
            timeout: 0.0,
            rosout: true,
        };
        let rosmaster = Rosmaster::find(&config, Path::new("checkpoint.yaml")).unwrap();
        let mut master = MasterProcess::new(rosmaster, Some(1));
        for (has_ended, killed) in [(true, false), (false, true)] {
            let mut child = Command::new("sleep").arg("60").spawn().unwrap();
            if has_ended {
                child.kill().unwrap();
                while Stat::read(child.id()).is_some_and(Stat::is_alive) {
                    std::thread::sleep(Duration::from_millis(1));
                }
            }
            master.current = Some(child.id());
            master.kill();
            assert_eq!(master.killed, killed, "{has_ended}");
            child.wait().unwrap();
        }
    }
}
