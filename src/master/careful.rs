//! The plan of an injection, entry by entry: for masters that die of it.

use std::fmt;

use super::mark::{HELPER, NO_API};
use super::plan::{self, Skipped};
use super::restore::Restore;
use super::{CALLER_ID, Mark, Master, names};
use crate::xmlrpc::{Call, Reply, Struct, Value};

/// So many pairs of calls that do nothing precede an entry that is put to the test. A master that
/// dies at a call by chance hits the entry once in more than twice as many times.
const DECOYS: usize = 32;
/// What the calls that do nothing name.
const DECOY: &str = "/rosrescue_decoy";

/// One call of a careful injection.
#[derive(Clone, Debug)]
pub struct Step {
    /// The call.
    pub call: Call,
    /// What the master must answer.
    pub predicted: Reply,
    /// Whether it brings in a record of the state.
    pub record: bool,
    /// Whether it is the entry that is put to the test.
    pub tested: bool,
}

/// The calls that bring a master to a state, each for itself, in the order of a
/// [`Plan`](super::Plan). Parameters come one by one, down to those that are no namespaces.
#[derive(Clone, Debug)]
pub struct Careful {
    steps: Vec<Step>,
    expected: Master,
    skipped: Vec<Skipped>,
    left_out: Vec<Call>,
}

impl Careful {
    /// The plan that brings a master that holds `found` to `target`, but for the entries
    /// `left_out`, and leaves `mark`. Before `tested` come calls of its method that do nothing.
    pub fn new(
        target: &Master,
        found: &Master,
        mark: &Mark,
        left_out: &[Call],
        tested: Option<&Call>,
    ) -> Self {
        let mut calls = Vec::new();
        let Restore { skipped, .. } = Restore::run(target, found, |call, _| calls.push(call));
        let mut plan = Self {
            steps: Vec::with_capacity(calls.len()),
            expected: found.clone(),
            skipped,
            left_out: Vec::new(),
        };
        for call in calls {
            let singly = match param_tree(&call) {
                Some(tree) => one_by_one(tree, found),
                None => None,
            };
            match singly {
                Some(calls) => {
                    for call in calls {
                        plan.record(call, true, target, left_out, tested);
                    }
                }
                None => {
                    // Parameters with names that cannot be said one by one.
                    let record = param_tree(&call).is_none();
                    plan.record(call, record, target, left_out, tested);
                }
            }
        }
        for call in plan::reads(&plan.expected, found) {
            plan.push(call, false, false);
        }
        // The mark is no part of the mirror. It subscribes to what is not set.
        plan.steps.push(Step {
            predicted: Master::default().apply(&mark.call()).reply,
            call: mark.call(),
            record: false,
            tested: false,
        });
        plan
    }

    fn push(&mut self, call: Call, record: bool, tested: bool) {
        self.steps.push(Step {
            predicted: self.expected.apply(&call).reply,
            call,
            record,
            tested,
        });
    }

    fn record(
        &mut self,
        call: Call,
        record: bool,
        target: &Master,
        left_out: &[Call],
        tested: Option<&Call>,
    ) {
        if left_out.contains(&call) {
            self.left_out.push(call);
            return;
        }
        let tested = tested == Some(&call);
        if tested {
            for _ in 0..DECOYS {
                for decoy in decoys(&call, &self.expected, target) {
                    self.push(decoy, false, false);
                }
            }
        }
        self.push(call, record, tested);
    }

    /// The calls, in order.
    pub fn steps(&self) -> &[Step] {
        &self.steps
    }

    /// What the master holds afterwards, the mark apart.
    pub fn expected(&self) -> &Master {
        &self.expected
    }

    /// What of the target is not brought over, what was asked to be left out apart.
    pub fn skipped(&self) -> &[Skipped] {
        &self.skipped
    }

    /// What was asked to be left out, and would have been brought over.
    pub fn left_out(&self) -> &[Call] {
        &self.left_out
    }
}

/// The tree that a call gives to the whole parameter server.
fn param_tree(call: &Call) -> Option<&Struct> {
    match (call.method.as_str(), call.params.as_slice()) {
        ("setParam", [_, Value::String(root), Value::Struct(tree)]) if root == "/" => Some(tree),
        _ => None,
    }
}

