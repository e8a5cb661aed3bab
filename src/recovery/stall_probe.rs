//! Checks whether a master is alive while it is busy with an injection.

use std::time::Duration;

use ros1_master::master::{CALLER_ID, Method, Request};

use super::live_master::Reach;

impl Reach {
    /// Probes the master over separate connections until enough probes in a row are unanswered for it to count as hung.
    /// Returns how long the master has been silent. rosmaster serves each connection in a thread of its own, so a busy
    /// master still answers.
    pub(super) async fn silence(&self) -> Duration {
        let (probing, patience) = (self.probing, self.probe_timeout);
        let sign_of_life = Request::new(Method::GetPid, [CALLER_ID]);
        let mut missed = 0;
        while missed < probing.count {
            if missed == 0 {
                tokio::time::sleep(probing.interval).await;
            }
            // A master that refuses or answers nonsense does not hang. Its injection will fail anyway.
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
