//! Computes the state for a master that could not be reached for a while and has missed writes. That master has the
//! latest token: the one with the highest number that rosrescue knows.

use std::collections::BTreeSet;

use super::{Token, restore};
use ros1_master::master::{Effect, Master, Method, Request, Write, names};
use ros1_master::xmlrpc::Value;

/// Which side wins where the mirror and a master with the latest [`Token`] differ.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Authority {
    /// The mirror wins only where it has answered writes since mirror and master were last equal. Everywhere else the
    /// master wins, because its state is newer: clients wrote to it directly, or the checkpoint lacks the last writes.
    PendingWrites,
    /// The mirror wins wherever it has an entry, because the master got the mirror's state and has not confirmed it.
    Mirror,
}

/// Combines `held`, the state of a master with the latest [`Token`], with `mirror`. `pending` are writes that the
/// mirror has answered and the master may not have run. Writes that the master has already run may run again: the
/// result is the same.
pub fn reconcile(
    mirror: &Master,
    held: &Master,
    pending: &[Request],
    authority: Authority,
) -> Master {
    let mut theirs = held.clone();
    for call in pending {
        theirs.apply_telling(call, &mut ());
    }
    if authority == Authority::PendingWrites || theirs == *mirror {
        return theirs;
    }
    let mut target = mirror.clone();
    for call in additions(mirror, &theirs) {
        target.apply_telling(&call, &mut ());
    }
    target
}

/// The nodes that `pending` registers, each with its address.
pub fn registrants(pending: &[Request]) -> BTreeSet<(String, String)> {
    let calls = pending.iter().flat_map(Request::calls);
    let registrants = calls.filter_map(registrant);
    registrants
        .map(|(node, api)| (node.to_owned(), api.to_owned()))
        .collect()
}

/// The writes in `pending` without registrations at these addresses. They would displace the nodes that took the names
/// of those that ended.
pub fn without_ended(pending: Vec<Request>, ended: &BTreeSet<String>) -> Vec<Request> {
    let has_ended = |call: &Request| registrant(call).is_some_and(|(_, api)| ended.contains(api));
    if !pending.iter().flat_map(Request::calls).any(has_ended) {
        return pending;
    }
    let calls = pending.iter().flat_map(Request::calls);
    calls.filter(|call| !has_ended(call)).cloned().collect()
}

fn registrant(call: &Request) -> Option<(&str, &str)> {
    Write::parse(call)?.registrant()
}

/// What a master with the latest [`Token`] may hold although no read shows it: the parameter subscriptions in `mirror`,
/// and those that a pending write removes. Returns `mirror` with the removed subscriptions added again.
pub fn may_hold(mirror: &Master, pending: &[Request]) -> Master {
    let mut master = mirror.clone();
    for call in pending {
        let Some(Write { caller, effect }) = Write::parse(call) else {
            continue;
        };
        // A node that has another address by now has lost its earlier subscriptions.
        if let Effect::UnsubscribeParam { api, .. } = effect
            && mirror.api_of(caller).is_none_or(|known| known == api)
        {
            let params = call.params().iter().cloned();
            master.apply_telling(&Request::new(Method::SubscribeParam, params), &mut ());
        }
    }
    master
}

/// The calls that add to `mirror` what only `master` holds. A node that the mirror has at another address adds nothing.
fn additions(mirror: &Master, master: &Master) -> Vec<Request> {
    let mut calls = Vec::new();
    let tree = restore::merged(mirror.params(), master.params());
    if !tree.iter().eq(mirror.params()) {
        let params = [names::CALLER_ID.into(), "/".into(), Value::Struct(tree)];
        calls.push(Request::new(Method::SetParam, params));
    }
    let api = |caller_id: &str| {
        let api = master.api_of(caller_id)?;
        let known = mirror.api_of(caller_id);
        (known.is_none_or(|known| known == api) && !Token::is_ours(caller_id)).then_some(api)
    };
    let (ours, theirs) = (mirror.registry(), master.registry());
    for (method, ours, theirs) in [
        (
            Method::RegisterPublisher,
            &ours.publishers,
            &theirs.publishers,
        ),
        (
            Method::RegisterSubscriber,
            &ours.subscribers,
            &theirs.subscribers,
        ),
    ] {
        for (topic, callers) in theirs {
            let known = ours.get(topic).map_or(&[][..], Vec::as_slice);
            for caller_id in callers.iter().filter(|caller| !known.contains(caller)) {
                let topic_type = mirror.type_of(topic).or_else(|| master.type_of(topic));
                let name = names::name_for(topic, caller_id);
                if let (Some(api), Some(name)) = (api(caller_id), name) {
                    let words = [caller_id, name.as_str(), topic_type.unwrap_or("*"), api];
                    calls.push(Request::new(method.clone(), words));
                }
            }
        }
    }
    for (service, entry) in &theirs.services {
        let name = names::name_for(service, &entry.node);
        if !ours.services.contains_key(service)
            && let (Some(api), Some(name)) = (api(&entry.node), name)
        {
            let words = [entry.node.as_str(), &name, &entry.api, api];
            calls.push(Request::new(Method::RegisterService, words));
        }
    }
    calls
}

