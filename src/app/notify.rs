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

use crate::{
    gate::{self, State},
    guardian::handover::{self, Guard},
    ledger::Ledger,
    limit::{Pair, alarm, all_clear},
    process::{self, Stat},
    status::{
        Board, Guarded,
        condition::{Situation, condition},
    },
    upstream::Upstream,
};

/// Shortest time between two status messages to systemd.
const STATUS_INTERVAL: Duration = Duration::from_secs(1);

/// Pause between two looks whether other computers have been joined.
const JOINING: Duration = Duration::from_millis(20);

/// Time between two looks whether the guardian is stopped.
const LOOK: Duration = Duration::from_secs(1);

/// That the guardian is stopped, and that it runs again.
static STOPPED: Pair = Pair::new();

/// Starts reporting. The task that is returned reports `stop` and ends.
pub(super) fn start(guard: Guard, told: Source, stop: CancellationToken) -> JoinHandle<()> {
    let guarded = match guard {
        Guard::Nobody => Guarded::Nobody,
        Guard::Systemd => Guarded::Systemd,
        Guard::Guardian { pid, link } => {
            let guarded = Guarded::Guardian {
                pid,
                restarted: is_restarted(pid),
            };
            tokio::spawn(follow_guardian(pid, guarded, link, told.clone()));
            guarded
        }
    };
    told.board.update(|facts| facts.guarded = guarded);
    let is_notified = std::env::var_os("NOTIFY_SOCKET").is_some();
    if is_notified {
        tokio::spawn(report_ready(told.clone()));
        tokio::spawn(report_status(told, stop.clone()));
    }
    tokio::spawn(async move {
        stop.cancelled().await;
        if is_notified {
            let state = [NotifyState::Stopping, NotifyState::Status("stopping")];
            send(move || sd_notify::notify(&state)).await;
        }
    })
}

/// What the reports need.
#[derive(Clone)]
pub(super) struct Source {
    pub(super) board: Arc<Board>,
    pub(super) ledger: Arc<Ledger>,
    pub(super) gate: gate::Rx,
    pub(super) upstream: Arc<Upstream>,
}

impl Source {
    fn line(&self) -> String {
        let situation = Situation {
            gate: self.gate.state(),
            gate_since: self.gate.since().into_std(),
            unprotected: self.ledger.unprotected(),
            master: self.upstream.address().to_string(),
        };
        self.board
            .update(|facts| condition(&situation, facts))
            .line()
    }

    /// Looks whether the guardian `pid` is stopped: then it starts no worker. It shows neither by the link nor by its
    /// end. `guarded`: what holds while it runs.
    fn see_guardian(&self, pid: u32, guarded: Guarded) {
        let now = match Stat::of(pid).is_some_and(Stat::is_stopped) {
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
                "unguarded: the guardian process is stopped, by Ctrl-Z perhaps; nodes run as usual, but if \
                 rosrescue dies now, calls wait until it is continued: `fg`, `bg` or `kill -CONT {pid}`"
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

    /// Returns when calls are answered, by the master, the mirror, or another computer.
    async fn answers(&self) {
        let mut gate = self.gate.clone();
        loop {
            let state = gate.wait_for(|state| state != State::Unknown).await;
            if self.board.update(|facts| facts.answers(state)) {
                return;
            }
            // It joins other computers; what it has found out wakes nobody.
            sleep(JOINING).await;
        }
    }
}

/// Whether something starts the guardian `pid` again when it ends: systemd, or what runs the container of which it is
/// the first process.
fn is_restarted(pid: u32) -> bool {
    let parent = process::parent_of(pid);
    let of_systemd = |parent| process::name_of(parent) == "systemd";
    // systemd sets it for all that it starts; terminals inherit it.
    pid == 1 || (std::env::var_os("INVOCATION_ID").is_some() && parent.is_some_and(of_systemd))
}

/// Reports to the guardian when calls are answered, and logs that the guardian is stopped or has ended. `guarded`: what
/// holds while it runs.
async fn follow_guardian(pid: u32, guarded: Guarded, link: StdLink, told: Source) {
    let link = link
        .set_nonblocking(true)
        .and_then(|()| UnixStream::from_std(link));
    let Ok(mut link) = link else { return };
    let (mut from, mut to) = link.split();
    let served = async {
        told.answers().await;
        // If the guardian is gone, the read below notices.
        let _ = to.write_all(&[handover::SERVES]).await;
    };
    // The guardian never writes: the read ends only with it.
    let mut byte = [0];
    let ended = from.read(&mut byte);
    let look = async {
        let mut looks = interval(LOOK);
        looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            looks.tick().await;
            told.see_guardian(pid, guarded);
        }
    };
    tokio::select! {
        _ = ended => {}
        ((), ()) = async { tokio::join!(served, look) } => {}
    }
    told.board
        .update(|facts| facts.guarded = Guarded::NoLonger(pid));
    tracing::warn!(
        pid,
        "unguarded: the guardian process has ended; nodes run as usual, but if rosrescue dies now, \
         connections are refused and nobody starts it again. Stop it and start it anew when the robot \
         is at rest"
    );
}

async fn report_ready(told: Source) {
    told.answers().await;
    let line = told.line();
    send(move || sd_notify::notify(&[NotifyState::Ready, NotifyState::Status(&line)])).await;
}

/// Reports the state to systemd in a line, and feeds its watchdog. Feeding needs what calls need, so it shows
/// that they work: a timer and a thread of the runtime, and the locks of the board and the mirror.
async fn report_status(told: Source, stop: CancellationToken) {
    // Twice as often as necessary, as systemd recommends.
    let watchdog = sd_notify::watchdog_enabled().map(|limit| limit / 2);
    let tick = watchdog.map_or(STATUS_INTERVAL, |pause| pause.min(STATUS_INTERVAL));
    let mut ticks = interval(tick.max(Duration::from_millis(1)));
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut last = String::new();
    let mut fed = None;
    loop {
        let now = ticks.tick().await;
        let line = told.line();
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

/// Sends a message to systemd. That blocks while systemd reads none, and must not hold up a thread of the
/// runtime then.
async fn send(notify: impl FnOnce() -> io::Result<()> + Send + 'static) {
    let sent = tokio::task::spawn_blocking(notify).await;
    if let Err(error) = sent.map_err(io::Error::other).flatten() {
        tracing::debug!(%error, "systemd is not told");
    }
}
