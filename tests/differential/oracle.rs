//! The callbacks that a node may get.
//!
//! Without a crash a node gets exactly the model's callbacks, in order. Through rosrescue the present state may be sent
//! again now and then (`docs/decisions/0031`). A crash of the master may have these effects, and no others:
//!
//! * The callbacks of the call under way may be lost or repeated: the master may have run the call before it died, and
//!   its successor runs it again. The call is answered once. With several computers, the next leader does not know what
//!   its predecessor has sent. So the callbacks of a call that runs twice may come twice, all in order.
//! * The callbacks of unregistrations that are answered without a master may be lost or repeated too. The final list
//!   may stand for several of them.
//! * While the mirror stands in, outdated callbacks may be left out.
//! * A node that misses a list for this reason gets it later, or one that was true after it. As with a bare rosmaster,
//!   it is not notified when a publisher is displaced.
//! * A subscriber may get a callback again: the full list of a topic's publishers, or the value of a parameter. It
//!   never gets a partial list, a value that was not true since the crash before the last one, or a `shutdown`. A node
//!   that does not subscribe gets nothing.
//!
//! The callbacks of one node about one topic or parameter **never go back**, even when they are repeated: no callback
//! has a state that is older than that of an earlier callback. The order is that in which the model reached its states.
//! There is one exception. A node may read callbacks of two senders in the wrong order, because rosrescue waits only
//! 0.3 s until the node has read the first one. It gets the newest state once more then.

use std::collections::{BTreeMap, BTreeSet, HashSet};

use ros1_master::{
    master::Master,
    xmlrpc::{Call, Value},
};

use crate::nodes::blank;

/// A callback of the model.
#[derive(Clone, Debug)]
pub(crate) struct Expected {
    pub(crate) call: Call,
    /// Whether a crash may have lost or repeated this callback.
    pub(crate) risky: bool,
}

/// A callback that a node has got.
#[derive(Clone, Debug)]
pub(crate) struct Heard {
    pub(crate) call: Call,
    /// Whether rosrescue has sent it, and not the master.
    pub(crate) by_rosrescue: bool,
}

/// The calls of these callbacks.
pub(crate) fn calls(heard: &[Heard]) -> Vec<Call> {
    heard.iter().map(|it| it.call.clone()).collect()
}

type List = (String, String, Vec<String>);

/// An event of the model.
#[derive(Clone, Debug)]
enum Moment {
    /// The model sends this call to the node at this address. No node sees the states inside a multicall.
    Notice(String, Call),
    State(Box<Master>),
}

impl Moment {
    /// Whether the node at `api` may get this callback now.
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

/// Complete lists of publishers, by subscriber and topic, that were true recently.
#[derive(Debug, Default)]
pub(crate) struct TrueLists {
    before: HashSet<List>,
    since: HashSet<List>,
    /// Earlier states, for the values of parameters.
    states_before: Vec<Master>,
    states_since: Vec<Master>,
    /// Lists that were true since the last one that the model has sent to their subscriber, or since the crash. A list
    /// becomes shorter without a notification when a publisher is displaced.
    after: HashSet<List>,
    /// Subscribers that have been registered all the time since the call under way was answered.
    faithful: Option<HashSet<(String, String)>>,
    /// Events since the last comparison.
    course: Vec<Moment>,
    /// Events before the last comparison, since the one before it.
    last_course: Vec<Moment>,
}

impl TrueLists {
    /// Notes that the master crashes in this state, after all callbacks were compared.
    pub(crate) fn crash(&mut self, model: &Master) {
        self.before.clear();
        self.states_before.clear();
        self.crash_unjudged(model);
    }

    /// Notes that the master crashes in this state. Its callbacks are compared later.
    pub(crate) fn crash_unjudged(&mut self, model: &Master) {
        self.before.extend(self.since.drain());
        self.states_before.append(&mut self.states_since);
        self.after.clear();
        self.faithful = None;
        self.add(model);
    }

    /// Notes that the call under way has led to this state.
    pub(crate) fn answered(&mut self, model: &Master) {
        self.faithful = None;
        self.add(model);
    }

    /// Notes that another computer may have run the last call once more, with its callbacks.
    pub(crate) fn ran_again(&mut self) {
        let is_callback = |moment: &&Moment| matches!(moment, Moment::Notice(..));
        let mut moments = self.course.iter().rev();
        // The state to which a call leads comes after its callbacks.
        moments.next();
        let callbacks = moments.take_while(is_callback).count();
        let begin = self.course.len() - callbacks - 1;
        self.course.extend_from_within(begin..);
    }

    /// Notes that the model sends this call to the node at `api`.
    pub(crate) fn send(&mut self, api: &str, call: &Call) {
        if let Some((api, topic, _)) = as_list(api, call) {
            self.after
                .retain(|list| (&list.0, &list.1) != (&api, &topic));
        }
        let notice = Moment::Notice(api.to_owned(), call.clone());
        self.course.push(notice);
    }

