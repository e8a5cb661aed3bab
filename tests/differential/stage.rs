//! The parts of a run: the model beside the real master, clients, nodes, and the expected callbacks.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use rescue_core::replay::{accepted, difference};
use ros1_master::{
    master::{Master, Notice, Request, port_of},
    xmlrpc::{Call, Reply, Value},
};
use serde_json::{Value as Json, json};

use crate::dice::{CALLERS, KEYS, NAMES};
use crate::nodes::{self, Node};
use crate::oracle::{Expected, Heard, TrueLists, calls, judge};
use crate::real::Wire;
use crate::script::with_real_apis;
use crate::support::{sorted, unordered};

/// Number of clients. Each has its own connection, and they call in turn.
pub(crate) const CLIENTS: usize = 3;

/// Why a run failed.
pub(crate) type Failure = String;

/// How often a script is played at most.
const TRIES: usize = 3;

/// Plays a script with `once`, which also returns what excuses its failure, if anything does. Then it is played again.
pub(crate) fn undisturbed(
    mut once: impl FnMut() -> (Result<(), Failure>, Option<String>),
) -> Result<(), Failure> {
    for _ in 1..TRIES {
        match once() {
            (Err(why), Some(disturbance)) => crate::say(&format!(
                "The script is played again, because {disturbance}. It failed: {why}"
            )),
            (result, _) => return result,
        }
    }
    once().0
}

/// What excuses this result: a disturbance of the master, if the failure is about callbacks. Answers and states must be
/// right all the same.
pub(crate) fn excuse(result: &Result<(), Failure>, disturbance: Option<String>) -> Option<String> {
    let is_about_callbacks = |why: &Failure| why.contains("callback");
    disturbance.filter(|_| result.as_ref().is_err_and(is_about_callbacks))
}

/// One run.
pub(crate) struct Stage<'n> {
    pub(crate) nodes: &'n [Node],
    pub(crate) apis: Vec<String>,
    pub(crate) model: Master,
    pub(crate) wires: Vec<Wire>,
    /// Whether callbacks can be predicted.
    pub(crate) callbacks: bool,
    /// The callbacks that each node must get before the next comparison.
    told: Vec<Vec<Expected>>,
    /// The callbacks that may be repeated because of a crash.
    pub(crate) repeats: Option<TrueLists>,
    /// Whether the master may be away. Then rosrescue notifies the nodes.
    pub(crate) away: bool,
    /// The master that served at the last [`Self::look`] that found one.
    serving: Json,
    /// What has happened to the master without a step of the script.
    pub(crate) disturbance: Option<String>,
}

impl<'n> Stage<'n> {
    pub(crate) fn new(nodes: &'n [Node], wires: Vec<Wire>, model: Master) -> Self {
        for node in nodes {
            node.take_now();
        }
        Self {
            apis: nodes.iter().map(|node| node.api.clone()).collect(),
            told: nodes.iter().map(|_| Vec::new()).collect(),
            nodes,
            model,
            wires,
            callbacks: true,
            repeats: None,
            away: false,
            serving: Json::Null,
            disturbance: None,
        }
    }

    /// Looks at the status of rosrescue. `serves` says whether calls pass to a living master. If no step has sent the
    /// master away, it is a disturbance if none serves, if another one does, or if rosrescue has answered in its place.
    pub(crate) fn look(&mut self, status: &Json, serves: bool) {
        let now = match serves {
            true => json!({
                "process of rosrescue": status["pid"],
                "masters": status["recoveries"],
                "calls that no master answered": status["counters"]["calls_without_master"],
            }),
            false => Json::Null,
        };
        let before = &self.serving;
        if !self.away && !before.is_null() && *before != now {
            let text = format!("the master was away or late without a step: {before} became {now}");
            self.disturbance.get_or_insert(text);
        }
        if serves {
            (self.serving, self.away) = (now, false);
        }
    }

    pub(crate) fn real(&self, call: &Call) -> Call {
        with_real_apis(call, &self.apis)
    }

