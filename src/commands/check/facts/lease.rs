//! How this computer got the address that its nodes register.

use std::path::Path;

use tokio::time::timeout;

use super::{Host, LOOKUP_LIMIT};

/// How this computer got its address.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Lease {
    pub(crate) address: String,
    pub(crate) interface: String,
    /// Whether DHCP gave the address, and for a limited time.
    pub(crate) is_leased: bool,
    pub(crate) is_wireless: bool,
}

impl Lease {
    /// The lease of an address of `host`, if one of them is leased or wireless.
    pub(super) async fn find_for_host(host: &Host) -> Option<Self> {
        for address in host
            .addresses
            .iter()
            .flatten()
            .filter(|at| !at.is_loopback())
        {
            let found = Self::find(&address.to_string()).await;
            if found.is_some() {
                return found;
            }
        }
        None
    }

    /// Asks `ip`, a program of iproute2. `None` if it is not installed.
    async fn find(address: &str) -> Option<Self> {
        let mut ip = tokio::process::Command::new("ip");
        let ip = ip.args(["-o", "addr", "show"]).kill_on_drop(true).output();
        let output = timeout(LOOKUP_LIMIT, ip).await.ok()?.ok()?;
        let (interface, is_leased) =
            interface_of(&String::from_utf8_lossy(&output.stdout), address)?;
        let is_wireless = Path::new("/sys/class/net")
            .join(&interface)
            .join("phy80211")
            .exists();
        (is_leased || is_wireless).then_some(Self {
            address: address.to_owned(),
            interface,
            is_leased,
            is_wireless,
        })
    }
}

/// Finds the interface with `address` in the output of `ip -o addr show`, and whether DHCP gave the address.
fn interface_of(output: &str, address: &str) -> Option<(String, bool)> {
    output.lines().find_map(|line| {
        let words: Vec<_> = line.split_whitespace().collect();
        let (own, _) = words.get(3)?.split_once('/')?;
        let found = ((*words.get(1)?).to_owned(), words.contains(&"dynamic"));
        (own == address).then_some(found)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_leased_address_is_known() {
        let output = "1: lo    inet 127.0.0.1/8 scope host lo\\       valid_lft forever\n\
             2: wlan0    inet 10.0.0.7/24 brd 10.0.0.255 scope global dynamic wlan0\\       valid_lft 3600sec\n";
        assert_eq!(
            interface_of(output, "127.0.0.1"),
            Some(("lo".to_owned(), false))
        );
        assert_eq!(
            interface_of(output, "10.0.0.7"),
            Some(("wlan0".to_owned(), true))
        );
        assert_eq!(interface_of(output, "10.0.0.8"), None);
    }
}
