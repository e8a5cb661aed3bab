//! The state of the robot before and after a drill: what the master says, and the process of each node.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use tokio::task::JoinSet;

use super::{PREFIX, calls::Api};
use crate::{
    master,
    nodes::client::{self, Reaction},
    xmlrpc::Value,
};

/// Longest time for a node to report its process id.
const NODE_LIMIT: Duration = Duration::from_secs(5);

/// Names of facts about parameters begin with this.
const PARAMETER: &str = "the parameter ";

/// The robot's state at one moment, without what belongs to drills.
#[derive(Clone, Debug, Default)]
pub(super) struct RobotState {
    /// Registrations, types and parameters, each under a name for people.
    facts: BTreeMap<String, Value>,
    /// Each node's process id. `None` if the node did not answer.
    nodes: BTreeMap<String, Option<i32>>,
}

/// How the robot's state differs between two moments.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct DrillDifference {
    /// Facts that are gone or changed.
    pub(super) lost: Vec<String>,
    /// Facts that are new, or changed by other programs.
    pub(super) new: Vec<String>,
}

impl RobotState {
    pub(super) async fn read(api: &Api) -> Result<Self, String> {
        let state = api.call("getSystemState", &[]).await?;
        let types = api.call("getTopicTypes", &[]).await?;
        // A master may hold a parameter that it can never return, so this call may fail.
        let params = api.call("getParam", &["/".into()]).await;
        let params = params.unwrap_or(Value::Nil);
        let (facts, names) = facts(&state, &types, &params);
        let mut questions = JoinSet::new();
        for name in names {
            let found = api.call("lookupNode", &[name.as_str().into()]).await?;
            questions.spawn(async move {
                let node = found.as_str().unwrap_or_default();
                let answer = client::ask_for(node, &master::get_pid(), NODE_LIMIT).await;
                let pid = match answer {
                    (Reaction::Alive, Some(pid)) => pid.as_int(),
                    _ => None,
                };
                (name, pid)
            });
        }
        let nodes = questions.join_all().await.into_iter().collect();
        Ok(Self { facts, nodes })
    }

    pub(super) fn counts(&self) -> (usize, usize) {
        let answering = self.nodes.values().flatten().count();
        (answering, self.facts.len())
    }

    /// How the state `later` differs from this state. Facts that already differed in `meanwhile`, just before the first
    /// kill, do not count as lost. `changed` are the parameters and namespaces that other programs were seen to change.
    pub(super) fn compare(
        &self,
        meanwhile: &Self,
        later: &Self,
        changed: &BTreeSet<String>,
    ) -> DrillDifference {
        let mut difference = DrillDifference::default();
        for (node, pid) in &self.nodes {
            let Some(pid) = pid else { continue };
            match later.nodes.get(node) {
                Some(Some(now)) if now == pid => {}
                Some(Some(now)) => difference.lost.push(format!(
                    "the node {node} was started again: it was process {pid} and is {now}"
                )),
                Some(None) => difference
                    .lost
                    .push(format!("the node {node}, process {pid}, does not answer")),
                None => difference.lost.push(format!(
                    "the node {node}, process {pid}, is not registered any more"
                )),
            }
        }
        let mut by_others = Vec::new();
        for (what, value) in &self.facts {
            let steady = meanwhile.facts.get(what) == Some(value);
            let now = later.facts.get(what);
            if !steady || now == Some(value) {
                continue;
            }
            let how = if now.is_some() {
                "has changed"
            } else {
                "is gone"
            };
            match is_below(what, changed) {
                true => by_others.push(format!("{what} {how}: another program did that")),
                false => difference.lost.push(format!("{what} {how}")),
            }
        }
        let new = later.facts.keys();
        let new = new.filter(|what| !self.facts.contains_key(*what));
        difference.new = new.map(|what| format!("{what} is new")).collect();
        difference.new.extend(by_others);
        difference
    }
}

/// The facts in the master's answers, and the names of all nodes.
fn facts(
    state: &Value,
    types: &Value,
    params: &Value,
) -> (BTreeMap<String, Value>, BTreeSet<String>) {
    let (mut facts, mut names) = (BTreeMap::new(), BTreeSet::new());
    let lists = state.as_array().unwrap_or_default();
    for (list, role) in lists.iter().zip(["publisher", "subscriber", "provider"]) {
        for entry in list.as_array().unwrap_or_default() {
            let Some([Value::String(of), Value::Array(nodes)]) = entry.as_array() else {
                continue;
            };
            let nodes = nodes.iter().filter_map(Value::as_str);
            for node in nodes.filter(|node| !node.starts_with(PREFIX)) {
                facts.insert(format!("{node} as {role} of {of}"), Value::Nil);
                names.insert(node.to_owned());
            }
        }
    }
    for pair in types.as_array().unwrap_or_default() {
        if let Some([Value::String(topic), of]) = pair.as_array() {
            facts.insert(format!("the type of {topic}"), of.clone());
        }
    }
    flatten("", params, &mut facts);
    (facts, names)
}