    /// Allows rosrescue to send a node the present state again, as in `docs/decisions/0031`.
    pub(crate) fn allow_repeats(&mut self) {
        self.repeats.get_or_insert_default().add(&self.model);
    }

    /// Makes a call. Both masters must answer alike.
    pub(crate) fn call(&mut self, by: usize, call: &Call) -> Result<(), Failure> {
        let reply = self.wires[by].call(call)?;
        self.answered(call, &reply, false)
    }

    /// Compares the reply to `call` with the model's. `risky` says that a crash may have lost or repeated the
    /// callbacks.
    pub(crate) fn answered(
        &mut self,
        call: &Call,
        reply: &Reply,
        risky: bool,
    ) -> Result<(), Failure> {
        let before = self.model.clone();
        let request = Request::from(call.clone());
        let outcome = self.model.apply(&request);
        if !alike(&outcome.reply, reply) {
            return Err(format!(
                "answered\n  {reply:?}\ninstead of\n  {:?}",
                outcome.reply
            ));
        }
        self.note(&outcome.notices, risky);
        let accepted = accepted(&before, &request, reply);
        let mut mirror = before;
        for answered in accepted.calls.iter().filter(|of| of.executed) {
            mirror.apply(answered.call);
        }
        let words = difference(&mirror, &self.model);
        match words.is_empty() {
            true => Ok(()),
            false => Err(format!(
                "a mirror that has applied the reply {reply:?} differs: {words:?}"
            )),
        }
    }

    /// Notes the expected callbacks.
    pub(crate) fn note(&mut self, notices: &[Notice], risky: bool) {
        for notice in notices {
            let (to, call) = nodes::as_call(notice);
            // The mirror leaves out outdated callbacks. rosrescue sends a `shutdown` only with evidence that the
            // address still belongs to the right node, and these nodes give none.
            let risky = risky || self.away;
            if let Some(repeats) = &mut self.repeats {
                repeats.send(to, &call);
            }
            if let Some(index) = self.apis.iter().position(|api| api == to) {
                self.told[index].push(Expected { call, risky });
            }
        }
        match &mut self.repeats {
            Some(repeats) if risky || self.away => repeats.answered(&self.model),
            Some(repeats) => repeats.add(&self.model),
            None => {}
        }
    }

    /// From now on, callbacks that the nodes have not got yet may be lost or repeated.
    pub(crate) fn risk(&mut self) {
        self.told
            .iter_mut()
            .flatten()
            .for_each(|it| it.risky = true);
    }

    /// Sends every node one last callback, and compares the callbacks before it.
    pub(crate) fn settle(&mut self) -> Result<(), Failure> {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let topic = format!("/last{}", COUNT.fetch_add(1, Ordering::Relaxed));
        let call = |method: &str, params: &[&str]| {
            Call::new(method, params.iter().map(|text| (*text).into()).collect())
        };
        let of_listeners = |method: &str, with_type: bool| -> Vec<Call> {
            let listeners = self.apis.iter().enumerate().map(|(index, api)| {
                let name = format!("/listener{index}");
                match with_type {
                    true => call(method, &[&name, &topic, "a/B", api]),
                    false => call(method, &[&name, &topic, api]),
                }
            });
            listeners.collect()
        };
        let last = [&*topic, "http://last"];
        let mut calls = of_listeners("registerSubscriber", true);
        calls.push(call(
            "registerPublisher",
            &["/last", last[0], "a/B", last[1]],
        ));
        // These cause no callbacks: the subscribers go first.
        let mut removals = of_listeners("unregisterSubscriber", false);
        removals.push(call("unregisterPublisher", &["/last", last[0], last[1]]));
        self.call_all(&calls)?;
        // With several computers, a node may also get the list of this topic while it is still empty.
        let publishers = Value::from(vec![Value::from(last[1])]);
        let is_last = |call: &Call| {
            call.params
                .ends_with(&[Value::from(topic.as_str()), publishers.clone()])
        };
        // rosrescue may send the last callback later, and only to a subscriber.
        let heard = self.nodes.iter().map(|node| node.take(is_last));
        let heard = heard.collect::<Result<Vec<_>, _>>()?;
        self.call_all(&removals)?;
        for (index, (node, heard)) in self.nodes.iter().zip(heard).enumerate() {
            let expected = std::mem::take(&mut self.told[index]);
            if self.callbacks {
                self.judge(node, &expected, heard)
                    .map_err(|why| format!("callbacks to node{index}: {why}"))?;
            }
        }
        if let Some(repeats) = &mut self.repeats {
            repeats.settled(&self.model);
        }
        Ok(())
    }