    /// Notes that all callbacks up to this state were compared.
    pub(crate) fn settled(&mut self, model: &Master) {
        let begin = vec![Moment::State(Box::new(model.clone()))];
        self.last_course = std::mem::replace(&mut self.course, begin);
    }

    /// The first callback whose state is older than that of an earlier callback to the node at `api`, if rosrescue has
    /// sent both, or if it is the last callback about its subject.
    pub(crate) fn goes_back<'c>(&self, api: &str, heard: &'c [Heard]) -> Option<&'c Call> {
        let own = heard.iter().filter(|it| it.by_rosrescue);
        let own = self.older(api, own).first().copied();
        let is_last = |call: &&Call| {
            let last = heard.iter().rfind(|it| subject(&it.call) == subject(call));
            last.is_some_and(|last| std::ptr::eq(&last.call, *call))
        };
        own.or_else(|| self.older(api, heard.iter()).into_iter().find(is_last))
    }

    /// The callbacks whose state is older than that of an earlier one of `heard`.
    fn older<'c>(&self, api: &str, heard: impl Iterator<Item = &'c Heard>) -> Vec<&'c Call> {
        let mut reached: BTreeMap<(&str, Option<&str>), usize> = BTreeMap::new();
        let mut older = Vec::new();
        for Heard { call, .. } in heard {
            let from = reached.get(&subject(call)).copied().unwrap_or_default();
            let says = |moment: &Moment| moment.says(api, call);
            if let Some(steps) = self.course[from..].iter().position(says) {
                reached.insert(subject(call), from + steps);
            } else if self.course[..from].iter().any(says) {
                older.push(call);
            }
        }
        older
    }

    /// Adds this state, with its lists and values.
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

    /// Whether a crash allows this callback to the node at `api`.
    pub(crate) fn has(&self, api: &str, call: &Call) -> bool {
        // The last callback before a comparison may overtake one of another sender that no state between calls has. To
        // these nodes rosrescue sends no `shutdown`.
        let mut callbacks = self.last_course.iter();
        let is_shutdown = call.method == "shutdown";
        if !is_shutdown
            && callbacks
                .any(|it| matches!(it, Moment::Notice(to, late) if to == api && late == call))
        {
            return true;
        }
        if call.method == "paramUpdate" {
            let mut states = self.states_before.iter().chain(&self.states_since);
            return states.any(|state| is_true_param(state, api, call));
        }
        let list = as_list(api, call);
        list.is_some_and(|list| self.before.contains(&list) || self.since.contains(&list))
    }

    /// Whether the node at `api` must still get a replacement for a callback that the crash has lost: it subscribes,
    /// and has not got a list that was true when the model sent its last one, or later.
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

/// Whether the `paramUpdate` is about a parameter to which the node at `api` subscribes, with its value in this state.
fn is_true_param(state: &Master, api: &str, call: &Call) -> bool {
    let key = call.params.get(1).and_then(Value::as_str);
    key.is_some_and(|key| {
        state.subscribes_param(|at| at == api, key)
            && state.param_update(key).map(blank).as_ref() == Some(call)
    })
}

/// What a callback is about: its method, and the topic or the parameter.
fn subject(call: &Call) -> (&str, Option<&str>) {
    let about = call.params.get(1).and_then(Value::as_str);
    (call.method.as_str(), about)
}

/// Subscriber, topic and publishers of a `publisherUpdate`.
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

