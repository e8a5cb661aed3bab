//! A name that moves: another program registers it, at another address. A master then tells the node at the old address
//! to shut down. By now an innocent node may listen there (ros_comm issue 2241).

use std::net::IpAddr;

use super::{Evidence, Reach, mutant::WrongRule, port_of};
use crate::replay::Token;
use ros1_master::master::{Master, Request, Write};

/// Which dead nodes rosrescue unregisters on its own.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Reap {
    /// None. The log reports what the other modes would have done.
    #[default]
    Report,
    /// Nodes of this computer whose end the kernel proves.
    Local,
    /// Also nodes that fail a health check.
    All,
}

/// A name that a call takes away from the node at `from`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Moving {
    pub node: String,
    pub from: String,
    pub to: String,
    /// Other names at the port of `from`.
    pub others: Vec<String>,
    /// The computer from which the node at `from` has registered; `None` for this one.
    pub computer: Option<IpAddr>,
}

impl Moving {
    /// The names that `call` moves. A master tells the nodes at their old addresses to shut down. A registration that the
    /// master would refuse moves nothing.
    pub fn caused_by(mirror: &Master, call: &Request) -> Vec<Self> {
        let mut all: Vec<Self> = Vec::new();
        if !Self::moves_any(mirror, call) {
            return all;
        }
        let mut after = mirror.clone();
        after.apply_telling(call, &mut ());
        for (node, to) in Write::all(call).filter_map(|write| write.registrant()) {
            let Some(from) = mirror.api_of(node) else {
                continue;
            };
            let is_known = all.iter().any(|moving| moving.node == node);
            let is_refused = after.api_of(node) == Some(from);
            let stays = port_of(from) == port_of(to);
            if is_known || is_refused || stays || Token::is_ours(node) {
                continue;
            }
            // The same address given by another computer may lead to another port.
            let others = mirror.nodes_at(port_of(from)).filter(|(other, _)| {
                *other != node
                    && mirror.registered_from(other) == mirror.registered_from(node)
                    && !Token::is_ours(other)
            });
            all.push(Self {
                node: node.to_owned(),
                from: from.to_owned(),
                to: to.to_owned(),
                others: others.map(|(other, _)| other.to_owned()).collect(),
                computer: mirror.registered_from(node),
            });
        }
        all
    }

    /// Whether `call` moves a name.
    pub fn moves_any(mirror: &Master, call: &Request) -> bool {
        let mut names = Write::all(call).filter_map(|write| write.registrant());
        names.any(|(node, to)| {
            let from = mirror.api_of(node);
            from.is_some_and(|from| port_of(from) != port_of(to) && !Token::is_ours(node))
        })
    }

    /// What the kernel shows about the node at the old address if that is a loopback address, and the node is on another
    /// computer. `None` otherwise. `listens` says whether a process of this computer listens there.
    pub fn evidence_elsewhere(reach: Reach, listens: bool) -> Option<Evidence> {
        (!reach.may_be_notified()).then_some(match listens {
            true => Evidence::Replaced,
            false => Evidence::Unknown,
        })
    }

    /// Whether the master's `shutdown` would reach another node than the one that had the name.
    pub fn hits_another(&self, evidence: Evidence) -> bool {
        match evidence {
            Evidence::Ended(death) => death.taken,
            Evidence::Replaced => !WrongRule::OnlyNamesCount.lives(),
            // One process listens at a port. So if another name is registered there, the moving one may be a ghost.
            Evidence::Listens | Evidence::Unknown => !self.others.is_empty(),
        }
    }

    /// Whether the old node must be unregistered before the call, so that the master sends no `shutdown`.
    pub fn is_unregistered_first(&self, reap: Reap, evidence: Evidence) -> bool {
        let has_ended = matches!(evidence, Evidence::Ended(_));
        let must_precede = has_ended || self.hits_another(evidence);
        reap != Reap::Report && must_precede && !WrongRule::MovesUnjudged.lives()
    }
}

/// Nodes that are gone, and the call that unregisters them.
#[derive(Clone, Debug, PartialEq)]
pub struct Eviction {
    pub nodes: Vec<String>,
    pub call: Request,
}

impl Eviction {
    /// The eviction of these nodes. `None` if none of them has registrations.
    pub fn for_nodes(mirror: &Master, nodes: impl IntoIterator<Item = String>) -> Option<Self> {
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
    use ros1_master::master::Method;

    fn publish(node: &str, api: &str) -> Request {
        Request::new(Method::RegisterPublisher, [node, "/t", "x/Y", api])
    }

    #[test]
    fn a_name_moves_when_it_is_registered_at_another_port() {
        let mut mirror = Master::default();
        for (node, port) in [("/a", 1), ("/b", 1), ("/c", 2)] {
            mirror.apply(&publish(node, &format!("http://h:{port}/")));
        }
        let moved = |call: &Request| Moving::caused_by(&mirror, call);
        for call in [publish("/a", "http://h:1"), publish("/new", "http://h:1/")] {
            assert_eq!(moved(&call), []);
            assert!(!Moving::moves_any(&mirror, &call));
        }
        let both = Request::multicall([
            publish("/a", "http://h:3/"),
            publish("/a", "http://h:3/"),
            publish("/c", "http://h:3/"),
        ]);
        assert!(Moving::moves_any(&mirror, &both));
        let [a, c] = moved(&both).try_into().unwrap();
        assert_eq!((a.node.as_str(), a.from.as_str()), ("/a", "http://h:1/"));
        assert_eq!((a.others, c.others), (vec!["/b".to_owned()], vec![]));
    }

    #[test]
    fn a_node_that_is_there_is_shut_down_and_an_innocent_one_is_not() {
        let moving = |others: &[&str]| Moving {
            node: "/a".to_owned(),
            from: "http://h:1/".to_owned(),
            to: "http://h:2/".to_owned(),
            others: others.iter().map(|other| (*other).to_owned()).collect(),
            computer: None,
        };
        let alone = moving(&[]);
        let first = |moving: &Moving, evidence| {
            let of = |reap| moving.is_unregistered_first(reap, evidence);
            assert!(!of(Reap::Report));
            assert_eq!(of(Reap::Local), of(Reap::All));
            of(Reap::Local)
        };
        // The old program runs, and its name was taken: it must end, as with a bare master.
        assert!(!first(&alone, Evidence::Listens));
        assert!(!first(&alone, Evidence::Unknown));
        assert!(first(&alone, Evidence::Replaced));
        let other = moving(&["/b"]);
        for evidence in [Evidence::Listens, Evidence::Unknown, Evidence::Replaced] {
            assert!(first(&other, evidence));
        }
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
            assert!(ros1_master::master::is_success(&master.apply(&call).reply));
        }
        master
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
            publish("/old", "http://h:10/"),
        ]);
        let before = master([offer("/heir", "/s", 21)]).snapshot().services;
        let eviction = Eviction::for_nodes(&mirror, ["/old".to_owned()]).unwrap();
        let applied = mirror.apply(&eviction.call);
        assert_eq!(mirror.api_of("/old"), None);
        assert_eq!(mirror.snapshot().services, before);
        // No node is told to shut down.
        let told = |notice| matches!(notice, ros1_master::master::Notice::Shutdown { .. });
        assert!(!applied.notices.into_iter().any(told));
    }
}
