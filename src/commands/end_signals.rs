//! The signals that end a command.

use tokio::signal::unix::{Signal, SignalKind, signal};

use super::CommandFailure;
use crate::guardian;

/// Receives SIGINT, SIGTERM and SIGHUP, but not a SIGHUP that nohup has turned off.
pub(super) struct EndSignals(Vec<Signal>);

impl EndSignals {
    pub(super) fn new() -> Result<Self, CommandFailure> {
        let hangup = (!guardian::is_hangup_ignored()).then(SignalKind::hangup);
        let kinds = [SignalKind::interrupt(), SignalKind::terminate()];
        let signals = kinds.into_iter().chain(hangup).map(signal);
        let signals = signals.collect::<Result<_, _>>();
        signals
            .map(Self)
            .map_err(|error| CommandFailure::Failed(format!("cannot receive signals: {error}")))
    }

    /// Waits for one of the signals.
    pub(super) async fn received(&mut self) {
        std::future::poll_fn(|context| {
            let is_received = |signal: &mut Signal| signal.poll_recv(context).is_ready();
            match self.0.iter_mut().any(is_received) {
                true => std::task::Poll::Ready(()),
                false => std::task::Poll::Pending,
            }
        })
        .await;
    }
}
