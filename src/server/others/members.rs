//! The addresses of the robot's computers, as they have written them to etcd.

use std::{
    collections::BTreeMap,
    net::IpAddr,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use crate::{resolver, ros_env::MasterUri};

/// The addresses of each computer. A computer that forwards a call names the caller's address, and only a member is
/// believed.
#[derive(Clone, Debug, Default)]
pub(crate) struct MemberAddresses(Arc<Mutex<BTreeMap<String, Vec<IpAddr>>>>);

impl MemberAddresses {
    fn lock(&self) -> MutexGuard<'_, BTreeMap<String, Vec<IpAddr>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sets the address of the computer `name`. `None` if it is no member any more.
    pub(crate) fn set_address(&self, name: &str, uri: Option<&str>) {
        let Some(MasterUri { host, port }) = uri.and_then(|uri| MasterUri::parse(uri).ok()) else {
            self.lock().remove(name);
            return;
        };
        if let Ok(address) = host.parse::<IpAddr>() {
            self.note(name.to_owned(), vec![address]);
            return;
        }
        let (this, name) = (self.clone(), name.to_owned());
        crate::task::spawn(async move {
            // If the lookup fails, the last known addresses count.
            if let Ok(found) = resolver::addresses(&host, port).await {
                this.note(name, found.iter().map(|at| at.ip()).collect());
            }
        });
    }

    fn note(&self, name: String, addresses: Vec<IpAddr>) {
        let addresses = addresses.iter().map(IpAddr::to_canonical).collect();
        self.lock().insert(name, addresses);
    }

    pub(super) fn contains(&self, address: IpAddr) -> bool {
        let address = address.to_canonical();
        self.lock().values().flatten().any(|of| *of == address)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_present_addresses_of_members_count() {
        let members = MemberAddresses::default();
        let has = |address: &str| members.contains(address.parse().unwrap());
        members.set_address("pc-1", Some("http://10.0.0.1:11311/"));
        members.set_address("pc-2", Some("http://[fd00::2]:11311/"));
        assert!(has("10.0.0.1") && has("::ffff:10.0.0.1") && has("fd00::2"));
        assert!(!has("10.0.0.9") && !has("127.0.0.1"));
        members.set_address("pc-1", Some("http://10.0.0.3:11311/"));
        assert!(!has("10.0.0.1") && has("10.0.0.3"));
        members.set_address("pc-1", None);
        assert!(!has("10.0.0.3"));
    }
}