#[cfg(test)]
mod tests {
    use super::*;

    fn call(method: &str, params: &[&str]) -> Request {
        Request::new(Method::named(method), params.iter().copied())
    }

    fn set(key: &str, value: i32) -> Request {
        Request::new(
            Method::SetParam,
            [Value::from("/n"), key.into(), value.into()],
        )
    }

    fn publish(node: &str, topic: &str) -> Request {
        let api = format!("http:/{node}:1/");
        call("registerPublisher", &[node, topic, "x/Y", &api])
    }

    fn master_after(calls: &[Request]) -> Master {
        let mut master = Master::default();
        for call in calls {
            master.apply(call);
        }
        master
    }

    #[test]
    fn writes_that_bypassed_rosrescue_are_kept_unless_a_pending_write_is_newer() {
        let base = [set("/old", 1), set("/both", 1), publish("/n", "/t")];
        let gone = call("unregisterPublisher", &["/n", "/t", "http://n:1/"]);
        let pending = [set("/both", 2), gone.clone()];
        let mirror = master_after(&[&base[..], &pending].concat());
        let past_us = [set("/old", 3), set("/both", 3), publish("/new", "/t")];
        let held = master_after(&[&base[..], &past_us].concat());
        let target = reconcile(&mirror, &held, &pending, Authority::PendingWrites);
        let expected = [&base[..], &past_us, &pending].concat();
        assert_eq!(target, master_after(&expected));
        // The result is the same if the master has run some of the pending writes.
        let held = master_after(&[&base[..], &past_us, &pending[..1]].concat());
        let target = reconcile(&mirror, &held, &pending, Authority::PendingWrites);
        assert_eq!(target, master_after(&expected));
    }

    #[test]
    fn the_mirror_wins_wherever_it_has_an_entry_and_takes_over_the_rest() {
        let base = [set("/a", 1), publish("/n", "/t")];
        let mirror = master_after(&base);
        let moved = call("registerPublisher", &["/n", "/t", "x/Y", "http://n:2/"]);
        let offer = call(
            "registerService",
            &["/m", "/s", "rosrpc://m:2", "http://m:1/"],
        );
        let listen = call("registerSubscriber", &["/m", "/t", "*", "http://m:1/"]);
        let held = [
            set("/a", 2),
            set("/b", 2),
            moved,
            offer.clone(),
            listen.clone(),
        ];
        let target = reconcile(&mirror, &master_after(&held), &[], Authority::Mirror);
        let expected = [&base[..], &[set("/b", 2), listen, offer]].concat();
        assert_eq!(target, master_after(&expected));
        let target = reconcile(&mirror, &Master::default(), &[], Authority::Mirror);
        assert_eq!(target, mirror);
    }

    #[test]
    fn what_a_pending_write_removed_is_not_taken_over_again() {
        let offer = call(
            "registerService",
            &["/n", "/s", "rosrpc://n:2", "http://n:1/"],
        );
        let gone = call("unregisterService", &["/n", "/s", "rosrpc://n:2"]);
        let held = master_after(std::slice::from_ref(&offer));
        let mirror = master_after(&[offer, gone.clone()]);
        let target = reconcile(&mirror, &held, &[gone], Authority::Mirror);
        assert_eq!(target, mirror);
    }

