//! Detects another living computer with this one's name, before this one joins the cluster. Pure.
//!
//! Keys in etcd may name a computer with the same name and another address. That computer is alive if the keys change:
//! `alive` several times per time to live, the entry among the members every five seconds. If they do not change, they
//! are from a time when this computer had another address.

use std::time::{Duration, Instant};

use crate::cluster::machine::{Settings, View};

/// A living computer updates its entry among the members within this time.
pub const MEMBER_SAYS: Duration = Duration::from_secs(7);
/// A namesake that begins to lead within this time after this computer's start counts as started first.
const YOUNG: Duration = Duration::from_secs(15);

/// Which of the keys in etcd another computer with this one's name wrote.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Key {
    /// The keys `leader` and `alive`.
    Leader,
    /// The entry among the members.
    Member,
}

/// Evidence of another computer with this one's name: a key that it wrote.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sign {
    pub key: Key,
    /// The address of the computer that wrote the key.
    pub uri: String,
    /// The revision of the key's last change.
    pub revision: u64,
}

/// Evidence in `leader` and `alive` of another computer with this one's name, if there is any.
pub fn sign_of_leader(own: &Settings, view: &View) -> Option<Sign> {
    let leader = view.leader.as_ref()?;
    let alive = view.alive.as_ref();
    let is_other = leader.id != own.id
        && leader.name == own.name
        && !own.is_of_this_computer(&leader.name, &leader.uri, &leader.boot);
    // A computer that has given up leadership writes no more, so its keys are no sign of life.
    let leads = alive.is_none_or(|alive| alive.released.is_none());
    (is_other && leads).then(|| Sign {
        key: Key::Leader,
        uri: leader.uri.clone(),
        revision: alive.map_or(leader.term, |alive| alive.revision),
    })
}

/// Finds out whether another computer with this one's name is alive: compares that computer's keys in etcd with those
/// that were seen when this one started.
#[derive(Clone, Debug)]
pub struct NamesakeWatch {
    first: Vec<Sign>,
    since: Instant,
    hold: Option<Instant>,
}

impl NamesakeWatch {
    /// Creates a watch. `first` are the keys in etcd at `now` that another computer with this one's name wrote; `ttl`
    /// is the time to live of a leader.
    pub fn new(now: Instant, ttl: Duration, first: Vec<Sign>) -> Self {
        let limits = first.iter().map(|sign| match sign.key {
            Key::Leader => ttl,
            Key::Member => MEMBER_SAYS,
        });
        Self {
            hold: limits.max().map(|limit| now + limit),
            first,
            since: now,
        }
    }

    /// Until when this computer must wait to see whether these keys change. `None` if it may start at once.
    pub fn hold(&self) -> Option<Instant> {
        self.hold
    }

    /// The address of the other computer that may have this one's name.
    pub fn suspect(&self) -> Option<&str> {
        self.first.first().map(|sign| sign.uri.as_str())
    }

    /// Whether this computer may write its entry among the members at `now`. Earlier, it would overwrite the entry of
    /// another computer with its name.
    pub fn is_over(&self, now: Instant) -> bool {
        self.hold.is_none_or(|until| until <= now)
    }

