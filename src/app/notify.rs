//! Reports readiness and status to the guardian and to systemd (`sd_notify(3)`).

use std::{io, os::unix::net::UnixStream as StdLink, sync::Arc, time::Duration};

use sd_notify::NotifyState;
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::UnixStream,
    task::JoinHandle,
    time::{MissedTickBehavior, interval, sleep},
};
use tokio_util::sync::CancellationToken;

use super::context::Context;
use crate::{
    gate::State,
    guardian::handover::{self, Guard},
    limit::{AlarmLimit, alarm, all_clear},
    process::{self, Stat},
    status::{
        Guarded,
        condition::{Situation, condition},
    },
};

/// Shortest time between two status messages to systemd.
const STATUS_INTERVAL: Duration = Duration::from_secs(1);

/// Pause between two checks whether this computer has joined the cluster.
const JOINING: Duration = Duration::from_millis(20);

/// Pause between two checks whether the guardian is stopped.
const LOOK: Duration = Duration::from_secs(1);

/// Limits the log lines about a stopped guardian, and about a guardian that runs again.
static STOPPED: AlarmLimit = AlarmLimit::new();

/// Starts the reports to the guardian and systemd. The returned task ends once it has reported `stop`.
pub(super) fn start(
    guard: Guard,
    context: Arc<Context>,
    stop: CancellationToken,
) -> JoinHandle<()> {
    let guarded = match guard {
        Guard::Nobody => Guarded::Nobody,
        Guard::Systemd => Guarded::Systemd,
        Guard::Guardian { pid, link } => {
            let guarded = Guarded::Guardian {
                pid,
                restarted: is_restarted(pid),
            };
            crate::task::spawn(follow_guardian(pid, guarded, link, context.clone()));
            guarded
        }
    };
    context.board.update(|facts| facts.guarded = guarded);
    let is_notified = std::env::var_os("NOTIFY_SOCKET").is_some();
    if is_notified {
        crate::task::spawn(report_ready(context.clone()));
        crate::task::spawn(report_status(context, stop.clone()));
    }
    crate::task::spawn(async move {
        stop.cancelled().await;
        if is_notified {
            let state = [NotifyState::Stopping, NotifyState::Status("stopping")];
            send(move || sd_notify::notify(&state)).await;
        }
    })
}

impl Context {
    fn line(&self) -> String {
        let situation = Situation {
            nodes: self.nodes.trouble(&self.nodes.lives()),
            gate: self.gate.state(),
            gate_since: self.gate.opened_or_shut_at().into_std(),
            unprotected: self.ledger.unprotected(),
            master: self.reach.upstream.address().to_string(),
        };
        self.board
            .update(|facts| condition(&situation, facts))
            .line()
    }

    /// Checks whether the guardian `pid` is stopped. A stopped guardian starts no worker, and neither its link nor its
    /// exit would show that. `guarded` is the state to report while the guardian runs.
    fn see_guardian(&self, pid: u32, guarded: Guarded) {
        let now = match Stat::read(pid).is_some_and(Stat::is_stopped) {
            true => Guarded::Stopped(pid),
            false => guarded,
        };
        let before = self
            .board
            .update(|facts| std::mem::replace(&mut facts.guarded, now));
        match (before, now) {
            (Guarded::Stopped(_), Guarded::Stopped(_)) => {}
            (_, Guarded::Stopped(_)) => alarm!(
                warn,
                STOPPED,
                pid,
                "unguarded: the guardian process is stopped, perhaps by Ctrl-Z; nodes run as usual, but if \
                 rosrescue dies now, calls wait until the guardian is resumed: `fg`, `bg` or `kill -CONT {pid}`"
            ),
            (Guarded::Stopped(_), _) => all_clear!(
                info,
                STOPPED,
                pid,
                "guarded: the guardian process runs again"
            ),
            _ => {}
        }
    }

    /// Waits until calls are answered by the master, the mirror, or another computer.
    async fn wait_until_answering(&self) {
        let mut gate = self.gate.clone();
        loop {
            let state = gate.wait_for(|state| state != State::Unknown).await;
            if self.board.update(|facts| facts.answers_calls(state)) {
                return;
            }
            // Polled, because the end of joining wakes no waiter.
            sleep(JOINING).await;
        }
    }
}

/// The first process of a container with `--init` (docker, podman), or `init: true` in a compose file. It ends with its
/// child.
const INITS: [&str; 5] = [
    "tini",
    "docker-init",
    "podman-init",
    "catatonit",
    "dumb-init",
];

/// Whether something restarts the guardian `pid` when it ends: systemd, or the runtime of its container.
fn is_restarted(pid: u32) -> bool {
    let parent = process::parent_of(pid);
    let name = parent.map(process::name_of).unwrap_or_default();
    // An orphan's parent may be systemd, too.
    let groups = std::fs::read_to_string(format!("/proc/{pid}/cgroup")).unwrap_or_default();
    let by_systemd = name == "systemd" && is_in_service(&groups);
    let by_runtime = pid == 1 || parent == Some(1) && INITS.contains(&name.as_str());
    by_systemd || by_runtime
}