    /// Makes these calls, which [`Self::settle`] needs.
    fn call_all(&mut self, calls: &[Call]) -> Result<(), Failure> {
        calls.iter().try_for_each(|call| {
            self.call(0, call)
                .map_err(|why| format!("settling: {call:?} {why}"))
        })
    }

    /// Compares the callbacks of a node. Waits for replacements of those that a crash has lost, and for the newest one
    /// if an older one came after it.
    fn judge(
        &self,
        node: &Node,
        expected: &[Expected],
        mut heard: Vec<Heard>,
    ) -> Result<(), Failure> {
        let mut expected = expected.to_vec();
        if unordered() {
            // The order in which rosmaster notifies nodes is that of a dictionary, too.
            heard.sort_by_key(|it| format!("{:?}", it.call));
            expected.sort_by_key(|it| format!("{:?}", it.call));
        }
        let nothing = TrueLists::default();
        let lists = self.repeats.as_ref().unwrap_or(&nothing);
        let swallowed = judge(&expected, &calls(&heard), |call| lists.has(&node.api, call))?;
        let deadline = Instant::now() + nodes::patience();
        expected.retain(|it| it.risky);
        loop {
            let news = calls(&heard);
            let owed = swallowed.iter().find(|it| lists.owes(&node.api, it, &news));
            let older = lists.goes_back(&node.api, &heard).filter(|_| !unordered());
            let why = match (owed, older) {
                (Some(owed), _) => format!("lost in the crash and never made good is\n  {owed:?}"),
                (None, Some(call)) => format!("it goes back to\n  {call:?}\nin\n  {heard:?}"),
                (None, None) => return Ok(()),
            };
            if Instant::now() > deadline {
                return Err(why);
            }
            std::thread::sleep(Duration::from_millis(5));
            let late = node.take_now();
            judge(&expected, &calls(&late), |call| lists.has(&node.api, call))?;
            heard.extend(late);
        }
    }

    /// Compares the answers to every read of all names that were ever used.
    pub(crate) fn same_reads(&self, wire: &mut Wire) -> Result<(), Failure> {
        let mut model = self.model.clone();
        let own = |method: &str| Call::new(method, vec!["/test".into()]);
        let one = |caller: &str, method: &str, name: &str| {
            Call::new(method, vec![caller.into(), name.into()])
        };
        let mut calls: Vec<Call> = ["getSystemState", "getTopicTypes", "getParamNames"]
            .map(own)
            .into();
        for subgraph in ["", "/ns"] {
            calls.push(one("/test", "getPublishedTopics", subgraph));
        }
        calls.push(one("/test", "getParam", "/"));
        let keys = model.params().keys().filter(|key| !key.is_empty());
        calls.extend(keys.map(|key| one("/test", "getParam", key)));
        calls.extend(KEYS.iter().map(|key| one("/n0", "getParam", key)));
        for (node, api) in model.nodes() {
            let at: BTreeSet<_> = model.nodes_at(port_of(api)).collect();
            let shares = |(_, other): &(&str, &str)| port_of(other) == port_of(api);
            assert_eq!(at, model.nodes().filter(shares).collect(), "{node}");
        }
        let callers = CALLERS.iter().map(|caller| (*caller).to_owned());
        let known = model.nodes().map(|(caller_id, _)| caller_id.to_owned());
        let nodes: BTreeSet<String> = callers.chain(known).collect();
        calls.extend(nodes.iter().map(|node| one(node, "lookupNode", "~")));
        calls.extend(nodes.iter().map(|node| one("/a//x", "lookupNode", node)));
        let services = model.registry().services.keys().cloned();
        let services: BTreeSet<String> = services
            .chain(NAMES.iter().map(|name| (*name).to_owned()))
            .collect();
        calls.extend(
            services
                .iter()
                .map(|service| one("/test", "lookupService", service)),
        );
        for call in calls {
            let (expected, found) = (model.apply(&call.clone().into()).reply, wire.call(&call)?);
            if !alike(&expected, &found) {
                return Err(format!(
                    "{call:?} answered\n  {found:?}\ninstead of\n  {expected:?}"
                ));
            }
        }
        Ok(())
    }
}

