//! Describes how the states of the mirror and a master differ.

use ros1_master::master::{Master, OrderedMap};
use ros1_master::xmlrpc::{Struct, Value};

/// Maximum number of sentences.
const SENTENCES_MAX: usize = 20;

/// The differences between `mirror` and `master` as at most 20 short sentences. There are none if and only if the two
/// are equal. The sentences contain keys, nodes and addresses, but never a parameter's value.
pub fn difference(mirror: &Master, master: &Master) -> Vec<String> {
    let mut words = Sentences(Vec::new());
    let (a, b) = (mirror.registry(), master.registry());
    words.map("the node", &a.nodes, &b.nodes, |words, caller_id, a, b| {
        if a.api != b.api {
            words.add(|| {
                format!(
                    "the node `{caller_id}` is at {} in the mirror and at {} in the master",
                    a.api, b.api
                )
            });
        } else if a != b {
            words.add(|| format!("the node `{caller_id}` has other registrations in the master"));
        }
    });
    for (what, a, b) in [
        ("publishers", &a.publishers, &b.publishers),
        ("subscribers", &a.subscribers, &b.subscribers),
        (
            "parameter subscribers",
            &a.param_subscribers,
            &b.param_subscribers,
        ),
    ] {
        words.map(&format!("{what} of"), a, b, |words, key, a, b| {
            for node in a.iter().filter(|node| !b.contains(node)) {
                words.add(|| format!("`{node}` is among the {what} of `{key}` only in the mirror"));
            }
            for node in b.iter().filter(|node| !a.contains(node)) {
                words.add(|| format!("`{node}` is among the {what} of `{key}` only in the master"));
            }
            if a != b {
                words.add(|| format!("the {what} of `{key}` differ, or are in another order"));
            }
        });
        words.order(what, a, b);
    }
    words.map("the service", &a.services, &b.services, |words, service, a, b| {
        if a != b {
            words.add(|| format!(
                "the service `{service}` is from `{}` at {} in the mirror and from `{}` at {} in the master",
                a.node, a.api, b.node, b.api
            ));
        }
    });
    words.order("services", &a.services, &b.services);
    if a.had_services != b.had_services {
        words.add(|| "only one of the two has ever had a service".to_owned());
    }
    let (a, b) = (mirror.topic_types(), master.topic_types());
    words.map("the type of", a, b, |words, topic, a, b| {
        if a != b {
            words.add(|| {
                format!("the type of `{topic}` is {a} in the mirror and {b} in the master")
            });
        }
    });
    words.order("topic types", a, b);
    words.params("", mirror.params(), master.params());
    words.0
}

struct Sentences(Vec<String>);

impl Sentences {
    fn add(&mut self, sentence: impl FnOnce() -> String) {
        if self.0.len() < SENTENCES_MAX {
            self.0.push(sentence());
        }
    }

    fn map<T>(
        &mut self,
        what: &str,
        a: &OrderedMap<T>,
        b: &OrderedMap<T>,
        mut both: impl FnMut(&mut Self, &str, &T, &T),
    ) {
        for (key, value) in a {
            match b.get(key) {
                Some(other) => both(self, key, value, other),
                None => self.add(|| format!("{what} `{key}` is only in the mirror")),
            }
        }
        for key in b.keys().filter(|key| !a.contains_key(key)) {
            self.add(|| format!("{what} `{key}` is only in the master"));
        }
    }

    fn order<T>(&mut self, what: &str, a: &OrderedMap<T>, b: &OrderedMap<T>) {
        if a.len() == b.len() && a.keys().all(|key| b.contains_key(key)) && !a.keys().eq(b.keys()) {
            self.add(|| format!("the {what} are in another order"));
        }
    }

    fn params(&mut self, path: &str, a: &Struct, b: &Struct) {
        if a.iter().eq(b) {
            return;
        }
        for (key, value) in a {
            match (value, b.get(key)) {
                (Value::Struct(value), Some(Value::Struct(other))) => {
                    self.params(&format!("{path}/{key}"), value, other);
                }
                (value, Some(other)) if value == other => {}
                (_, Some(_)) => {
                    self.add(|| format!("the parameter `{path}/{key}` has another value"))
                }
                (_, None) => {
                    self.add(|| format!("the parameter `{path}/{key}` is only in the mirror"))
                }
            }
        }
        for key in b.keys().filter(|key| !a.contains_key(*key)) {
            self.add(|| format!("the parameter `{path}/{key}` is only in the master"));
        }
        if a.len() == b.len() && a.keys().all(|key| b.contains_key(key)) && !a.keys().eq(b.keys()) {
            self.add(|| format!("the parameters below `{path}/` are in another order"));
        }
    }
}
