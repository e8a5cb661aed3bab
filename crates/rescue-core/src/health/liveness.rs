//! Finds out which registered nodes are alive, without disturbing them. The result is only reported; nothing is
//! unregistered because of it.

use std::{
    collections::{BTreeSet, HashMap},
    time::{Duration, Instant},
};

use serde::{Deserialize, Serialize};

use super::{Evidence, Reach, Reaction};

/// Pause before a node is asked again. It is shorter if the socket table shows that its process has ended.
const ASK_AGAIN: Duration = Duration::from_secs(30);
/// Age from which the last [`Reaction`] of a port no longer counts.
const STALE: Duration = Duration::from_secs(120);

/// Whether a node is alive, as far as known.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Health {
    /// A process listens at the node's port, or the node has answered.
    Alive,
    /// Nothing has shown in the last two minutes whether the node is alive.
    Unchecked,
    /// The node does not answer, and there is no proof that it is dead. It stays registered.
    Unreachable,
    /// The node's port refuses connections; or the node was unregistered as dead and has not come back.
    Dead,
}

/// The last [`Reaction`] of a port, and when it was seen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Seen {
    sign: Reaction,
    pub at: Instant,
}

/// The last [`Reaction`] of each port at which a node is registered.
#[derive(Debug, Default)]
pub struct Liveness(HashMap<String, Port>);

#[derive(Debug)]
struct Port {
    seen: Option<Seen>,
    /// When to ask at the port next.
    next: Instant,
    /// Whether a question to the port is unanswered.
    asked: bool,
}

impl Liveness {
    /// The ports to ask now. `registered` are all ports with nodes. `listens` says whether a process listens at a port;
    /// `None` if that is unknown.
    pub fn round(
        &mut self,
        registered: &BTreeSet<String>,
        listens: impl Fn(&str) -> Option<bool>,
        now: Instant,
    ) -> Vec<String> {
        self.0.retain(|port, _| registered.contains(port));
        let mut due = Vec::new();
        for name in registered {
            if !self.0.contains_key(name) {
                let new = Port {
                    seen: None,
                    next: now,
                    asked: false,
                };
                self.0.insert(name.clone(), new);
            }
            let Some(port) = self.0.get_mut(name) else {
                continue;
            };
            match listens(name) {
                Some(true) => port.note(Reaction::Alive, now),
                // The process has just ended, or the kernel forwards the port elsewhere. A connection shows which.
                Some(false) if port.is_alive() => port.next = now,
                _ => {}
            }
            if !port.asked && port.next <= now {
                port.asked = true;
                due.push(name.clone());
            }
        }
        due
    }

    /// Notes the answer from a port, if there was one. Returns whether the port has just been found dead.
    pub fn note_answer(&mut self, port: &str, sign: Option<Reaction>, now: Instant) -> bool {
        let Some(port) = self.0.get_mut(port) else {
            return false;
        };
        port.asked = false;
        port.next = now + ASK_AGAIN;
        let was_dead = port.seen.is_some_and(|seen| seen.sign == Reaction::Dead);
        if let Some(sign) = sign {
            port.seen = Some(Seen { sign, at: now });
        }
        sign == Some(Reaction::Dead) && !was_dead
    }

    pub fn last_seen(&self, port: &str) -> Option<Seen> {
        self.0.get(port)?.seen
    }
}

impl Port {
    fn note(&mut self, sign: Reaction, now: Instant) {
        self.seen = Some(Seen { sign, at: now });
        self.next = now + ASK_AGAIN;
    }

    fn is_alive(&self) -> bool {
        self.seen.is_some_and(|seen| seen.sign == Reaction::Alive)
    }
}

impl Health {
    /// The health of a node whose port was last seen as in `seen`. `unreachable` says whether the node left a health
    /// check or a notification unanswered. That may be because its port refuses connections.
    pub fn from_last_seen(seen: Option<Seen>, unreachable: bool, now: Instant) -> Self {
        let fresh = seen.filter(|seen| now.saturating_duration_since(seen.at) < STALE);
        match fresh.map(|seen| seen.sign) {
            Some(Reaction::Dead) => Self::Dead,
            _ if unreachable => Self::Unreachable,
            Some(Reaction::Alive) => Self::Alive,
            Some(Reaction::Silent) => Self::Unreachable,
            None => Self::Unchecked,
        }
    }