/// Whether two replies are equal. Texts of refusals, in faults and in answers with another code than 1, may differ.
pub(crate) fn alike(a: &Reply, b: &Reply) -> bool {
    match (a, b) {
        (Reply::Value(a), Reply::Value(b)) => blank(a) == blank(b),
        (Reply::Fault { code: a, .. }, Reply::Fault { code: b, .. }) => a == b,
        _ => false,
    }
}

/// The value without texts of refusals, including those inside multicalls.
fn blank(value: &Value) -> Value {
    match value {
        Value::Array(elements) => match elements.as_slice() {
            [code @ Value::Int(-1 | 0), Value::String(_), value] => {
                vec![code.clone(), "".into(), value.clone()].into()
            }
            elements => in_order(elements.iter().map(blank).collect()).into(),
        },
        Value::Struct(members) if members.contains_key("faultString") => {
            members.get("faultCode").cloned().unwrap_or(Value::Nil)
        }
        value if unordered() => sorted(value),
        value => value.clone(),
    }
}

/// Sorts lists of names, if the master's dictionaries are unordered.
fn in_order(mut elements: Vec<Value>) -> Vec<Value> {
    let is_one = |it: &Value| matches!(it, Value::Array(_) | Value::String(_));
    if unordered() && elements.iter().all(is_one) {
        elements.sort_by_key(|it| format!("{it:?}"));
    }
    elements
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_disturbance_excuses_nothing_but_callbacks() {
        let disturbance = || Some("the master was late".to_owned());
        let excuses = |why: &str| excuse(&Err(why.to_owned()), disturbance()).is_some();
        assert!(excuses("callbacks to node1: missing is …"));
        assert!(!excuses("answered 1 instead of 2"));
        assert_eq!(excuse(&Ok(()), disturbance()), None);
    }

    #[test]
    fn only_a_failure_that_is_excused_is_played_again() {
        let fails = || Err("a callback is missing".to_owned());
        let disturbed = || Some("the master was late".to_owned());
        let plays = |results: &[(Result<(), Failure>, Option<String>)]| {
            let mut left = results.iter().cloned();
            let result = undisturbed(|| left.next().expect("no further play"));
            (result.is_ok(), results.len() - left.len())
        };
        assert_eq!(plays(&[(fails(), None)]), (false, 1));
        assert_eq!(plays(&[(Ok(()), disturbed())]), (true, 1));
        assert_eq!(plays(&[(fails(), disturbed()), (Ok(()), None)]), (true, 2));
        let always = [(); TRIES].map(|()| (fails(), disturbed()));
        assert_eq!(plays(&always), (false, TRIES));
    }

    #[test]
    fn only_what_no_step_has_done_is_a_disturbance() {
        let status = |masters: i32, answered: i32| {
            let counters = json!({ "calls_without_master": answered });
            json!({ "pid": 1, "recoveries": masters, "counters": counters })
        };
        let after = |masters: i32, answered: i32, serves: bool| {
            let mut stage = Stage::new(&[], Vec::new(), Master::default());
            stage.look(&status(1, 0), true);
            stage.away = true;
            stage.look(&status(1, 0), false);
            stage.look(&status(2, 5), true);
            stage.look(&status(masters, answered), serves);
            stage.disturbance.is_some()
        };
        assert!(!after(2, 5, true));
        for (masters, answered, serves) in [(3, 5, true), (2, 6, true), (2, 5, false)] {
            assert!(after(masters, answered, serves));
        }
    }
}
