//! What a node may hear.
//!
//! Without a crash it is exactly what the model says, in order; through rosrescue, with the present state told once more here
//! and there (`docs/decisions/0031`). A crash of the master may do this, and nothing else:
//!
//! * The callbacks of the one call that was under way may be lost, or come once more: the master
//!   may have run it before it died, its successor runs it again, and it was never answered twice.
//! * So may those of unregistrations that are answered while no master is there. Several of them
//!   are told with the one list that is true in the end.
//! * While the mirror stands in, what is out of date when it would be sent may be left out.
//! * A node that misses a list because of that is sent one that is true after it.
//! * A subscriber may be told once more what it was told: the full list of a topic's publishers, or the value of a
//!   parameter. Never a partial list, never a value that was not true since the crash before the last one, never a
//!   `shutdown`, nothing to a node that does not subscribe.
//!
//! What one node is told about one topic or one parameter **never goes back**, whatever is told twice: nothing that was
//! over before what the node has been told already. It is the order in which the model reached its states.

use std::collections::{BTreeMap, BTreeSet, HashSet};

use rosrescue::master::Master;
use rosrescue::xmlrpc::{Call, Value};

use crate::nodes::blank;

/// A callback that the model sends.
#[derive(Clone, Debug)]
pub(crate) struct Expected {
    pub(crate) call: Call,
    /// A crash may have lost or doubled it.
    pub(crate) risky: bool,
}

type List = (String, String, Vec<String>);

/// A moment in the life of the model.
#[derive(Debug)]
enum Moment {
    /// It sends that to the node at this address. A multicall passes through states that nobody sees.
    Notice(String, Call),
    State(Box<Master>),
}

impl Moment {
    /// Whether the node at `api` may be told that now.
    fn says(&self, api: &str, call: &Call) -> bool {
        match self {
            Self::Notice(to, notice) => to == api && notice == call,
            Self::State(state) if call.method == "paramUpdate" => is_true_param(state, api, call),
            Self::State(state) => as_list(api, call).is_some_and(|(api, topic, list)| {
                let subscribers = state.subscribers_of(&topic);
                subscribers.contains(&api) && state.publishers_of(&topic) == list
            }),
        }
    }
}

/// Full lists of publishers, by subscriber and topic, as they have been true lately.
#[derive(Debug, Default)]
pub(crate) struct TrueLists {
    before: HashSet<List>,
    since: HashSet<List>,
    /// The states themselves, for the values of parameters.
    states_before: Vec<Master>,
    states_since: Vec<Master>,
    /// Since the call that was under way was answered.
    after: HashSet<List>,
    /// Those who have subscribed all the time since then.
    faithful: Option<HashSet<(String, String)>>,
    /// What was true, and told, since all that was heard was judged.
    course: Vec<Moment>,
}

impl TrueLists {
    /// The master crashes in that state, and all that was heard has been judged.
    pub(crate) fn crash(&mut self, model: &Master) {
        self.before.clear();
        self.states_before.clear();
        self.crash_unjudged(model);
    }

    /// The same, and what was heard is judged later.
    pub(crate) fn crash_unjudged(&mut self, model: &Master) {
        self.before.extend(self.since.drain());
        self.states_before.append(&mut self.states_since);
        self.after.clear();
        self.faithful = None;
        self.add(model);
    }

    /// The call that was under way led to that state.
    pub(crate) fn answered(&mut self, model: &Master) {
        self.after.clear();
        self.faithful = None;
        self.add(model);
    }

    /// The model sends that to the node at `api`.
    pub(crate) fn send(&mut self, api: &str, call: &Call) {
        let notice = Moment::Notice(api.to_owned(), call.clone());
        self.course.push(notice);
    }

    /// All that was heard up to this state has been judged.
    pub(crate) fn settled(&mut self, model: &Master) {
        self.course = vec![Moment::State(Box::new(model.clone()))];
    }

