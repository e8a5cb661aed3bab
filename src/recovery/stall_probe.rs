//! Whether a master that is busy with an injection still lives.

use std::time::Duration;

use super::examine::Examiner;
use crate::master;

impl Examiner {
    /// Asks the master for signs of life, over connections of their own, and returns when it has given
    /// none for as many probes in a row as mean that it hangs: for how long. rosmaster answers
    /// each connection in a thread of its own, so that one which works answers others meanwhile.
    pub(super) async fn silence(&self) -> Duration {
        let (probing, patience) = (self.probing, self.probe_timeout);
        let sign_of_life = master::get_pid();
        let mut missed = 0;
        while missed < probing.count {
            if missed == 0 {
                tokio::time::sleep(probing.interval).await;
            }
            // A master that refuses or answers nonsense does not hang: the injection itself will fail.
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
