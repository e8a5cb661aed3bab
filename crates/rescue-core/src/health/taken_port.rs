//! Finds nodes that are gone because another node now uses their port. One process listens at a port, so when a node
//! registers with a port, all other nodes registered there are gone. That does not hold for nodes that have registered
//! from different computers, because the same address may lead to a different port on each, as `localhost` does.
//!
//! A master does not know that these nodes are gone. When the old node starts again at another port, the master sends a
//! `shutdown` to the old address, where an innocent node listens now (ros_comm issue 2241).

use std::{collections::HashMap, net::IpAddr};

use super::port_of;
use crate::{
    master::{Master, Request, Write},
    replay::Token,
};

/// A port, and the computer from which it was registered; `None` for this one.
type Port<'a> = (&'a str, Option<IpAddr>);

/// The nodes registered at each port.
struct Holders<'a>(HashMap<Port<'a>, Vec<&'a str>>);

impl<'a> Holders<'a> {
    fn new(mirror: &'a Master) -> Self {
        let mut holders = Self(HashMap::new());
        for (node, api) in mirror.nodes().filter(|(node, _)| !Token::is_ours(node)) {
            let port = (port_of(api), mirror.registered_from(node));
            holders.0.entry(port).or_default().push(node);
        }
        holders
    }

    /// The nodes that lose their ports to `registrants`, the names and ports that one call registers. Names that one
    /// call registers at one port belong to one process, so they do not displace each other.
    fn displaced(&self, registrants: &[(&'a str, Port<'a>)]) -> Vec<&'a str> {
        let ports = registrants.iter();
        let holders = ports.flat_map(|(_, port)| self.0.get(port).map_or(&[][..], Vec::as_slice));
        let mut displaced: Vec<_> = holders
            .filter(|holder| !registrants.iter().any(|(node, _)| node == *holder))
            .copied()
            .collect();
        displaced.sort_unstable();
        displaced.dedup();
        displaced
    }
}

/// The nodes for which `call` or one of its entries registers something, with their ports.
fn registrants(call: &Request, from: Option<IpAddr>) -> Vec<(&str, Port<'_>)> {
    let registrants = Write::all(call).filter_map(|write| write.registrant());
    registrants
        .map(|(node, api)| (node, (port_of(api), from)))
        .collect()
}

/// The index of the first of `calls` that takes a port from a node of `mirror`, or from a node of an earlier call. Each
/// call is given with the computer from which it came; `None` for this one.
pub fn first_taking<'a>(
    mirror: &'a Master,
    calls: impl Iterator<Item = (&'a Request, Option<IpAddr>)>,
) -> Option<usize> {
    let mut holders = None;
    let mut calls = calls.map(|(call, from)| registrants(call, from));
    calls.position(|registrants| {
        if registrants.is_empty() {
            return false;
        }
        let holders = holders.get_or_insert_with(|| Holders::new(mirror));
        let takes = !holders.displaced(&registrants).is_empty();
        for (node, port) in registrants {
            holders.0.entry(port).or_default().push(node);
        }
        takes
    })
}

/// Nodes that are gone, and the call that unregisters them.
#[derive(Clone, Debug, PartialEq)]
pub struct Eviction {
    pub nodes: Vec<String>,
    pub call: Request,
}

impl Eviction {
    /// The eviction that must precede `call`, because `call` takes ports from nodes of `mirror`. `None` if `call` takes
    /// no port. A registration that the master would refuse takes no port. `from` is the computer from which the call
    /// came; `None` for this one.
    pub fn before(mirror: &Master, call: &Request, from: Option<IpAddr>) -> Option<Self> {
        first_taking(mirror, std::iter::once((call, from)))?;
        let mut after = mirror.clone();
        after.apply_telling(call, &mut ());
        let mut registrants = registrants(call, from);
        registrants.retain(|(node, (port, _))| after.api_of(node).map(port_of) == Some(port));
        let nodes = Holders::new(mirror).displaced(&registrants);
        Self::of(mirror, nodes.into_iter().map(str::to_owned))
    }

