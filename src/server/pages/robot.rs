//! Nodes, topics and services as the page shows them.

use std::{
    collections::BTreeMap,
    hash::{DefaultHasher, Hash, Hasher},
};

use rescue_core::{health::Health, replay::Token};
use ros1_master::master::Snapshot;
use serde::Serialize;

use crate::{clock, ledger::Ledger, nodes::Nodes};

#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize)]
pub(super) struct NodeRow {
    pub(super) name: String,
    pub(super) health: Health,
    /// When the node's `health` was last checked, in seconds since 1970.
    pub(super) checked_at: Option<u64>,
    /// Since when the node's `health` has been the same, in seconds since 1970.
    pub(super) since: Option<u64>,
    /// The node's XML-RPC address.
    pub(super) api: String,
    /// The node's process id, if the node has reported it.
    pub(super) pid: Option<i32>,
    /// The process of this computer whose end would prove the node dead.
    pub(super) process: Option<u32>,
    pub(super) publishes: Vec<String>,
    pub(super) subscribes: Vec<String>,
    pub(super) serves: Vec<String>,
    /// When the node was unregistered as dead, in seconds since 1970.
    pub(super) removed_at: Option<u64>,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize)]
pub(super) struct TopicRow {
    pub(super) name: String,
    #[serde(rename = "type")]
    pub(super) kind: String,
    pub(super) publishers: Vec<String>,
    pub(super) subscribers: Vec<String>,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize)]
pub(super) struct Service {
    pub(super) name: String,
    pub(super) node: String,
    pub(super) api: String,
}

/// Nodes, topics and services, each sorted by name.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash, Serialize)]
pub(super) struct Robot {
    pub(super) nodes: Vec<NodeRow>,
    pub(super) topics: Vec<TopicRow>,
    pub(super) services: Vec<Service>,
}

impl Robot {
    /// Reads the mirror's present content.
    pub(super) fn read(ledger: &Ledger, nodes: &Nodes) -> Self {
        let lives = nodes.lives();
        let (mirror, pids) = ledger.with_activity(|mirror, activity| {
            let pids = mirror.nodes().filter_map(|(name, api)| {
                let (pid, _) = activity.pid_of(name, api)?;
                Some((name.to_owned(), pid))
            });
            let pids: BTreeMap<String, i32> = pids.collect();
            (mirror.clone(), pids)
        });
        let mut robot = Self::from_snapshot(mirror.snapshot());
        for node in &mut robot.nodes {
            node.pid = pids.get(&node.name).copied();
            if let Some(life) = lives.get(&node.name) {
                node.health = life.health;
                node.process = life.process;
                node.since = Some(clock::wall_time_of(life.since).round() as u64);
                let at = life.checked.map(clock::wall_time_of);
                node.checked_at = at.map(|at| at.round() as u64);
            }
        }
        for (name, at) in nodes.removed.list() {
            let here = robot.nodes.iter().any(|node| node.name == name);
            if !here {
                let at = clock::wall_time_of(at);
                robot.nodes.push(NodeRow {
                    health: Health::Dead,
                    removed_at: Some(at.round() as u64),
                    ..NodeRow::registered(name, String::new())
                });
            }
        }
        robot.nodes.sort_by(|a, b| a.name.cmp(&b.name));
        robot
    }

