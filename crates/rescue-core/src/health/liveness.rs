//! Which registered nodes live, by evidence that no node notices. It is reported, and decides nothing.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::{Duration, Instant},
};

use serde::Serialize;

use super::Sign;

/// Pause before a node is asked again, unless the table of sockets answers for it.
const ASK_AGAIN: Duration = Duration::from_secs(30);
/// Evidence that is older says nothing about now.
const STALE: Duration = Duration::from_secs(120);

/// What is known of a node's life.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Health {
    /// A process listens at its port, or it has answered.
    Alive,
    /// It was not asked yet, or not lately.
    Unchecked,
    /// It does not answer, and is not known to be dead. It stays registered.
    Unreachable,
    /// Its port refuses connections, or it was found dead and unregistered and has not come back.
    Dead,
}

/// The latest evidence.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Seen {
    sign: Sign,
    pub at: Instant,
}

/// The evidence about each port where a node is registered.
#[derive(Debug, Default)]
pub struct Liveness(BTreeMap<String, Port>);

#[derive(Debug)]
struct Port {
    seen: Option<Seen>,
    /// When to ask.
    next: Instant,
    /// It is being asked.
    asked: bool,
}

impl Liveness {
    /// Returns the ports to ask now. `registered` are all that have nodes, and `listens` is whether a process
    /// listens there; none if that is not known.
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
                Some(true) => port.note(Sign::Alive, now),
                // It has just ended. A connection tells it from a port that the kernel forwards elsewhere.
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

    /// A port that was asked has given this sign, or none. Returns whether it is dead and was not before.
    pub fn answered(&mut self, port: &str, sign: Option<Sign>, now: Instant) -> bool {
        let Some(port) = self.0.get_mut(port) else {
            return false;
        };
        port.asked = false;
        port.next = now + ASK_AGAIN;
        let was_dead = port.seen.is_some_and(|seen| seen.sign == Sign::Dead);
        if let Some(sign) = sign {
            port.seen = Some(Seen { sign, at: now });
        }
        sign == Some(Sign::Dead) && !was_dead
    }

    pub fn seen(&self, port: &str) -> Option<Seen> {
        self.0.get(port)?.seen
    }
}

impl Port {
    fn note(&mut self, sign: Sign, now: Instant) {
        self.seen = Some(Seen { sign, at: now });
        self.next = now + ASK_AGAIN;
    }

    fn is_alive(&self) -> bool {
        self.seen.is_some_and(|seen| seen.sign == Sign::Alive)
    }
}

impl Health {
    /// The health of a node with this evidence. `unreachable`: it has not answered the health check or a
    /// notification.
    pub fn of(seen: Option<Seen>, unreachable: bool, now: Instant) -> Self {
        let fresh = seen.filter(|seen| now.saturating_duration_since(seen.at) < STALE);
        match fresh.map(|seen| seen.sign) {
            _ if unreachable => Self::Unreachable,
            Some(Sign::Alive) => Self::Alive,
            Some(Sign::Dead) => Self::Dead,
            Some(Sign::Silent) => Self::Unreachable,
            None => Self::Unchecked,
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
    fn a_port_of_this_computer_is_asked_when_its_process_has_ended() {
        let mut now = Instant::now();
        let mut liveness = Liveness::default();
        let all = ports(&["here"]);
        let health = |liveness: &Liveness, now| Health::of(liveness.seen("here"), false, now);
        assert_eq!(health(&liveness, now), Health::Unchecked);
        // Whose it is, is not known yet.
        assert_eq!(liveness.round(&all, |_| None, now), ["here"]);
        assert!(liveness.round(&all, |_| None, now).is_empty(), "once");
        assert!(!liveness.answered("here", Some(Sign::Alive), now));
        for _ in 0..100 {
            now += SECOND;
            assert!(liveness.round(&all, |_| Some(true), now).is_empty());
            assert_eq!(health(&liveness, now), Health::Alive);
        }
        now += SECOND;
        assert_eq!(liveness.round(&all, |_| Some(false), now), ["here"]);
        assert!(liveness.answered("here", Some(Sign::Dead), now));
        assert_eq!(health(&liveness, now), Health::Dead);
        now += SECOND;
        assert!(liveness.round(&all, |_| Some(false), now).is_empty());
        now += ASK_AGAIN;
        assert_eq!(liveness.round(&all, |_| Some(false), now), ["here"]);
        assert!(
            !liveness.answered("here", Some(Sign::Dead), now),
            "told once"
        );
        // Another process with the same port.
        assert!(liveness.round(&all, |_| Some(true), now).is_empty());
        assert_eq!(health(&liveness, now), Health::Alive);
    }

    #[test]
    fn a_port_elsewhere_is_asked_now_and_then_and_old_answers_say_nothing() {
        let mut now = Instant::now();
        let mut liveness = Liveness::default();
        let all = ports(&["far", "nowhere"]);
        assert_eq!(liveness.round(&all, |_| None, now), ["far", "nowhere"]);
        liveness.answered("far", Some(Sign::Silent), now);
        liveness.answered("nowhere", None, now);
        let health = |port, liveness: &Liveness, now| Health::of(liveness.seen(port), false, now);
        assert_eq!(health("far", &liveness, now), Health::Unreachable);
        assert_eq!(health("nowhere", &liveness, now), Health::Unchecked);
        now += ASK_AGAIN;
        assert_eq!(liveness.round(&all, |_| None, now), ["far", "nowhere"]);
        liveness.answered("far", Some(Sign::Alive), now);
        assert_eq!(health("far", &liveness, now), Health::Alive);
        assert_eq!(health("far", &liveness, now + STALE), Health::Unchecked);
        // The health check knows better.
        let seen = liveness.seen("far");
        assert_eq!(Health::of(seen, true, now), Health::Unreachable);
        liveness.round(&ports(&[]), |_| None, now);
        assert_eq!(liveness.seen("far"), None, "not registered any more");
    }
}
