//! Checks whether a master that is busy with an injection is still alive.

use std::time::Duration;

use super::examine::Examiner;
use crate::master;

impl Examiner {
    /// Probes the master over separate connections. Returns how long it has been silent, once it
    /// has missed enough probes in a row to count as hung. rosmaster serves each connection in its
    /// own thread, so a working master answers.
    pub(super) async fn silence(&self) -> Duration {
        let (probing, patience) = (self.probing, self.probe_timeout);
        let sign_of_life = master::get_pid();
        let mut missed = 0;
        while missed < probing.count {
            if missed == 0 {
                tokio::time::sleep(probing.interval).await;
            }
            // A master that refuses or answers nonsense does not hang; the injection itself will
            // fail.
            let probe = async {
                if let Ok(mut connection) = self.upstream.connect().await {
                    let _ = connection.call(&sign_of_life).await;
                }
            };
            missed = match tokio::time::timeout(patience, probe).await {
                Ok(()) => 0,
                Err(_) => missed + 1,
            };
        }
        patience * probing.count
    }
}