    /// The living computer with this one's name, if `signs`, its keys in etcd at `now`, prove that there is one.
    pub fn living<'a>(&self, now: Instant, signs: &'a [Sign]) -> Option<&'a Sign> {
        signs.iter().find(|sign| {
            let counts = match sign.key {
                Key::Leader => now < self.since + YOUNG,
                // Of two namesakes that start together, only the one that does not lead stops.
                Key::Member => !self.is_over(now),
            };
            counts && !self.first.contains(sign)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cluster::machine::{Alive, Commit, Leader, WhenAlone};

    const TTL: Duration = Duration::from_secs(2);

    fn settings(uri: &str) -> Settings {
        Settings {
            name: "a".to_owned(),
            id: "a-2".to_owned(),
            uri: uri.to_owned(),
            boot: "boot-2".to_owned(),
            version: String::new(),
            ttl: TTL,
            commit: Commit::Always,
            alone: WhenAlone::Serve,
        }
    }

    fn led(name: &str, uri: &str, boot: &str, revision: u64) -> View {
        View {
            origin: 1,
            journal_number: 1,
            revision,
            leader: Some(Leader {
                term: 3,
                name: name.to_owned(),
                id: format!("{name}-1"),
                claim: 1,
                claimed_at: 0,
                uri: uri.to_owned(),
                boot: boot.to_owned(),
                version: String::new(),
            }),
            alive: Some(Alive {
                revision,
                beat: 1,
                seq: 0,
                released: None,
                settled: true,
            }),
        }
    }

    fn member(uri: &str, revision: u64) -> Sign {
        Sign {
            key: Key::Member,
            uri: uri.to_owned(),
            revision,
        }
    }

    #[test]
    fn a_leader_of_the_same_name_elsewhere_is_a_sign_and_an_earlier_boot_of_this_computer_is_not() {
        let (here, there) = ("http://10.0.0.1:11311/", "http://10.0.0.2:11311/");
        let is_sign = |own: &Settings, view| sign_of_leader(own, &view).is_some();
        assert!(is_sign(&settings(here), led("a", there, "", 5)));
        assert!(!is_sign(&settings(here), led("b", there, "", 5)));
        assert!(!is_sign(&settings(here), led("a", here, "", 5)));
        // Copies of one disk without ROS_IP: both say the host name.
        let copy = "http://robot:11311/";
        assert!(is_sign(&settings(copy), led("a", copy, "boot-1", 5)));
        assert!(!is_sign(&settings(copy), led("a", copy, "boot-2", 5)));
        let mut released = led("a", there, "", 5);
        released.alive.as_mut().unwrap().released = Some(String::new());
        assert!(!is_sign(&settings(here), released));
    }

    #[test]
    fn a_namesake_is_alive_if_its_keys_change_and_forgotten_if_they_do_not() {
        let now = Instant::now();
        let there = "http://10.0.0.2:11311/";
        let watch = NamesakeWatch::new(now, TTL, vec![member(there, 5)]);
        assert_eq!(watch.hold(), Some(now + MEMBER_SAYS));
        assert!(!watch.is_over(now));
        assert_eq!(watch.living(now + TTL, &[member(there, 5)]), None);
        let changed = [member(there, 6)];
        assert_eq!(watch.living(now + TTL, &changed), changed.first());
        assert!(watch.is_over(now + MEMBER_SAYS));
        assert_eq!(watch.living(now + MEMBER_SAYS, &changed), None);
        let leader = |revision| sign_of_leader(&settings("u"), &led("a", there, "", revision));
        let [first, next] = [5, 6].map(|revision| leader(revision).unwrap());
        let watch = NamesakeWatch::new(now, TTL, vec![first.clone()]);
        assert_eq!(watch.hold(), Some(now + TTL));
        assert_eq!(watch.living(now, &[first]), None);
        assert_eq!(watch.living(now, std::slice::from_ref(&next)), Some(&next));
    }

    #[test]
    fn of_two_that_start_together_the_one_that_does_not_lead_notices() {
        let now = Instant::now();
        let watch = NamesakeWatch::new(now, TTL, Vec::new());
        assert_eq!((watch.hold(), watch.suspect()), (None, None));
        let there = "http://10.0.0.2:11311/";
        assert_eq!(watch.living(now, &[member(there, 5)]), None);
        let leader = sign_of_leader(&settings("u"), &led("a", there, "", 7)).unwrap();
        let signs = [member(there, 5), leader.clone()];
        assert_eq!(watch.living(now, &signs), Some(&leader));
        assert_eq!(watch.living(now + YOUNG, &signs), None);
    }
}