/// Whether a process with these control groups (`cgroups(7)`) belongs to a systemd service. Only systemd's own hierarchy
/// tells: in others, a terminal has that of `user@1000.service`. The group of a terminal or a login ends in `.scope`, on
/// Ubuntu 18.04 in `gnome-terminal-server.service`. `INVOCATION_ID` would not do: terminals inherit it, and systemd sets it
/// only since version 232.
fn is_in_service(groups: &str) -> bool {
    let mut own = (groups.lines())
        .filter(|group| group.starts_with("0::") || group.contains(":name=systemd:"));
    own.any(|group| {
        group.ends_with(".service") && !group.ends_with("/gnome-terminal-server.service")
    })
}

/// Tells the guardian when calls are answered, and logs when the guardian is stopped or has ended. `guarded` is the
/// state to report while the guardian runs.
async fn follow_guardian(pid: u32, guarded: Guarded, link: StdLink, context: Arc<Context>) {
    let link = link
        .set_nonblocking(true)
        .and_then(|()| UnixStream::from_std(link));
    let Ok(mut link) = link else { return };
    let (mut from, mut to) = link.split();
    let served = async {
        context.wait_until_answering().await;
        // If the guardian is gone, the read below notices.
        let _ = to.write_all(&[handover::SERVES]).await;
    };
    // The guardian never writes, so this read ends only when the guardian ends.
    let mut byte = [0];
    let ended = from.read(&mut byte);
    let look = async {
        let mut looks = interval(LOOK);
        looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            looks.tick().await;
            context.see_guardian(pid, guarded);
        }
    };
    tokio::select! {
        _ = ended => {}
        ((), ()) = async { tokio::join!(served, look) } => {}
    }
    context
        .board
        .update(|facts| facts.guarded = Guarded::NoLonger(pid));
    tracing::warn!(
        pid,
        "unguarded: the guardian process has ended; nodes run as usual, but if rosrescue dies now, \
         connections are refused and nothing restarts it. Restart rosrescue when the robot is at rest"
    );
}

async fn report_ready(context: Arc<Context>) {
    context.wait_until_answering().await;
    let line = context.line();
    send(move || sd_notify::notify(&[NotifyState::Ready, NotifyState::Status(&line)])).await;
}

/// Reports the status to systemd in one line and feeds the watchdog. Feeding needs what a call needs: a timer, a
/// runtime thread, and the locks of status and mirror. So it proves that calls work.
async fn report_status(context: Arc<Context>, stop: CancellationToken) {
    // Twice as often as necessary, as systemd recommends.
    let watchdog = sd_notify::watchdog_enabled().map(|limit| limit / 2);
    let tick = watchdog.map_or(STATUS_INTERVAL, |pause| pause.min(STATUS_INTERVAL));
    let mut ticks = interval(tick.max(Duration::from_millis(1)));
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut last = String::new();
    let mut fed = None;
    loop {
        let now = ticks.tick().await;
        // With many nodes, it takes long to say how they are.
        let looking = context.clone();
        let line = crate::task::spawn_blocking(move || looking.line()).await;
        let line = line.unwrap_or_else(|_| last.clone());
        if !stop.is_cancelled() && line != last {
            last.clone_from(&line);
            send(move || sd_notify::notify(&[NotifyState::Status(&line)])).await;
        }
        let due = |pause| fed.is_none_or(|fed| now.saturating_duration_since(fed) + tick > pause);
        if watchdog.is_some_and(due) {
            send(|| sd_notify::notify(&[NotifyState::Watchdog])).await;
            fed = Some(now);
        }
    }
}

/// Sends a message to systemd in a thread of its own, because sending blocks while systemd does not
/// read.
async fn send(notify: impl FnOnce() -> io::Result<()> + Send + 'static) {
    let sent = crate::task::spawn_blocking(notify).await;
    if let Err(error) = sent.map_err(io::Error::other).flatten() {
        tracing::debug!(%error, "could not notify systemd");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_service_is_known_by_its_control_group() {
        for service in [
            "0::/system.slice/roscore.service\n",
            "0::/user.slice/user-1000.slice/user@1000.service/app.slice/roscore.service\n",
            // Ubuntu 16.04.
            "4:memory:/\n2:cpu,cpuacct:/\n1:name=systemd:/system.slice/roscore.service\n",
        ] {
            assert!(is_in_service(service), "{service}");
        }
        for other in [
            "",
            "0::/\n",
            "0::/user.slice/user-1000.slice/session-3.scope\n",
            "0::/user.slice/user-1000.slice/user@1000.service/app.slice/vte-spawn-7.scope\n",
            // Ubuntu 20.04 and 18.04.
            "5:pids:/user.slice/user-1000.slice/user@1000.service\n\
             1:name=systemd:/user.slice/user-1000.slice/user@1000.service/vte-spawn-7.scope\n",
            "5:pids:/user.slice/user-1000.slice/user@1000.service\n\
             1:name=systemd:/user.slice/user@1000.service/gnome-terminal-server.service\n",
        ] {
            assert!(!is_in_service(other), "{other}");
        }
    }
}
