//! Finds out whether an address is on another computer.

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

/// Why `uri`, the `ROS_MASTER_URI` of nodes, does not lead to `port` of this computer. `None` if it does.
pub(crate) async fn why_not_here(uri: &MasterUri, port: u16, patience: Duration) -> Option<String> {
    let found = tokio::time::timeout(patience, addresses(&uri.host, uri.port)).await;
    match found {
        Ok(Ok(all)) if all.iter().any(|address| is_own(address.ip())) => {
            (uri.port != port).then(|| format!("has port {}, and rosrescue has {port}", uri.port))
        }
        Ok(Ok(_)) => Some("is another computer".to_owned()),
        Ok(Err(error)) => Some(format!("has no address: {error}")),
        Err(_) => Some(format!(
            "has no address: no name server answered in {patience:?}"
        )),
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

    #[tokio::test]
    async fn a_master_elsewhere_without_an_address_or_at_another_port_is_not_this_one() {
        for (uri, reason) in [
            ("http://localhost:11311", None),
            ("http://127.0.0.1", None),
            ("http://198.51.100.7:11311/", Some("is another computer")),
            ("http://nobody.invalid:11311/", Some("has no address: ")),
            (
                "http://localhost:11312/",
                Some("has port 11312, and rosrescue has 11311"),
            ),
        ] {
            let parsed = MasterUri::parse(uri).unwrap();
            let found = why_not_here(&parsed, 11311, LONG).await;
            assert_eq!(found.is_some(), reason.is_some(), "{uri}: {found:?}");
            let found = found.unwrap_or_default();
            assert!(found.starts_with(reason.unwrap_or_default()), "{found}");
        }
    }
}