/// Checks that the callbacks were those expected. Returns the ones that a crash has lost.
///
/// Callbacks may be equal, so they can be matched in several ways. All of them are tried.
pub(crate) fn judge(
    expected: &[Expected],
    heard: &[Call],
    is_repeat: impl Fn(&Call) -> bool,
) -> Result<Vec<Call>, String> {
    // Numbers of expected callbacks that may have been matched so far.
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
    fn without_a_crash_each_callback_comes_once_and_in_order() {
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
    fn a_crash_may_lose_or_repeat_running_callbacks_and_repeats_true_lists() {
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

    /// The callback about a value of `/k`.
    fn update(value: i32) -> Call {
        let params = vec!["/master".into(), "/k/".into(), value.into()];
        Call::new("paramUpdate", params)
    }

    /// A model in which `/k` gets each list of values within one call.
    fn course(calls: &[&[i32]]) -> (Master, TrueLists) {
        let mut model = Master::default();
        let mut lists = TrueLists::default();
        let subscribe = vec!["/s".into(), "http://s".into(), "/k".into()];
        model.apply(&Call::new("subscribeParam", subscribe).into());
        for values in calls {
            for value in *values {
                let params = vec!["/n".into(), "/k".into(), (*value).into()];
                model.apply(&Call::new("setParam", params).into());
                lists.send("http://s", &update(*value));
            }
            lists.add(&model);
        }
        (model, lists)
    }

    fn heard(value: i32, by_rosrescue: bool) -> Heard {
        let call = update(value);
        Heard { call, by_rosrescue }
    }

    /// The first of these callbacks of rosrescue that goes back.
    fn goes_back(lists: &TrueLists, values: &[i32]) -> Option<Call> {
        let heard: Vec<_> = values.iter().map(|value| heard(*value, true)).collect();
        lists.goes_back("http://s", &heard).cloned()
    }

    #[test]
    fn repeated_callbacks_never_go_back() {
        let (model, mut lists) = course(&[&[1], &[2], &[3], &[1]]);
        let told = |values: &[i32]| goes_back(&lists, values);
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
        let other = [heard(3, true), heard(2, true)];
        assert_eq!(lists.goes_back("http://other", &other), None);
        lists.settled(&model);
        lists.add(&model);
        assert_eq!(goes_back(&lists, &[1]), None);
    }

    #[test]
    fn two_senders_may_be_read_in_the_wrong_order_if_the_newest_comes_once_more() {
        let (_, lists) = course(&[&[1], &[2], &[3], &[1], &[4]]);
        let (master, rosrescue) = (false, true);
        let told = |all: &[(bool, i32)]| {
            let all = all.iter().map(|(sender, value)| heard(*value, *sender));
            let all: Vec<_> = all.collect();
            lists.goes_back("http://s", &all).cloned()
        };
        for good in [
            &[(master, 1), (master, 3), (rosrescue, 2), (rosrescue, 3)][..],
            &[(master, 2), (rosrescue, 4), (master, 3), (master, 4)],
            &[(master, 4), (rosrescue, 1), (master, 4)],
        ] {
            assert_eq!(told(good), None, "{good:?}");
        }
        let bad = [(master, 1), (master, 3), (rosrescue, 2)];
        assert_eq!(told(&bad), Some(update(2)));
        // The state of the last one is newer than that of the one before it, but not the newest.
        let bad = [(master, 4), (rosrescue, 2), (rosrescue, 3)];
        assert_eq!(told(&bad), Some(update(3)));
        // rosrescue sends its own callbacks one after the other.
        let bad = [(rosrescue, 3), (rosrescue, 2), (master, 4)];
        assert_eq!(told(&bad), Some(update(2)));
    }

    #[test]
    fn the_callbacks_of_a_call_that_runs_twice_may_come_twice() {
        let (_, mut lists) = course(&[&[9], &[1, 2]]);
        assert_eq!(goes_back(&lists, &[1, 2, 1, 2]), Some(update(1)));
        lists.ran_again();
        for good in [&[9, 1, 2, 1, 2][..], &[1, 1, 2], &[2, 1, 2, 2]] {
            assert_eq!(goes_back(&lists, good), None, "{good:?}");
        }
        assert_eq!(goes_back(&lists, &[1, 2, 1, 2, 1]), Some(update(1)));
        assert_eq!(goes_back(&lists, &[1, 2, 9]), Some(update(9)));
    }

    #[test]
    fn a_callback_from_within_a_call_may_come_after_the_next_comparison_but_not_later() {
        let (model, mut lists) = course(&[&[1, 2]]);
        assert!(!lists.has("http://s", &update(1)));
        lists.settled(&model);
        assert!(lists.has("http://s", &update(1)));
        assert!(!lists.has("http://s", &update(3)) && !lists.has("http://other", &update(1)));
        assert_eq!(goes_back(&lists, &[2, 1]), None);
        lists.settled(&model);
        assert!(!lists.has("http://s", &update(1)) && lists.has("http://s", &update(2)));
    }

    #[test]
    fn a_list_that_becomes_shorter_in_silence_replaces_a_lost_one() {
        let register = |method: &str, node: &str, api: &str| {
            let params = vec![node.into(), "/t".into(), "a/B".into(), api.into()];
            Call::new(method, params)
        };
        let mut model = Master::default();
        let mut lists = TrueLists::default();
        model.apply(&register("registerSubscriber", "/s", "http://s").into());
        model.apply(&register("registerPublisher", "/p1", "http://p1").into());
        let before = model.publisher_update("/t");
        lists.crash(&model);
        model.apply(&register("registerPublisher", "/p2", "http://p2").into());
        let lost = model.publisher_update("/t");
        lists.send("http://s", &lost);
        lists.answered(&model);
        let mut good = vec![lost.clone()];
        for node in ["/p1", "/p2"] {
            let params = vec![node.into(), "http://elsewhere".into(), "/k".into()];
            let displacement = Call::new("subscribeParam", params);
            model.apply(&displacement.into());
            lists.answered(&model);
            good.push(model.publisher_update("/t"));
        }
        for heard in good {
            assert!(!lists.owes("http://s", &lost, std::slice::from_ref(&heard)));
        }
        assert!(lists.owes("http://s", &lost, &[before]));
    }

    #[test]
    fn a_true_list_is_complete_and_for_subscribers_only() {
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
        // The node must get a replacement for the lost callback until it gets a list that is true now.
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