    /// The eviction of these nodes. `None` if none of them has registrations.
    pub fn of(mirror: &Master, nodes: impl IntoIterator<Item = String>) -> Option<Self> {
        let nodes: Vec<_> = nodes.into_iter().collect();
        let calls: Vec<_> = nodes
            .iter()
            .flat_map(|node| mirror.forget_calls(node))
            .collect();
        (!calls.is_empty()).then(|| Self {
            nodes,
            call: Request::multicall(calls),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::master::Method;

    fn publish(node: &str, topic: &str, api: &str) -> Request {
        Request::new(
            Method::RegisterPublisher,
            [node, topic, "std_msgs/String", api],
        )
    }

    fn offer(node: &str, service: &str, port: u16) -> Request {
        let (service_api, api) = (
            format!("rosrpc://h:{port}"),
            format!("http://h:{}/", port - 1),
        );
        Request::new(Method::RegisterService, [node, service, &service_api, &api])
    }

    fn master(calls: impl IntoIterator<Item = Request>) -> Master {
        let mut master = Master::default();
        for call in calls {
            assert!(crate::master::is_success(&master.apply(&call).reply));
        }
        master
    }

    #[test]
    fn any_registration_alone_or_in_a_multicall_can_take_a_port() {
        let mirror = master([publish("/old", "/t", "http://h:1/")]);
        let subscribe = Request::new(
            Method::SubscribeParam,
            ["/new", "http://h:1", "/gain"].map(str::to_owned),
        );
        let inner = Request::multicall([publish("/new", "/t", "http://h:1/path")]);
        for call in [
            publish("/new", "/t", "http://h:1/"),
            subscribe,
            Request::multicall([inner]),
        ] {
            let eviction = Eviction::before(&mirror, &call, None).unwrap();
            assert_eq!(eviction.nodes, ["/old"]);
            let mut mirror = mirror.clone();
            mirror.apply(&eviction.call);
            assert_eq!(mirror.api_of("/old"), None);
            assert_eq!(Eviction::before(&mirror, &call, None), None);
        }
    }

    #[test]
    fn nodes_whose_port_is_not_taken_keep_their_registrations() {
        let [_, token] = Token::new("mark", 1).leave();
        let mirror = master([publish("/old", "/t", "http://h:1/"), token]);
        let token_api = mirror.nodes().find(|(node, _)| Token::is_ours(node));
        let (_, token_api) = token_api.unwrap();
        for call in [
            // None of these takes a port: the node itself, another port, another host, a refused call, the token, and a
            // call that registers nothing.
            publish("/old", "/u", "http://h:1/"),
            publish("/new", "/t", "http://h:10/"),
            publish("/new", "/t", "http://i:1/"),
            publish("/new", "", "http://h:1/"),
            publish("/new", "/t", token_api),
            Request::new(Method::GetParam, ["/new", "/t"]),
            // A process with two names registers both in one call.
            Request::multicall([
                publish("/old", "/t", "http://h:1/"),
                publish("/new", "/t", "http://h:1/"),
            ]),
        ] {
            assert_eq!(Eviction::before(&mirror, &call, None), None, "{call:?}");
        }
    }

    /// A node whose service was taken over leaves a reference that a master never removes.
    #[test]
    fn the_reference_left_by_a_taken_over_service_is_removed_and_the_provider_keeps_the_service() {
        let mut mirror = master([
            offer("/old", "/s", 11),
            offer("/old", "/lost", 11),
            offer("/heir", "/s", 21),
            offer("/heir", "/lost", 21),
            Request::new(
                Method::UnregisterService,
                ["/heir", "/lost", "rosrpc://h:21"],
            ),
            publish("/old", "/t", "http://h:10/"),
        ]);
        let before = master([offer("/heir", "/s", 21)]).snapshot().services;
        let call = publish("/new", "/t", "http://h:10/");
        let eviction = Eviction::before(&mirror, &call, None).unwrap();
        let applied = mirror.apply(&eviction.call);
        assert_eq!(mirror.api_of("/old"), None);
        assert_eq!(mirror.snapshot().services, before);
        // No node is told to shut down.
        let told = |notice| matches!(notice, crate::master::Notice::Shutdown { .. });
        assert!(!applied.notices.into_iter().any(told));
    }

    #[test]
    fn a_batch_ends_before_a_call_that_takes_a_port() {
        let mirror = master([publish("/old", "/t", "http://h:1/")]);
        let first =
            |calls: &[Request]| first_taking(&mirror, calls.iter().map(|call| (call, None)));
        let [one, two] = ["/one", "/two"].map(|node| publish(node, "/t", "http://h:2/"));
        let old = publish("/new", "/t", "http://h:1/");
        assert_eq!(first(&[one.clone(), one.clone(), old]), Some(2));
        assert_eq!(first(&[one.clone(), two]), Some(1));
        assert_eq!(first(&[one.clone(), one]), None);
    }
}