/// Adds the parameters below `key`, each under its full key.
fn flatten(key: &str, value: &Value, facts: &mut BTreeMap<String, Value>) {
    match value {
        _ if key.starts_with(PREFIX) => {}
        Value::Struct(members) if !members.is_empty() => {
            for (name, value) in members {
                flatten(&format!("{key}/{name}"), value, facts);
            }
        }
        _ if key.is_empty() => {}
        _ => {
            facts.insert(format!("{PARAMETER}{key}"), value.clone());
        }
    }
}

/// Whether this fact is about a parameter in `changed`, or about a parameter in a namespace in `changed`.
fn is_below(fact: &str, changed: &BTreeSet<String>) -> bool {
    let Some(key) = fact.strip_prefix(PARAMETER) else {
        return false;
    };
    let mut above = changed
        .iter()
        .filter_map(|changed| key.strip_prefix(&**changed));
    above.any(|rest| rest.is_empty() || rest.starts_with('/'))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::xmlrpc::Struct;

    fn robot(publisher: &str, value: i32, pid: Option<i32>) -> RobotState {
        let list = |of: &str, node: &str| {
            let nodes: Value = vec![node, "/rosrescue_drill_7"].into();
            Value::Array(vec![Value::Array(vec![of.into(), nodes])])
        };
        let state = Value::Array(vec![
            list("/chatter", publisher),
            list("/chatter", "/listener"),
            Value::Array(Vec::new()),
        ]);
        let types = Value::Array(vec![vec!["/chatter", "std_msgs/String"].into()]);
        let inner = Struct::from([("wheels".to_owned(), value.into())]);
        let params = Value::Struct(Struct::from([
            ("robot".to_owned(), Value::Struct(inner)),
            ("rosrescue_drill_7".to_owned(), 3.into()),
        ]));
        let (facts, names) = facts(&state, &types, &params);
        let nodes = names.into_iter().map(|name| (name, pid)).collect();
        RobotState { facts, nodes }
    }

    #[test]
    fn what_is_gone_or_changed_is_told_and_what_a_drill_owns_is_not() {
        let nothing = BTreeSet::new();
        let before = robot("/talker", 4, Some(1));
        assert_eq!(before.counts(), (2, 4));
        assert_eq!(
            before.compare(&before, &before, &nothing),
            DrillDifference::default()
        );
        let after = robot("/other", 5, Some(1));
        let difference = before.compare(&before, &after, &nothing);
        assert_eq!(
            difference.lost,
            [
                "the node /talker, process 1, is not registered any more",
                "/talker as publisher of /chatter is gone",
                "the parameter /robot/wheels has changed",
            ]
        );
        assert_eq!(difference.new, ["/other as publisher of /chatter is new"]);
        // Another program changes the parameter.
        for (changed, is_its) in [("/robot", true), ("/robot/wheels", true), ("/rob", false)] {
            let changed = [changed.to_owned()].into();
            let difference = before.compare(&before, &after, &changed);
            let is_lost = difference.lost.iter().any(|what| what.contains("wheels"));
            let is_noted = difference.new.iter().any(|what| what.contains("wheels"));
            assert_eq!((is_lost, is_noted), (!is_its, is_its), "{changed:?}");
        }
        // The parameter also changes without a kill.
        let meanwhile = robot("/talker", 3, Some(1));
        let difference = before.compare(&meanwhile, &after, &nothing);
        assert!(difference.lost.iter().all(|what| !what.contains("wheels")));
    }

    #[test]
    fn a_node_that_was_started_again_is_told() {
        let before = robot("/talker", 4, Some(1));
        let nothing = BTreeSet::new();
        let lost = |pid| {
            before
                .compare(&before, &robot("/talker", 4, pid), &nothing)
                .lost
        };
        assert!(lost(Some(2))[0].contains("it was process 1 and is 2"));
        assert!(lost(None)[0].contains("does not answer"));
        // A node that never answered proves nothing.
        let silent = robot("/talker", 4, None);
        assert!(silent.compare(&silent, &before, &nothing).lost.is_empty());
    }
}