    #[test]
    fn a_parameter_subscription_that_a_pending_write_removes_may_still_be_there() {
        let watch = |api: &str| call("subscribeParam", &["/n", api, "/k"]);
        let gone = |api: &str| call("unsubscribeParam", &["/n", api, "/k"]);
        let mirror = master_after(&[watch("http://n:1/"), gone("http://n:1/")]);
        let held = may_hold(&mirror, &[gone("http://n:1/")]);
        assert_eq!(held, master_after(&[watch("http://n:1/")]));
        let target = reconcile(
            &mirror,
            &held,
            &[gone("http://n:1/")],
            Authority::PendingWrites,
        );
        assert_eq!(target, mirror);
        let moved = master_after(&[watch("http://n:2/")]);
        assert_eq!(may_hold(&moved, &[gone("http://n:1/")]), moved);
    }

    /// A node starts again at another address. rosrescue dies before it has recorded that, and before it knows that the
    /// master has run an earlier registration.
    #[test]
    fn a_pending_registration_of_an_ended_node_displaces_no_living_one() {
        let publish = |api: &str| call("registerPublisher", &["/n", "/t", "x/Y", api]);
        let pending = vec![publish("http://n:1/"), set("/a", 1)];
        let registrants = registrants(&pending);
        let expected = ("/n".to_owned(), "http://n:1/".to_owned());
        assert!(registrants.iter().eq([&expected]));
        let ended = BTreeSet::from([expected.1]);
        let left = without_ended(pending.clone(), &ended);
        assert_eq!(left, [set("/a", 1)]);
        let inner = Request::multicall(pending);
        assert_eq!(without_ended(vec![inner], &ended), [set("/a", 1)]);
    }

    /// If a call is said to change nothing, the state is equal afterwards.
    #[test]
    fn calls_that_would_change_nothing_are_recognised() {
        let watch = call("subscribeParam", &["/n", "http://n:1/", "k"]);
        let offer = call(
            "registerService",
            &["/n", "s", "rosrpc://n:2", "http://n:1/"],
        );
        let listen = call("registerSubscriber", &["/n", "t", "x/Y", "http://n:1/"]);
        let state = [set("/k", 1), publish("/n", "/t"), watch, offer, listen];
        let master = master_after(&state);
        for call in &state {
            assert!(!master.would_change(call), "{call:?}");
            assert!(Master::default().would_change(call), "{call:?}");
        }
        assert!(!master.would_change(&Request::multicall(state.clone())));
        let tree = Request::new(
            Method::SetParam,
            [Value::from("/n"), "/k".into(), Value::Array(vec![])],
        );
        for change in [
            set("/k", 2),
            tree,
            publish("/m", "/t"),
            call("registerPublisher", &["/n", "/t", "x/Z", "http://n:1/"]),
            call("registerPublisher", &["/n", "/t", "x/Y", "http://n:2/"]),
            call("subscribeParam", &["/n", "http://n:2/", "k"]),
            call(
                "registerService",
                &["/n", "s", "rosrpc://n:3", "http://n:1/"],
            ),
            call("unregisterPublisher", &["/n", "/t", "http://n:1/"]),
            call("unregisterSubscriber", &["/n", "t", "http://n:1/"]),
            call("unregisterService", &["/n", "s", "rosrpc://n:2"]),
            call("unsubscribeParam", &["/n", "http://n:1/", "k"]),
            call("deleteParam", &["/n", "k"]),
        ] {
            assert!(master.would_change(&change), "{change:?}");
            let mut changed = master.clone();
            changed.apply(&change);
            assert_ne!(changed, master, "{change:?}");
            assert!(
                !changed.would_change(&change) || change.params().len() == 3,
                "{change:?}"
            );
        }
        for idle in [
            call("unregisterPublisher", &["/m", "/t", "http://m:1/"]),
            call("unregisterPublisher", &["/n", "/t", "http://n:2/"]),
            call("unregisterService", &["/n", "s", "rosrpc://n:3"]),
            call("deleteParam", &["/n", "/other"]),
        ] {
            assert!(!master.would_change(&idle), "{idle:?}");
            let mut same = master.clone();
            same.apply(&idle);
            assert_eq!(same, master, "{idle:?}");
        }
    }
}
