//! Reports readiness and status to the guardian and to systemd (`sd_notify(3)`).

use std::{os::unix::net::UnixStream as StdLink, sync::Arc, time::Duration};

use sd_notify::NotifyState;
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::UnixStream,
    time::{Instant, MissedTickBehavior, interval},
};
use tokio_util::sync::CancellationToken;

use crate::{
    gate::{self, State},
    guardian::handover::{self, Guard},
    ledger::Ledger,
    status::{Board, Guarded},
};

/// Shortest time between two status messages to systemd.
const STATUS_INTERVAL: Duration = Duration::from_secs(1);

/// Starts reporting. `stop` is reported as the beginning of the stop.
pub(super) fn start(guard: Guard, told: Source, stop: CancellationToken) {
    let guarded = match guard {
        Guard::Nobody => Guarded::Nobody,
        Guard::Systemd => Guarded::Systemd,
        Guard::Guardian { pid, link } => {
            tokio::spawn(follow_guardian(pid, link, told.clone()));
            Guarded::Guardian(pid)
        }
    };
    told.board.update(|facts| facts.guarded = guarded);
    if std::env::var_os("NOTIFY_SOCKET").is_some() {
        tokio::spawn(report_ready(told.clone()));
        tokio::spawn(report_status(told, stop));
    }
}

/// What the reports need.
#[derive(Clone)]
pub(super) struct Source {
    pub(super) board: Arc<Board>,
    pub(super) ledger: Arc<Ledger>,
    pub(super) gate: gate::Rx,
}

impl Source {
    fn line(&self) -> String {
        let unprotected = self.ledger.unprotected();
        self.board.read().line(self.gate.is_open(), unprotected)
    }

    /// Returns when calls are answered, by the master or the mirror.
    async fn answers(&self) {
        let mut gate = self.gate.clone();
        gate.wait_for(|state| state != State::Unknown).await;
    }
}

/// Reports to the guardian when calls are answered, and logs the guardian's end.
async fn follow_guardian(pid: u32, link: StdLink, told: Source) {
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
    tokio::pin!(ended);
    tokio::select! {
        _ = &mut ended => {}
        () = served => drop(ended.await),
    }
    told.board
        .update(|facts| facts.guarded = Guarded::NoLonger(pid));
    tracing::warn!(
        pid,
        "unguarded: the guardian process has ended; all goes on, but if rosrescue dies now, \
         connections are refused and nobody starts it again. Stop it and start it anew when the robot \
         is at rest"
    );
}

async fn report_ready(told: Source) {
    told.answers().await;
    let line = told.line();
    send(&[NotifyState::Ready, NotifyState::Status(&line)]);
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
    let mut stopping = false;
    loop {
        let now = tokio::select! {
            now = ticks.tick() => now,
            () = stop.cancelled(), if !stopping => {
                stopping = true;
                send(&[NotifyState::Stopping, NotifyState::Status("stopping")]);
                Instant::now()
            }
        };
        let line = told.line();
        if !stopping && line != last {
            send(&[NotifyState::Status(&line)]);
            last = line;
        }
        let due = |pause| fed.is_none_or(|fed| now.saturating_duration_since(fed) + tick > pause);
        if watchdog.is_some_and(due) {
            send(&[NotifyState::Watchdog]);
            fed = Some(now);
        }
    }
}

fn send(state: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(state) {
        tracing::debug!(%error, "systemd is not told");
    }
}