/// The calls that set every parameter of `tree` for itself; none if that makes another tree.
fn one_by_one(tree: &Struct, found: &Master) -> Option<Vec<Call>> {
    let mut calls = Vec::new();
    singly("", tree, Some(found.params()), &mut calls);
    let mut master = found.clone();
    for call in &calls {
        master.apply(call);
    }
    let same = match found.params().is_empty() {
        true => master.params().iter().eq(tree),
        false => master.params() == tree,
    };
    same.then_some(calls)
}

fn singly(path: &str, tree: &Struct, found: Option<&Struct>, calls: &mut Vec<Call>) {
    for (key, value) in tree {
        let there = found.and_then(|found| found.get(key));
        let path = format!("{path}/{key}");
        match value {
            _ if there == Some(value) => {}
            // Other keys are no names: their namespace is set as a whole.
            Value::Struct(members)
                if !members.is_empty()
                    && (members.keys()).all(|key| !key.is_empty() && !key.contains('/')) =>
            {
                singly(&path, members, there.and_then(Value::as_struct), calls);
            }
            _ => {
                let params = vec![CALLER_ID.into(), path.into(), value.clone()];
                calls.push(Call::new("setParam", params));
            }
        }
    }
}

/// Two calls, the first one of the method of `call`, that together leave `master` as it is.
fn decoys(call: &Call, master: &Master, target: &Master) -> [Call; 2] {
    let helper = |method, params: Vec<&str>| {
        let params = std::iter::once(HELPER).chain(params);
        Call::new(method, params.map(Value::from).collect())
    };
    match call.method.as_str() {
        "setParam" => {
            let mut params = vec![CALLER_ID.into(), DECOY.into()];
            let delete = Call::new("deleteParam", params.clone());
            params.push(0.into());
            [Call::new("setParam", params), delete]
        }
        "registerPublisher" => {
            // A topic that has its type already and nobody to tell, else one that is to come: types
            // stay.
            let own = call.params.get(1).and_then(Value::as_str);
            let types = master.topic_types.iter().chain(&target.topic_types);
            let mut topics = types.filter(|(topic, _)| {
                Some(topic.as_str()) != own && !master.registry.subscribers.contains_key(*topic)
            });
            let found = topics.find_map(|(topic, of)| Some((names::name_for(topic, HELPER)?, of)));
            match &found {
                Some((name, topic_type)) => [
                    helper("registerPublisher", vec![name, topic_type, NO_API]),
                    helper("unregisterPublisher", vec![name, NO_API]),
                ],
                None => [
                    helper("registerSubscriber", vec![DECOY, "*", NO_API]),
                    helper("unregisterSubscriber", vec![DECOY, NO_API]),
                ],
            }
        }
        "registerService" => [
            helper("registerService", vec![DECOY, NO_API, NO_API]),
            helper("unregisterService", vec![DECOY, NO_API]),
        ],
        "subscribeParam" => [
            helper("subscribeParam", vec![NO_API, DECOY]),
            helper("unsubscribeParam", vec![NO_API, DECOY]),
        ],
        _ => [
            helper("registerSubscriber", vec![DECOY, "*", NO_API]),
            helper("unregisterSubscriber", vec![DECOY, NO_API]),
        ],
    }
}

/// A call of an injection by what it brings in, for people; without values.
#[derive(Clone, Copy, Debug)]
pub struct Told<'a>(pub &'a Call);

impl fmt::Display for Told<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Call { method, params } = self.0;
        let text = |index| params.get(index).and_then(Value::as_str).unwrap_or("?");
        let caller_id = text(0);
        match method.as_str() {
            "setParam" => write!(f, "the parameter `{}`", text(1)),
            "registerPublisher" | "registerSubscriber" if caller_id == HELPER => {
                write!(f, "the type of the topic `{}`", text(1))
            }
            "registerPublisher" => write!(f, "the publisher `{caller_id}` of `{}`", text(1)),
            "registerSubscriber" => write!(f, "the subscriber `{caller_id}` of `{}`", text(1)),
            "registerService" => write!(f, "the service `{}` of `{caller_id}`", text(1)),
            "subscribeParam" => write!(
                f,
                "the subscription of `{caller_id}` to the parameter `{}`",
                text(2)
            ),
            _ => write!(f, "{method} of `{}` by `{caller_id}`", text(1)),
        }
    }
}
