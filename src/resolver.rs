//! Finds out whether a node is on another computer.

use std::time::Duration;

pub(crate) use lookup::{addresses, is_own};

use crate::ros_env::MasterUri;

/// Whether a node's `api` is on another computer. False if its host has no address, or if the lookup takes longer than
/// `patience`.
pub(crate) async fn is_elsewhere(api: &str, patience: Duration) -> bool {
    let Ok(MasterUri { host, port }) = MasterUri::parse(api) else {
        return false;
    };
    match tokio::time::timeout(patience, addresses(&host, port)).await {
        Ok(Ok(addresses)) => !addresses.iter().any(|address| is_own(address.ip())),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LONG: Duration = Duration::from_secs(1);

    #[tokio::test]
    async fn own_addresses_are_distinguished_from_others() {
        for own in ["127.0.0.1", "127.9.9.9", "[::1]", "0.0.0.0", "localhost"] {
            assert!(
                !is_elsewhere(&format!("http://{own}:4711/"), LONG).await,
                "{own}"
            );
        }
        // This network is reserved for documentation.
        assert!(is_elsewhere("http://198.51.100.7:4711/", LONG).await);
        for nobody in ["http://nobody.invalid:4711/", "nonsense"] {
            assert!(!is_elsewhere(nobody, LONG).await, "{nobody}");
        }
    }
}