    /// The content of a snapshot, without the [`Token`] by which rosrescue recognises a master.
    pub(super) fn from_snapshot(snapshot: Snapshot) -> Self {
        let mut nodes: BTreeMap<String, NodeRow> = BTreeMap::new();
        for (name, node) in snapshot.nodes {
            if !Token::is_ours(&name) {
                nodes.insert(name.clone(), NodeRow::registered(name, node.api));
            }
        }
        let mut topics = BTreeMap::new();
        for (published, registrations) in
            [(true, snapshot.publishers), (false, snapshot.subscribers)]
        {
            for (name, callers) in registrations {
                for caller in &callers {
                    let Some(node) = nodes.get_mut(caller) else {
                        continue;
                    };
                    let list = match published {
                        true => &mut node.publishes,
                        false => &mut node.subscribes,
                    };
                    list.push(name.clone());
                }
                let kind = snapshot.topic_types.get(&name);
                let topic = topics.entry(name.clone()).or_insert_with(|| TopicRow {
                    kind: kind.map_or("*", String::as_str).to_owned(),
                    name,
                    publishers: Vec::new(),
                    subscribers: Vec::new(),
                });
                match published {
                    true => topic.publishers = callers,
                    false => topic.subscribers = callers,
                }
            }
        }
        let services = snapshot.services.into_iter().map(|(name, entry)| {
            if let Some(node) = nodes.get_mut(&entry.node) {
                node.serves.push(name.clone());
            }
            Service {
                name,
                node: entry.node,
                api: entry.api,
            }
        });
        let mut services: Vec<_> = services.collect();
        services.sort_by(|a, b| a.name.cmp(&b.name));
        let mut nodes: Vec<_> = nodes.into_values().collect();
        for node in &mut nodes {
            for list in [&mut node.publishes, &mut node.subscribes, &mut node.serves] {
                list.sort();
            }
        }
        Self {
            nodes,
            topics: topics.into_values().collect(),
            services,
        }
    }

    /// A hash of the content, short enough for a JavaScript number.
    pub(super) fn digest(&self) -> u64 {
        let mut hasher = DefaultHasher::new();
        for node in &self.nodes {
            // Times that are computed from the clock may differ by a second.
            (&node.name, node.health, &node.api, node.pid).hash(&mut hasher);
        }
        (&self.topics, &self.services).hash(&mut hasher);
        hasher.finish() >> 12
    }
}

impl NodeRow {
    fn registered(name: String, api: String) -> Self {
        Self {
            name,
            api,
            health: Health::Unchecked,
            checked_at: None,
            since: None,
            pid: None,
            process: None,
            publishes: Vec::new(),
            subscribes: Vec::new(),
            serves: Vec::new(),
            removed_at: None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros1_master::master::{Master, Method, Request};

    #[test]
    fn each_name_is_where_it_belongs() {
        let mut master = Master::default();
        let api = "http://robot:1/";
        for (method, name, kind) in [
            (Method::RegisterPublisher, "/image", "sensor_msgs/Image"),
            (Method::RegisterSubscriber, "/trigger", "*"),
        ] {
            master.apply(&Request::new(method, ["/camera", name, kind, api]));
        }
        let service = ["/camera", "/capture", "rosrpc://robot:2", api];
        master.apply(&Request::new(Method::RegisterService, service));
        let subscription = ["/viewer", "/image", "*", "http://robot:3/"];
        master.apply(&Request::new(Method::RegisterSubscriber, subscription));
        let robot = Robot::from_snapshot(master.snapshot());
        let shown = serde_json::to_value(&robot).unwrap();
        let expected = serde_json::json!({
            "nodes": [
                {"name": "/camera", "health": "unchecked", "checked_at": null, "since": null, "api": api, "pid": null, "process": null, "publishes": ["/image"],
                 "subscribes": ["/trigger"], "serves": ["/capture"], "removed_at": null},
                {"name": "/viewer", "health": "unchecked", "checked_at": null, "since": null, "api": "http://robot:3/", "pid": null, "process": null, "publishes": [],
                 "subscribes": ["/image"], "serves": [], "removed_at": null},
            ],
            "topics": [
                {"name": "/image", "type": "sensor_msgs/Image", "publishers": ["/camera"], "subscribers": ["/viewer"]},
                {"name": "/trigger", "type": "*", "publishers": [], "subscribers": ["/camera"]},
            ],
            "services": [{"name": "/capture", "node": "/camera", "api": "rosrpc://robot:2"}],
        });
        assert_eq!(shown, expected);
        let before = robot.digest();
        master.apply(&Request::new(
            Method::UnregisterSubscriber,
            ["/viewer", "/image", "http://robot:3/"],
        ));
        assert_ne!(Robot::from_snapshot(master.snapshot()).digest(), before);
    }
}
