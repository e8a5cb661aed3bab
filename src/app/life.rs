//! Whether nodes of a recorded session are alive.

use std::{collections::BTreeSet, time::Duration};

use tokio::{task::JoinSet, time::timeout};

use crate::{
    health::port_of,
    master::{self, Master},
    nodes::client::{self, Sign},
    resolver,
    ros_env::MasterUri,
};

/// How long nodes have to answer, and name servers to resolve their hosts.
const LIFE_SIGN: Duration = Duration::from_secs(1);

/// Whether any node of `state` answers. After a reboot of this computer (`same_boot` is false) only nodes on
/// other computers count: none of its own processes has survived, and a process at such a port is a different
/// one.
pub(super) async fn any_alive(state: &Master, same_boot: bool) -> bool {
    let call = master::get_pid();
    let mut questions = JoinSet::new();
    let ports: BTreeSet<_> = state.nodes().map(|(_, api)| port_of(api)).collect();
    for port in ports {
        let (api, call) = (port.to_owned(), call.clone());
        questions.spawn(async move {
            (same_boot || is_elsewhere(&api).await)
                && client::ask(&api, &call, LIFE_SIGN).await == Sign::Alive
        });
    }
    while let Some(alive) = questions.join_next().await {
        if alive.unwrap_or(false) {
            return true;
        }
    }
    false
}

/// Whether `api` is on another computer. Not if its host has no address.
async fn is_elsewhere(api: &str) -> bool {
    let Ok(MasterUri { host, port }) = MasterUri::parse(api) else {
        return false;
    };
    match timeout(LIFE_SIGN, resolver::addresses(&host, port)).await {
        Ok(Ok(addresses)) => !addresses
            .iter()
            .any(|address| resolver::is_own(address.ip())),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn own_addresses_are_told_from_others() {
        for own in ["127.0.0.1", "127.9.9.9", "[::1]", "0.0.0.0", "localhost"] {
            assert!(!is_elsewhere(&format!("http://{own}:4711/")).await, "{own}");
        }
        // Set apart for documentation.
        assert!(is_elsewhere("http://198.51.100.7:4711/").await);
        for nobody in ["http://nobody.invalid:4711/", "nonsense"] {
            assert!(!is_elsewhere(nobody).await, "{nobody}");
        }
    }
}
