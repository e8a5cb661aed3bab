//! What a node's address proves. It proves something about the node only if it leads from here to where the
//! registration came from.
//!
//! A node that registers as `localhost`, or under a host name that means this computer, from another computer is not at
//! that address as seen from here. What listens there is another program, and if nothing does, the node may live.

use std::net::IpAddr;

/// What can be learned about a node at its address, as seen from this computer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reach {
    /// The address leads to where the node is. If it refuses connections, the node is dead.
    Certain,
    /// The address may lead to the node: it is neither this computer's nor the one from which the node has registered,
    /// such as another address of that computer. If it refuses connections, that proves something only about a node
    /// that has answered there before.
    Doubtful,
    /// The address does not lead to the node: it is this computer's, and the node is on another one, or this computer has
    /// lost it. Nothing at the address proves anything.
    Elsewhere {
        /// Whether it is a loopback address, so no other computer reaches the node either.
        loopback: bool,
    },
}

impl Reach {
    /// Judges a node that has registered from the computer `from`; `None` for this one, and if it is unknown. `at` are
    /// the addresses to which the node's host leads from here.
    pub fn classify(from: Option<IpAddr>, at: &[IpAddr], is_own: impl Fn(IpAddr) -> bool) -> Self {
        let Some(from) = from.filter(|from| !is_own(*from)) else {
            return Self::Certain;
        };
        let at = || at.iter().map(IpAddr::to_canonical);
        if at().any(|address| address == from.to_canonical()) {
            return Self::Certain;
        }
        match at().any(&is_own) {
            true => Self::Elsewhere {
                loopback: at().any(|address| address.is_loopback() || address.is_unspecified()),
            },
            false => Self::Doubtful,
        }
    }

    /// Whether a refused connection proves that the node is dead. `answered` says whether the node has ever answered at
    /// its address.
    pub fn refusal_proves(self, answered: bool) -> bool {
        match self {
            Self::Certain => true,
            Self::Doubtful => answered,
            Self::Elsewhere { .. } => false,
        }
    }

    /// Whether an answer from the address may be the node's.
    pub fn answer_counts(self) -> bool {
        !matches!(self, Self::Elsewhere { .. })
    }

    /// Whether the node may be notified at its address. At a loopback address a stranger would get the notification.
    pub fn may_be_notified(self) -> bool {
        self != Self::Elsewhere { loopback: true }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reach(from: Option<&str>, at: &[&str]) -> Reach {
        let address = |text: &&str| text.parse::<IpAddr>().unwrap();
        let at: Vec<_> = at.iter().map(address).collect();
        let own = ["10.0.0.7", "fd00::7", "127.0.1.1"];
        let is_own = |it: IpAddr| it.is_loopback() || own.iter().any(|own| address(own) == it);
        Reach::classify(from.as_ref().map(address), &at, is_own)
    }

    #[test]
    fn an_address_proves_something_only_if_it_leads_to_where_the_node_has_registered_from() {
        let lost = Reach::Elsewhere { loopback: true };
        let ours = Reach::Elsewhere { loopback: false };
        for (from, at, expected) in [
            // A node of this computer, or of an unknown one.
            (None, &["127.0.0.1"][..], Reach::Certain),
            (None, &["10.0.0.9"], Reach::Certain),
            // A registration that comes from one of our own addresses.
            (Some("10.0.0.7"), &["127.0.0.1"], Reach::Certain),
            (Some("10.0.0.7"), &["10.0.0.7"], Reach::Certain),
            (Some("fd00::7"), &["::1", "127.0.0.1"], Reach::Certain),
            // `localhost`, or the same host name on both computers.
            (Some("10.0.0.9"), &["127.0.0.1"], lost),
            (Some("10.0.0.9"), &["127.0.1.1"], lost),
            (Some("10.0.0.9"), &["::1"], lost),
            (Some("fd00::9"), &["127.0.0.1", "::1"], lost),
            (Some("10.0.0.9"), &["10.0.0.7"], ours),
            (Some("10.0.0.9"), &["10.0.0.8", "fd00::7"], ours),
            // Where the node is.
            (Some("10.0.0.9"), &["10.0.0.9"], Reach::Certain),
            (Some("10.0.0.9"), &["::ffff:10.0.0.9"], Reach::Certain),
            (Some("::ffff:10.0.0.9"), &["10.0.0.9"], Reach::Certain),
            (Some("fd00::9"), &["10.0.0.9", "fd00::9"], Reach::Certain),
            // Another link of that computer, or a container or a third computer with a common address.
            (Some("10.0.0.9"), &["192.168.1.9"], Reach::Doubtful),
            (Some("10.0.0.9"), &["172.17.0.2"], Reach::Doubtful),
            (Some("10.0.0.9"), &[], Reach::Doubtful),
        ] {
            assert_eq!(reach(from, at), expected, "{from:?} {at:?}");
        }
    }

    #[test]
    fn only_a_node_that_has_answered_is_dead_if_a_doubtful_address_refuses() {
        let ours = Reach::Elsewhere { loopback: false };
        assert!(Reach::Certain.refusal_proves(false));
        assert!(Reach::Doubtful.refusal_proves(true) && !Reach::Doubtful.refusal_proves(false));
        assert!(!ours.refusal_proves(true) && !ours.answer_counts());
        // A container's port may be forwarded from this address.
        assert!(ours.may_be_notified());
        assert!(!Reach::Elsewhere { loopback: true }.may_be_notified());
    }
}
