//! Recognises feuds: two programs that run under one name and take it from each other in turns, because each one is
//! started again after the other has displaced it (ros_comm issue 2018).

use std::{
    collections::BTreeMap,
    fmt,
    time::{Duration, Instant},
};

use serde::{Deserialize, Serialize};

use super::port_of;

/// A name that living programs took from each other this often within [`WITHIN`] is a feud. A person who replaces a
/// running node does it once or twice.
const TIMES: usize = 3;
/// A feud is over when the name has not been taken for this long. A feud with longer pauses is not recognised.
const WITHIN: Duration = Duration::from_secs(120);
/// Maximum number of names that are remembered.
const NAMES: usize = 256;

/// Two programs that take a name from each other.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Feud {
    pub node: String,
    /// The address that lost the name last.
    pub from: String,
    /// The address that has the name.
    pub to: String,
    /// How often the name was taken in the last two minutes.
    pub times: usize,
}

impl fmt::Display for Feud {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            node,
            from,
            to,
            times,
        } = self;
        write!(f, "{node} ({times} times, lately {to} from {from})")
    }
}

#[derive(Debug)]
struct Name {
    from: String,
    to: String,
    taken: Vec<Instant>,
}

/// The names that two running programs take from each other.
#[derive(Debug, Default)]
pub struct Feuds(BTreeMap<String, Name>);

impl Feuds {
    /// Notes that the program at `to` has taken the name `node` from the one at `from`. `lived` says whether the one at
    /// `from` was alive; `None` if that is unknown. A node that is started again after its death displaces only its
    /// ghost, which is no feud. If it is unknown, only a name that goes back and forth between two hosts counts.
    ///
    /// Returns the feud if it has just begun.
    pub fn displaced(
        &mut self,
        node: &str,
        (from, to): (&str, &str),
        lived: Option<bool>,
        now: Instant,
    ) -> Option<Feud> {
        self.forget(now);
        if !lived.unwrap_or_else(|| host(from) != host(to)) {
            return None;
        }
        if !self.0.contains_key(node) && self.0.len() >= NAMES {
            return None;
        }
        let name = self.0.entry(node.to_owned()).or_insert_with(|| Name {
            from: String::new(),
            to: String::new(),
            taken: Vec::new(),
        });
        (name.from, name.to) = (port_of(from).to_owned(), port_of(to).to_owned());
        name.taken.push(now);
        let feud = || feud(node, name);
        (name.taken.len() == TIMES).then(feud)
    }

    /// The feuds at `now`.
    pub fn list(&mut self, now: Instant) -> Vec<Feud> {
        self.forget(now);
        let feuds = self.0.iter().filter(|(_, name)| name.taken.len() >= TIMES);
        feuds.map(|(node, name)| feud(node, name)).collect()
    }

    fn forget(&mut self, now: Instant) {
        let is_recent = |at: &Instant| now.saturating_duration_since(*at) < WITHIN;
        self.0.retain(|_, name| {
            // A feud ends with a pause, and counts all its turns until then.
            if !name.taken.last().is_some_and(is_recent) {
                return false;
            }
            name.taken.retain(is_recent);
            true
        });
    }
}

fn feud(node: &str, name: &Name) -> Feud {
    Feud {
        node: node.to_owned(),
        from: name.from.clone(),
        to: name.to.clone(),
        times: name.taken.len(),
    }
}

/// The host of an address.
fn host(api: &str) -> &str {
    let port = port_of(api);
    port.rsplit_once(':').map_or(port, |(host, _)| host)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    /// A name that changes hands every `pause`, each time to a new port. Returns when the feud began, in turns.
    fn play(lived: Option<bool>, hosts: [&str; 2], pause: Duration) -> Option<usize> {
        let mut feuds = Feuds::default();
        let mut now = Instant::now();
        let api = |turn: usize| format!("http://{}:{}/", hosts[turn % 2], 100 + turn);
        (1..20).find(|turn| {
            now += pause;
            let addresses = (api(turn - 1), api(*turn));
            let addresses = (addresses.0.as_str(), addresses.1.as_str());
            feuds.displaced("/a", addresses, lived, now).is_some()
        })
    }

    #[test]
    fn two_living_programs_that_take_a_name_in_turns_are_a_feud() {
        assert_eq!(play(Some(true), ["h", "h"], SECOND), Some(3));
        assert_eq!(play(Some(true), ["h", "h"], SECOND * 55), Some(3));
        // Two computers, which the kernel does not show.
        assert_eq!(play(None, ["h", "i"], SECOND), Some(3));
    }

    #[test]
    fn a_node_that_crashes_again_and_again_is_no_feud() {
        assert_eq!(play(Some(false), ["h", "h"], SECOND), None);
        assert_eq!(play(None, ["h", "h"], SECOND), None);
        assert_eq!(play(Some(false), ["h", "i"], SECOND), None);
    }

    #[test]
    fn a_person_who_replaces_a_node_now_and_then_is_no_feud() {
        assert_eq!(play(Some(true), ["h", "h"], SECOND * 61), None);
    }

    #[test]
    fn a_feud_is_over_after_two_minutes_without_a_turn() {
        let mut feuds = Feuds::default();
        let start = Instant::now();
        for turn in 0..5 {
            let api = ("http://h:1/", "http://h:2/");
            let begun = feuds.displaced("/a", api, Some(true), start + SECOND * turn);
            assert_eq!(begun.is_some(), turn == 2);
        }
        let [feud] = feuds.list(start + SECOND * 100).try_into().unwrap();
        assert_eq!(
            (feud.from.as_str(), feud.to.as_str()),
            ("http://h:1", "http://h:2")
        );
        assert_eq!(feud.times, 5);
        assert_eq!(feuds.list(start + SECOND * 124), []);
    }
}