    /// The first call that tells the node at `api` what was over before another one, which it has heard earlier.
    pub(crate) fn goes_back<'c>(&self, api: &str, heard: &'c [Call]) -> Option<&'c Call> {
        let mut reached = BTreeMap::new();
        heard.iter().find(|call| {
            let subject = (&call.method, call.params.get(1).and_then(Value::as_str));
            let from = reached.get(&subject).copied().unwrap_or_default();
            let says = |moment: &Moment| moment.says(api, call);
            match self.course[from..].iter().position(says) {
                Some(steps) => {
                    reached.insert(subject, from + steps);
                    false
                }
                None => self.course[..from].iter().any(says),
            }
        })
    }

    /// What is true in that state.
    pub(crate) fn add(&mut self, model: &Master) {
        self.states_since.push(model.clone());
        self.course.push(Moment::State(Box::new(model.clone())));
        let mut subscribers = HashSet::new();
        for topic in model.subscribed_topics() {
            let publishers = model.publishers_of(topic);
            for api in model.subscribers_of(topic) {
                subscribers.insert((api.clone(), topic.to_owned()));
                let list = (api, topic.to_owned(), publishers.clone());
                self.after.insert(list.clone());
                self.since.insert(list);
            }
        }
        match &mut self.faithful {
            Some(faithful) => faithful.retain(|it| subscribers.contains(it)),
            None => self.faithful = Some(subscribers),
        }
    }

    /// Whether the call is a list that may be sent to the node at `api` because of a crash.
    pub(crate) fn has(&self, api: &str, call: &Call) -> bool {
        if call.method == "paramUpdate" {
            let mut states = self.states_before.iter().chain(&self.states_since);
            return states.any(|state| is_true_param(state, api, call));
        }
        let list = as_list(api, call);
        list.is_some_and(|list| self.before.contains(&list) || self.since.contains(&list))
    }

    /// Whether the node at `api` still must hear what the crash has swallowed: it subscribes,
    /// and has not heard a list that was true after the call that was under way.
    pub(crate) fn owes(&self, api: &str, swallowed: &Call, heard: &[Call]) -> bool {
        let Some((api, topic, _)) = as_list(api, swallowed) else {
            return false;
        };
        let pair = (api, topic);
        let subscribes = self.faithful.as_ref().is_some_and(|it| it.contains(&pair));
        let (api, topic) = pair;
        let is_news = |call: &Call| {
            as_list(&api, call).is_some_and(|list| list.1 == topic && self.after.contains(&list))
        };
        subscribes && !heard.iter().any(is_news)
    }
}

/// Whether the node at `api` subscribes what the `paramUpdate` is about, and that is so.
fn is_true_param(state: &Master, api: &str, call: &Call) -> bool {
    let key = call.params.get(1).and_then(Value::as_str);
    key.is_some_and(|key| {
        state.subscribes_param(|at| at == api, key)
            && state.param_update(key).map(blank).as_ref() == Some(call)
    })
}

/// The subscriber, topic and publishers of a `publisherUpdate`.
fn as_list(api: &str, call: &Call) -> Option<List> {
    let [
        Value::String(master),
        Value::String(topic),
        Value::Array(list),
    ] = call.params.as_slice()
    else {
        return None;
    };
    if call.method != "publisherUpdate" || master != "/master" {
        return None;
    }
    let list: Option<_> = list
        .iter()
        .map(|uri| uri.as_str().map(str::to_owned))
        .collect();
    Some((api.to_owned(), topic.clone(), list?))
}

