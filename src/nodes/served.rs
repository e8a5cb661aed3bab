//! Remembers the hosts whose nodes use this rosrescue as their master, for a robot with several computers.

use std::{
    collections::HashSet,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use rescue_core::health::port_of;
use ros1_master::master::{Request, Write};

use crate::ros_env::MasterUri;

/// Maximum number of hosts that are remembered. A robot has few.
const MOST: usize = 1024;

/// The hosts of nodes that have registered at this computer's rosrescue.
#[derive(Clone, Debug, Default)]
pub(crate) struct Served(Arc<Mutex<HashSet<String>>>);

impl Served {
    fn lock(&self) -> MutexGuard<'_, HashSet<String>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes the host of the node that `call` registers.
    pub(crate) fn add(&self, call: &Request) {
        for write in Write::all(call) {
            let Some(host) = write.registrant().and_then(|(_, api)| host_of(api)) else {
                continue;
            };
            let mut hosts = self.lock();
            if hosts.len() < MOST {
                hosts.insert(host);
            }
        }
    }

    /// Whether nodes at the host of `api` use this rosrescue.
    pub(crate) fn serves_host_of(&self, api: &str) -> bool {
        host_of(api).is_some_and(|host| self.lock().contains(&host))
    }
}

fn host_of(api: &str) -> Option<String> {
    MasterUri::parse(port_of(api)).ok().map(|uri| uri.host)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros1_master::master::Method;

    #[test]
    fn a_host_is_ours_once_a_node_there_has_registered_here() {
        let served = Served::default();
        let api = "http://arm:40001/";
        assert!(!served.serves_host_of(api));
        served.add(&Request::new(Method::SetParam, ["/n", "/p", api]));
        assert!(!served.serves_host_of(api));
        let publish = Request::new(Method::RegisterPublisher, ["/n", "/t", "x/Y", api]);
        served.add(&Request::multicall([publish]));
        assert!(served.serves_host_of(api) && served.serves_host_of("http://arm:40002"));
        assert!(!served.serves_host_of("http://base:40001/"));
    }
}
