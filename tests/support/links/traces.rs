//! Notifications and answers about topics that nodes received, with their times.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::Value as Json;

/// One notification or answer about a topic that a node received.
#[derive(Clone, Debug)]
struct Event {
    at: f64,
    what: String,
    uris: BTreeSet<String>,
}

/// All requests, answers and notifications of rospy nodes, by topic.
#[derive(Debug)]
pub(crate) struct Traces {
    begin: f64,
    /// Events by topic and node.
    events: BTreeMap<(String, String), Vec<Event>>,
    names: BTreeMap<String, String>,
}

impl Traces {
    pub(super) fn new(begin: f64) -> Self {
        Self {
            begin,
            events: BTreeMap::new(),
            names: BTreeMap::new(),
        }
    }

    /// Adds the events that a node has written.
    pub(super) fn add(&mut self, node: &str, api: &str, events: &Json) {
        self.names.insert(api.to_owned(), node.to_owned());
        for event in events.as_array().unwrap() {
            let text = |place: usize| event[place].as_str().unwrap().to_owned();
            let uris = event[3].as_array().unwrap().iter();
            let uris = uris.map(|uri| uri.as_str().unwrap().to_owned()).collect();
            let key = (text(2), node.to_owned());
            self.events.entry(key).or_default().push(Event {
                at: event[0].as_f64().unwrap(),
                what: text(1),
                uris,
            });
        }
    }

    /// Describes the events of `topic` in `node` and in its publishers, one line per event.
    pub(super) fn of(&self, topic: &str, node: &str) -> String {
        let mut lines = Vec::new();
        for ((of, at), events) in &self.events {
            for event in events.iter().filter(|_| of == topic) {
                if at == node || event.what.ends_with(" pub") {
                    lines.push((event.at, self.line(at, event)));
                }
            }
        }
        lines.sort_by(|a, b| a.0.total_cmp(&b.0));
        lines.into_iter().map(|(_, line)| line + "\n").collect()
    }

    fn line(&self, node: &str, event: &Event) -> String {
        let name = |uri: &String| self.names.get(uri).unwrap_or(uri).clone();
        let names: Vec<_> = event.uris.iter().map(name).collect();
        let ms = (event.at - self.begin) * 1e3;
        format!(
            "    {ms:9.3} ms {node} {} [{}]",
            event.what,
            names.join(", ")
        )
    }

    /// Lists from `source` that lack a publisher that the node already knew. No publisher ends while the nodes start,
    /// so such a list is older than the one before.
    pub(super) fn older(&self, source: &str) -> Vec<String> {
        let mut found = Vec::new();
        for ((topic, node), events) in &self.events {
            let mut known = BTreeSet::new();
            for event in events {
                if event.what == source && !known.is_subset(&event.uris) {
                    let line = self.line(node, event);
                    found.push(format!("{topic}:{line}, after:\n{}", self.of(topic, node)));
                }
                if ["answer", "update"].contains(&event.what.as_str()) {
                    known.extend(event.uris.iter().cloned());
                }
            }
        }
        found
    }
}
