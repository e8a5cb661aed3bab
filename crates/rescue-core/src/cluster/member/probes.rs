//! Asks the leader's rosrescue regularly whether it leads.

use std::time::Instant;

use super::{Action, Member};
use crate::cluster::machine::{self, Role};

/// The probes of the leader's rosrescue.
#[derive(Debug, Default)]
pub(super) struct Probing {
    pub(super) number: u64,
    pub(super) under_way: bool,
    pub(super) at: Option<Instant>,
}

/// How often a follower asks the leader's rosrescue whether it leads, per time to live.
pub const PROBES: u32 = 4;
/// Probes per time to live while etcd is silent, when only the leader itself shows whether it still leads.
const PROBES_IN_SILENCE: u32 = 20;

impl Member {
    /// Asks the leader's rosrescue regularly whether it leads.
    pub(super) fn update_probes(&mut self, now: Instant) {
        let asks = matches!(self.machine.role(), Role::Following | Role::Alone);
        let leader = self.leader().filter(|_| asks);
        let leader = leader.map(|(uri, term)| (uri.to_owned(), term));
        let Some((uri, term)) = leader else {
            (self.probing.under_way, self.probing.at) = (false, None);
            return;
        };
        let ttl = self.settings().ttl;
        let silent = self
            .machine
            .answered_at()
            .is_none_or(|heard| heard + ttl <= now);
        let pause = ttl / if silent { PROBES_IN_SILENCE } else { PROBES };
        let probing = &mut self.probing;
        if !probing.under_way && *probing.at.get_or_insert(now) <= now {
            probing.number += 1;
            (probing.under_way, probing.at) = (true, Some(now + pause));
            let number = probing.number;
            self.act(Action::Probe { number, uri, term });
        }
    }

    pub(super) fn probed(&mut self, number: u64, leads: bool) {
        if self.probing.under_way && self.probing.number == number {
            self.probing.under_way = false;
            self.queue_input(machine::Input::Peer(leads));
        }
    }
}