/// Whether what was heard is what had to be; gives what a crash has swallowed.
///
/// Callbacks may be equal, so what was heard may be accounted for in several ways: all are followed.
pub(crate) fn judge(
    expected: &[Expected],
    heard: &[Call],
    is_repeat: impl Fn(&Call) -> bool,
) -> Result<Vec<Call>, String> {
    // How many of the expected ones may be done with.
    let mut done = BTreeSet::from([0]);
    let pass_over_lost = |done: &mut BTreeSet<usize>| {
        for (nth, it) in expected.iter().enumerate() {
            if it.risky && done.contains(&nth) {
                done.insert(nth + 1);
            }
        }
    };
    pass_over_lost(&mut done);
    for (nth, call) in heard.iter().enumerate() {
        let doubled = expected.iter().any(|it| it.risky && it.call == *call);
        let additional = doubled || is_repeat(call);
        let mut next: BTreeSet<usize> = done
            .iter()
            .filter(|done| expected.get(**done).is_some_and(|it| it.call == *call))
            .map(|done| done + 1)
            .collect();
        if additional {
            next.extend(&done);
        }
        pass_over_lost(&mut next);
        if next.is_empty() {
            let wanted = done.last().and_then(|done| expected.get(*done));
            let wanted = wanted.map(|it| &it.call);
            return Err(format!(
                "number {nth} is\n  {call:?}\ninstead of\n  {wanted:?}"
            ));
        }
        done = next;
    }
    if !done.contains(&expected.len()) {
        let missing = done.last().and_then(|done| expected.get(*done));
        return Err(format!("missing is\n  {:?}", missing.map(|it| &it.call)));
    }
    let risky = expected.iter().filter(|it| it.risky);
    let unheard = risky.filter(|it| !heard.contains(&it.call));
    Ok(unheard.map(|it| it.call.clone()).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn call(name: &str) -> Call {
        Call::new(name, Vec::new())
    }

    fn verdict(expected: &[(&str, bool)], heard: &[&str]) -> bool {
        let expected: Vec<_> = expected
            .iter()
            .map(|(name, risky)| Expected {
                call: call(name),
                risky: *risky,
            })
            .collect();
        let heard: Vec<_> = heard.iter().map(|name| call(name)).collect();
        judge(&expected, &heard, |call| call.method == "repeat").is_ok()
    }

    #[test]
    fn without_a_crash_all_is_heard_once_and_in_order() {
        let expected = [("a", false), ("b", false), ("a", false)];
        assert!(verdict(&expected, &["a", "b", "a"]));
        for heard in [
            &["a", "b"][..],
            &["a", "a", "b"],
            &["a", "b", "a", "a"],
            &["b", "a"],
            &[],
        ] {
            assert!(!verdict(&expected, heard), "{heard:?}");
        }
    }

    #[test]
    fn a_crash_loses_or_doubles_what_was_under_way_and_repeats_true_lists() {
        let expected = [("a", false), ("x", true), ("y", true), ("b", false)];
        for heard in [
            &["a", "x", "y", "b"][..],
            &["a", "b"],
            &["a", "y", "b"],
            &["a", "x", "b"],
            &["a", "x", "y", "x", "y", "b"],
            &["repeat", "a", "b", "repeat"],
        ] {
            assert!(verdict(&expected, heard), "{heard:?}");
        }
        for heard in [
            &["x", "y", "b"][..],
            &["a", "x", "y"],
            &["a", "a", "b"],
            &["a", "b", "z"],
        ] {
            assert!(!verdict(&expected, heard), "{heard:?}");
        }
    }

    #[test]
    fn what_is_told_twice_never_goes_back() {
        let update = |value: i32| {
            let params = vec!["/master".into(), "/k/".into(), value.into()];
            Call::new("paramUpdate", params)
        };
        let mut model = Master::default();
        let mut lists = TrueLists::default();
        let subscribe = vec!["/s".into(), "http://s".into(), "/k".into()];
        model.apply(&Call::new("subscribeParam", subscribe).into());
        for value in [1, 2, 3, 1] {
            let params = vec!["/n".into(), "/k".into(), value.into()];
            model.apply(&Call::new("setParam", params).into());
            lists.send("http://s", &update(value));
            lists.add(&model);
        }
        let told = |values: &[i32]| {
            let heard: Vec<_> = values.iter().copied().map(update).collect();
            lists.goes_back("http://s", &heard).cloned()
        };
        for good in [
            &[1, 2, 3, 1][..],
            &[1, 1, 2, 2, 3, 3, 1, 1],
            &[2, 3],
            &[1, 3, 1],
            &[1],
        ] {
            assert_eq!(told(good), None, "{good:?}");
        }
        assert_eq!(told(&[1, 3, 2]), Some(update(2)));
        assert_eq!(told(&[2, 1, 3]), Some(update(3)));
        assert_eq!(
            lists.goes_back("http://other", &[update(3), update(2)]),
            None
        );
        lists.settled(&model);
        lists.add(&model);
        assert_eq!(lists.goes_back("http://s", &[update(1)]), None);
    }

    #[test]
    fn a_list_is_true_for_those_who_subscribe_and_in_full() {
        let mut model = Master::default();
        let mut register = |method: &str, node: &str, api: &str| {
            let params = vec![node.into(), "/t".into(), "a/B".into(), api.into()];
            model.apply(&Call::new(method, params).into());
        };
        register("registerPublisher", "/p1", "http://p1");
        register("registerPublisher", "/p2", "http://p2");
        register("registerSubscriber", "/s", "http://s");
        let mut lists = TrueLists::default();
        lists.crash(&model);
        let update = |list: &[&str]| {
            let list: Vec<Value> = list.iter().map(|uri| (*uri).into()).collect();
            let params = vec!["/master".into(), "/t".into(), Value::Array(list)];
            Call::new("publisherUpdate", params)
        };
        assert!(lists.has("http://s", &update(&["http://p1", "http://p2"])));
        assert!(!lists.has("http://s", &update(&["http://p1"])));
        assert!(!lists.has("http://p1", &update(&["http://p1", "http://p2"])));
        // What is swallowed is owed to it until it hears what is true now.
        let late = update(&["http://p1"]);
        lists.answered(&model);
        assert!(lists.owes("http://s", &late, std::slice::from_ref(&late)));
        let truth = update(&["http://p1", "http://p2"]);
        assert!(!lists.owes("http://s", &late, &[truth]));
        lists.crash(&Master::default());
        assert!(!lists.owes("http://s", &late, &[]));
        assert!(lists.has("http://s", &update(&["http://p1", "http://p2"])));
        lists.crash(&Master::default());
        assert!(!lists.has("http://s", &update(&["http://p1", "http://p2"])));
    }
}
