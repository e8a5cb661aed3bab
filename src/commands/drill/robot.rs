//! The state of the robot before and after a drill: what the master says, and the process of each node.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::{Duration, Instant},
};

use ros1_master::{master, xmlrpc::Value};
use tokio::task::JoinSet;

use super::{PREFIX, calls::Api};
use crate::nodes::client::{self, Reaction};

/// Longest time for a node to report its process id.
const NODE_LIMIT: Duration = Duration::from_secs(5);

/// How long the state is read again because nodes unregister meanwhile.
const STEADY_LIMIT: Duration = Duration::from_secs(8);

/// Names of facts about parameters begin with this.
const PARAMETER: &str = "the parameter ";

/// The robot's state at one moment, without what belongs to drills.
#[derive(Clone, Debug, Default)]
pub(super) struct RobotState {
    /// Registrations, types and parameters, each under a name for people.
    facts: BTreeMap<String, Value>,
    nodes: BTreeMap<String, RobotNode>,
}

/// A registered node.
#[derive(Clone, Debug, PartialEq, Eq)]
struct RobotNode {
    /// Address that the node registered.
    api: String,
    /// The node's process id. `None` if the node did not answer.
    pid: Option<i32>,
}

/// What others did during the drill.
#[derive(Clone, Debug, Default)]
pub(super) struct ByOthers {
    /// Parameters and namespaces that other programs were seen to change.
    pub(super) changed: BTreeSet<String>,
    /// Nodes that rosrescue unregistered because they had died.
    pub(super) died: BTreeSet<String>,
    /// Nodes that are no longer registered, but still answer at their address.
    pub(super) alive: BTreeSet<String>,
}

/// How the robot's state differs between two moments.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct DrillDifference {
    /// Number of nodes that are the same processes as before.
    pub(super) same: usize,
    /// Facts that are gone or changed.
    pub(super) lost: Vec<String>,
    /// Facts that are new, or changed by other programs, and nodes that ended by themselves.
    pub(super) new: Vec<String>,
    /// Addresses of the nodes that ended by themselves: they unregistered, or came back as another process.
    pub(super) ended: BTreeSet<String>,
}

impl RobotState {
    /// Reads the state. A node that unregisters meanwhile has it read again.
    pub(super) async fn read(api: &Api) -> Result<Self, String> {
        let start = Instant::now();
        loop {
            let gone = match Self::read_once(api).await? {
                Ok(state) => return Ok(state),
                Err(gone) => gone,
            };
            if start.elapsed() > STEADY_LIMIT {
                let limit = STEADY_LIMIT.as_secs();
                return Err(format!(
                    "for {limit} s, a node was listed and its address was not known, {gone} last"
                ));
            }
        }
    }

    /// The name of a node instead, if it unregistered between two calls.
    async fn read_once(api: &Api) -> Result<Result<Self, String>, String> {
        let state = api.call("getSystemState", &[]).await?;
        let types = api.call("getTopicTypes", &[]).await?;
        // A master may hold a parameter that it can never return, so this call may fail.
        let params = api.call("getParam", &["/".into()]).await;
        let params = params.unwrap_or(Value::Nil);
        let (facts, names) = facts(&state, &types, &params);
        let mut questions = JoinSet::new();
        for name in names {
            let Some(api) = api.lookup_node(&name).await? else {
                return Ok(Err(name));
            };
            questions.spawn(async move {
                let pid = pid_at(&api).await;
                (name, RobotNode { api, pid })
            });
        }
        let nodes = questions.join_all().await.into_iter().collect();
        Ok(Ok(Self { facts, nodes }))
    }

    /// Number of registrations, types and parameters.
    pub(super) fn facts(&self) -> usize {
        self.facts.len()
    }

    /// Whether each node of this state that answered also answers in the state `later`.
    pub(super) fn all_answer(&self, later: &Self) -> bool {
        let mut nodes = self.nodes.iter().filter(|(_, node)| node.pid.is_some());
        nodes.all(|(name, _)| later.nodes.get(name).is_some_and(|now| now.pid.is_some()))
    }

    /// The nodes of this state that are not registered in the state `later`, but still answer.
    pub(super) async fn alive_without(&self, later: &Self) -> BTreeSet<String> {
        let gone = self.nodes.iter();
        let gone = gone.filter(|(name, _)| !later.nodes.contains_key(*name));
        let mut questions = JoinSet::new();
        for (name, RobotNode { api, pid }) in gone {
            let (name, api, pid) = (name.clone(), api.clone(), *pid);
            questions.spawn(async move {
                let lives = pid.is_some() && pid_at(&api).await == pid;
                lives.then_some(name)
            });
        }
        questions.join_all().await.into_iter().flatten().collect()
    }