    /// This health of a node's port, as far as the address proves something about the node. `answered` says whether the
    /// node has ever answered there.
    pub fn as_proved(self, reach: Reach, answered: bool) -> Self {
        match self {
            _ if !reach.answer_counts() => Self::Unchecked,
            Self::Dead if !reach.refusal_proves(answered) => Self::Unreachable,
            health => health,
        }
    }

    /// This health of a node's port, corrected by what the kernel shows about the node itself.
    pub fn corrected_by(self, evidence: Evidence) -> Self {
        match evidence {
            Evidence::Ended(_) => Self::Dead,
            // The process at the port may be another one.
            Evidence::Replaced => Self::Unchecked,
            Evidence::Listens | Evidence::Unknown => self,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    fn ports(names: &[&str]) -> BTreeSet<String> {
        names.iter().map(|name| (*name).to_owned()).collect()
    }

    #[test]
    fn a_port_of_this_computer_is_asked_as_soon_as_its_process_has_ended() {
        let mut now = Instant::now();
        let mut liveness = Liveness::default();
        let all = ports(&["here"]);
        let health = |liveness: &Liveness, now| {
            Health::from_last_seen(liveness.last_seen("here"), false, now)
        };
        assert_eq!(health(&liveness, now), Health::Unchecked);
        // The socket table has not been read yet.
        assert_eq!(liveness.round(&all, |_| None, now), ["here"]);
        assert!(liveness.round(&all, |_| None, now).is_empty(), "once");
        assert!(!liveness.note_answer("here", Some(Reaction::Alive), now));
        for _ in 0..100 {
            now += SECOND;
            assert!(liveness.round(&all, |_| Some(true), now).is_empty());
            assert_eq!(health(&liveness, now), Health::Alive);
        }
        now += SECOND;
        assert_eq!(liveness.round(&all, |_| Some(false), now), ["here"]);
        assert!(liveness.note_answer("here", Some(Reaction::Dead), now));
        assert_eq!(health(&liveness, now), Health::Dead);
        now += SECOND;
        assert!(liveness.round(&all, |_| Some(false), now).is_empty());
        now += ASK_AGAIN;
        assert_eq!(liveness.round(&all, |_| Some(false), now), ["here"]);
        assert!(
            !liveness.note_answer("here", Some(Reaction::Dead), now),
            "told once"
        );
        // Another process uses the same port now.
        assert!(liveness.round(&all, |_| Some(true), now).is_empty());
        assert_eq!(health(&liveness, now), Health::Alive);
    }

    #[test]
    fn a_port_of_another_computer_is_asked_from_time_to_time_and_old_answers_expire() {
        let mut now = Instant::now();
        let mut liveness = Liveness::default();
        let all = ports(&["far", "nowhere"]);
        assert_eq!(liveness.round(&all, |_| None, now), ["far", "nowhere"]);
        liveness.note_answer("far", Some(Reaction::Silent), now);
        liveness.note_answer("nowhere", None, now);
        let health = |port, liveness: &Liveness, now| {
            Health::from_last_seen(liveness.last_seen(port), false, now)
        };
        assert_eq!(health("far", &liveness, now), Health::Unreachable);
        assert_eq!(health("nowhere", &liveness, now), Health::Unchecked);
        now += ASK_AGAIN;
        assert_eq!(liveness.round(&all, |_| None, now), ["far", "nowhere"]);
        liveness.note_answer("far", Some(Reaction::Alive), now);
        assert_eq!(health("far", &liveness, now), Health::Alive);
        assert_eq!(health("far", &liveness, now + STALE), Health::Unchecked);
        // The health check's result takes precedence.
        let seen = liveness.last_seen("far");
        assert_eq!(Health::from_last_seen(seen, true, now), Health::Unreachable);
        liveness.round(&ports(&[]), |_| None, now);
        assert_eq!(liveness.last_seen("far"), None, "not registered any more");
    }
}