    /// How the state `later` differs from this state. Facts that already differed in `meanwhile`, just before the first
    /// kill, do not count as lost. Neither does what belongs to nodes that ended by themselves.
    pub(super) fn compare(
        &self,
        meanwhile: &Self,
        later: &Self,
        others: &ByOthers,
    ) -> DrillDifference {
        let mut difference = DrillDifference::default();
        let mut ended = BTreeSet::new();
        let started = meanwhile.nodes.iter();
        let started = started.filter(|(name, _)| !self.nodes.contains_key(*name));
        for (node, RobotNode { api, pid }) in self.nodes.iter().chain(started) {
            let Some(pid) = pid else { continue };
            let process = format!("the node {node}, process {pid},");
            let how = match later.nodes.get(node).map(|now| now.pid) {
                Some(Some(now)) if now == *pid => {
                    difference.same += 1;
                    continue;
                }
                Some(Some(now)) => format!("was started again as process {now}"),
                Some(None) => {
                    difference.lost.push(format!("{process} does not answer"));
                    continue;
                }
                None if others.alive.contains(node) => {
                    let what = "is no longer registered, but its process runs";
                    difference.lost.push(format!("{process} {what}"));
                    continue;
                }
                None if others.died.contains(node) => {
                    let what = "has died without unregistering";
                    difference.lost.push(format!("{process} {what}"));
                    continue;
                }
                None => "has unregistered and ended".to_owned(),
            };
            difference.new.push(format!("{process} {how}"));
            ended.insert(node);
            difference.ended.insert(api.clone());
            let started_again = meanwhile.nodes.get(node);
            difference
                .ended
                .extend(started_again.map(|node| node.api.clone()));
        }
        let has_ended = |what: &str| {
            let owner = what.split_once(" as ").map(|(node, _)| node);
            owner.is_some_and(|node| ended.iter().any(|ended| *ended == node))
        };
        let mut by_others = Vec::new();
        for (what, value) in &self.facts {
            let steady = meanwhile.facts.get(what) == Some(value);
            let now = later.facts.get(what);
            if !steady || now == Some(value) || has_ended(what) {
                continue;
            }
            let how = if now.is_some() {
                "has changed"
            } else {
                "is gone"
            };
            match is_below(what, &others.changed) {
                true => by_others.push(format!("{what} {how}: another program did that")),
                false => difference.lost.push(format!("{what} {how}")),
            }
        }
        let new = later.facts.keys();
        let new = new.filter(|what| !self.facts.contains_key(*what) && !has_ended(what));
        difference
            .new
            .extend(new.map(|what| format!("{what} is new")));
        difference.new.extend(by_others);
        difference
    }
}

/// The process id of the node at `api`, if it answers.
async fn pid_at(api: &str) -> Option<i32> {
    match client::call_for_value(api, &master::get_pid(), NODE_LIMIT).await {
        (Reaction::Alive, Some(pid)) => pid.as_int(),
        _ => None,
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
    use ros1_master::xmlrpc::Struct;

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
        let node = |name: String| {
            let api = format!("http://robot{name}/{}", pid.unwrap_or_default());
            (name, RobotNode { api, pid })
        };
        let nodes = names.into_iter().map(node).collect();
        RobotState { facts, nodes }
    }

    #[test]
    fn what_is_gone_or_changed_is_told_and_what_a_drill_owns_is_not() {
        let nothing = ByOthers::default();
        let before = robot("/talker", 4, Some(1));
        assert_eq!(before.facts(), 4);
        let same = DrillDifference {
            same: 2,
            ..DrillDifference::default()
        };
        assert_eq!(before.compare(&before, &before, &nothing), same);
        let after = robot("/other", 5, Some(1));
        let lives = ByOthers {
            alive: ["/talker".to_owned()].into(),
            ..ByOthers::default()
        };
        let difference = before.compare(&before, &after, &lives);
        assert_eq!(
            difference.lost,
            [
                "the node /talker, process 1, is no longer registered, but its process runs",
                "/talker as publisher of /chatter is gone",
                "the parameter /robot/wheels has changed",
            ]
        );
        assert_eq!(difference.new, ["/other as publisher of /chatter is new"]);
        // Another program changes the parameter.
        for (changed, is_its) in [("/robot", true), ("/robot/wheels", true), ("/rob", false)] {
            let others = ByOthers {
                changed: [changed.to_owned()].into(),
                ..ByOthers::default()
            };
            let difference = before.compare(&before, &after, &others);
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
    fn a_node_that_ends_by_itself_or_comes_back_is_no_damage() {
        let nothing = ByOthers::default();
        let before = robot("/talker", 4, Some(1));
        // Both nodes were started again.
        let again = robot("/talker", 4, Some(2));
        let difference = before.compare(&before, &again, &nothing);
        assert_eq!(difference.lost, Vec::<String>::new());
        let told = "the node /talker, process 1, was started again as process 2";
        assert!(difference.new.contains(&told.to_owned()), "{difference:?}");
        let apis = ["http://robot/listener/1", "http://robot/talker/1"];
        assert_eq!(difference.ended, apis.map(str::to_owned).into());
        // The talker has unregistered. Its registrations went with it.
        let mut after = before.clone();
        after.nodes.remove("/talker");
        after.facts.remove("/talker as publisher of /chatter");
        let difference = before.compare(&before, &after, &nothing);
        assert_eq!(difference.lost, Vec::<String>::new());
        let told = "the node /talker, process 1, has unregistered and ended";
        assert_eq!(difference.new, [told]);
        // rosrescue has unregistered it, because it was dead.
        let died = ByOthers {
            died: ["/talker".to_owned()].into(),
            ..ByOthers::default()
        };
        let difference = before.compare(&before, &after, &died);
        let told = "the node /talker, process 1, has died without unregistering";
        assert_eq!(difference.lost[0], told);
        assert_eq!((difference.lost.len(), difference.ended.len()), (2, 0));
    }

    #[test]
    fn a_registered_node_that_no_longer_answers_is_lost() {
        let nothing = ByOthers::default();
        let before = robot("/talker", 4, Some(1));
        let silent = robot("/talker", 4, None);
        let lost = before.compare(&before, &silent, &nothing).lost;
        assert!(lost[0].contains("does not answer"));
        assert!(before.all_answer(&before) && !before.all_answer(&silent));
        // A node that never answered proves nothing.
        assert!(silent.compare(&silent, &before, &nothing).lost.is_empty());
    }
}
