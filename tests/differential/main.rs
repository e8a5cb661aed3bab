//! The model against real rosmasters: random sequences of calls must be answered alike, leave the
//! same state, cause the same callbacks, and be brought whole to a fresh rosmaster by one call.
//!
//! `ROSRESCUE_SEQUENCES` sets how many sequences are run, `ROSRESCUE_SEED` where they begin.

#![allow(
    clippy::expect_used,
    clippy::indexing_slicing,
    clippy::unwrap_used,
    reason = "a test fails by panicking"
)]

mod dice;
mod nodes;
mod real;

use std::collections::BTreeSet;

use dice::{CALLERS, Cast, Dice};
use nodes::Node;
use real::Rosmaster;
use rosrescue::master::{
    FirstLook, Mark, Master, NotAMaster, Notice, Plan, Skipped, accepted, difference,
};
use rosrescue::xmlrpc::{Call, Reply, Value};

/// Sequences by default: about a minute on two cores.
const SEQUENCES: u64 = 120;

/// Calls of a sequence.
const CALLS: usize = 80;

fn number(name: &str, default: u64) -> u64 {
    match std::env::var(name) {
        Ok(text) => text.parse().expect(name),
        Err(_) => default,
    }
}

#[test]
fn random_sequences_are_answered_alike_and_brought_back_whole() {
    let nodes: Vec<Node> = (0..5).map(|_| Node::start()).collect();
    let mut apis: Vec<String> = nodes.iter().map(|node| node.api.clone()).collect();
    apis.push("rosrpc://h:1".to_owned());
    let sequences = number("ROSRESCUE_SEQUENCES", SEQUENCES);
    let first = number("ROSRESCUE_SEED", u64::from(std::process::id()) << 20);
    let mut spare = Rosmaster::start();
    let mut compared = 0;
    let mut carried: Option<(Rosmaster, Master)> = None;
    for seed in first..first + sequences {
        println!("seed {seed}");
        let mut dice = Dice(seed);
        let mut cast = Cast {
            apis: apis.clone(),
            poison: dice.once_in(3),
            errors: !dice.once_in(4),
        };
        // A master that was brought to a state goes on as one that came there by itself.
        let go_on = dice.once_in(2) && !cast.poison;
        let (mut real, mut model) = match carried.take().filter(|_| go_on) {
            Some(carried) => carried,
            None => {
                let real = std::mem::replace(&mut spare, Rosmaster::start()).ready();
                (real, Master::default())
            }
        };
        model.set_identity(real.pid, real.uri.clone());
        let notices = play(&mut dice, &cast, CALLS, &mut real, &mut model);
        if !cast.poison {
            hear(&nodes, seed, &mut real, &mut model, notices);
        } else {
            settle(&nodes, seed, &mut real, &mut model);
        }
        same_reads(&mut real, &mut model.clone());
        look(&mut real, &model);
        cast.poison = false;

        let mut fresh = std::mem::replace(&mut spare, Rosmaster::start()).ready();
        let mut found = Master::default();
        found.set_identity(fresh.pid, fresh.uri.clone());
        let mut told = told_nobody(&cast);
        if dice.once_in(3) {
            told = play(&mut dice, &cast, 15, &mut fresh, &mut found);
        }
        let plan = Plan::new(&model, &found, &Mark::new("test"));
        let reply = fresh.call(plan.call());
        assert_eq!(plan.verify(&reply), Ok(()), "{:?}", plan.skipped());
        let notices = found.clone().apply(plan.call()).notices;
        assert!(
            !notices
                .iter()
                .any(|notice| matches!(notice, Notice::Shutdown { .. }))
        );
        assert!(!found.is_empty() || notices.is_empty(), "{notices:?}");
        let is_complete = |notice: &Notice| match notice {
            Notice::PublisherUpdate {
                topic, publishers, ..
            } => *publishers == plan.expected().publishers_of(topic),
            _ => true,
        };
        assert!(notices.iter().all(is_complete), "{notices:?}");
        note(&mut told, &notices);
        let mut expected = plan.expected().clone();
        let cannot_be = |skipped: &Skipped| {
            matches!(skipped, Skipped::Param { .. } | Skipped::Unnameable { .. })
        };
        assert!(
            !found.is_empty() || plan.skipped().iter().all(cannot_be),
            "{:?}",
            plan.skipped()
        );
        if found.is_empty() && plan.skipped().is_empty() {
            compared += 1;
            assert_eq!(difference(&model, &expected), Vec::<String>::new());
        }
        hear(&nodes, seed, &mut fresh, &mut expected, told);
        same_reads(&mut fresh, &mut expected.clone());
        carried = Some((fresh, expected));
    }
    println!("{compared} of {sequences} states were compared whole after their injection");
}

type Expected = Vec<(String, Vec<Call>)>;

fn told_nobody(cast: &Cast) -> Expected {
    cast.apis
        .iter()
        .map(|api| (api.clone(), Vec::new()))
        .collect()
}

fn note(told: &mut Expected, notices: &[Notice]) {
    for (to, call) in notices.iter().map(nodes::as_call) {
        if let Some((_, calls)) = told.iter_mut().find(|(api, _)| api == to) {
            calls.push(call);
        }
    }
}

/// Plays a sequence to both; gives what the nodes must hear.
fn play(
    dice: &mut Dice,
    cast: &Cast,
    calls: usize,
    real: &mut Rosmaster,
    model: &mut Master,
) -> Expected {
    let mut told = told_nobody(cast);
    for step in 0..calls {
        let call = dice.call(cast, 2);
        let before = model.clone();
        let reply = real.call(&call);
        let outcome = model.apply(&call);
        assert_eq!(outcome.reply, reply, "step {step}: {call:?}");
        note(&mut told, &outcome.notices);
        let mut mirror = before.clone();
        let accepted = accepted(&before, &call, &reply);
        for (call, _) in &accepted.calls {
            mirror.apply(call);
        }
        let words = difference(&mirror, model);
        assert_eq!(
            words,
            Vec::<String>::new(),
            "step {step}: {call:?} answered {reply:?}"
        );
    }
    told
}

/// Makes every node hear one last thing, and compares what they heard before it.
fn hear(nodes: &[Node], seed: u64, real: &mut Rosmaster, model: &mut Master, expected: Expected) {
    let heard = settle(nodes, seed, real, model);
    for (node, (heard, last)) in nodes.iter().zip(heard) {
        let (_, mut calls) = expected
            .iter()
            .find(|(api, _)| *api == node.api)
            .unwrap()
            .clone();
        calls.extend(last);
        let heard: Vec<Call> = heard.into_iter().map(nodes::blank).collect();
        for (index, (heard, expected)) in heard.iter().zip(&calls).enumerate() {
            assert_eq!(heard, expected, "callback {index} to {}", node.api);
        }
        assert_eq!(heard.len(), calls.len(), "callbacks to {}", node.api);
    }
}

/// What every node heard up to a last thing, and what the settling itself added to it.
fn settle(
    nodes: &[Node],
    seed: u64,
    real: &mut Rosmaster,
    model: &mut Master,
) -> Vec<(Vec<Call>, Vec<Call>)> {
    let topic = format!("/last{seed}");
    let mut notices = Vec::new();
    let mut both = |call: Call| {
        let outcome = model.apply(&call);
        assert_eq!(outcome.reply, real.call(&call), "{call:?}");
        notices.extend(outcome.notices);
    };
    let call = |method: &str, params: &[&str]| {
        Call::new(method, params.iter().map(|text| (*text).into()).collect())
    };
    let listeners: Vec<String> = (0..nodes.len()).map(|i| format!("/listener{i}")).collect();
    for (name, node) in listeners.iter().zip(nodes) {
        both(call(
            "registerSubscriber",
            &[name, &topic, "a/B", &node.api],
        ));
    }
    both(call(
        "registerPublisher",
        &["/last", &topic, "a/B", "http://last"],
    ));
    for (name, node) in listeners.iter().zip(nodes) {
        both(call("unregisterSubscriber", &[name, &topic, &node.api]));
    }
    both(call(
        "unregisterPublisher",
        &["/last", &topic, "http://last"],
    ));
    let is_last = |call: &Call| call.params.get(1) == Some(&Value::from(topic.as_str()));
    let mine = |node: &Node| {
        let told = notices
            .iter()
            .map(nodes::as_call)
            .filter(|(to, _)| *to == node.api);
        told.map(|(_, call)| call).collect()
    };
    nodes
        .iter()
        .map(|node| (node.take(is_last), mine(node)))
        .collect()
}

/// Every read that a client may send, of everything that was ever named.
fn same_reads(real: &mut Rosmaster, model: &mut Master) {
    let own = |method: &str| Call::new(method, vec!["/test".into()]);
    let mut calls: Vec<Call> = ["getSystemState", "getTopicTypes", "getParamNames"]
        .map(own)
        .into();
    let one = |caller: &str, method: &str, name: &str| {
        Call::new(method, vec![caller.into(), name.into()])
    };
    calls.push(one("/test", "getPublishedTopics", ""));
    calls.push(one("/test", "getPublishedTopics", "/ns"));
    calls.push(one("/test", "getParam", "/"));
    calls.extend(
        model
            .params()
            .keys()
            .map(|key| one("/test", "getParam", key))
            .filter(|call| call.params.get(1) != Some(&Value::from(""))),
    );
    let nodes: BTreeSet<String> = CALLERS
        .iter()
        .map(|caller| (*caller).to_owned())
        .chain(model.nodes().map(|(caller_id, _)| caller_id.to_owned()))
        .collect();
    calls.extend(nodes.iter().map(|node| one(node, "lookupNode", "~")));
    calls.extend(nodes.iter().map(|node| one("/a//x", "lookupNode", node)));
    let services = model.snapshot().services.into_keys();
    calls.extend(services.map(|service| one("/test", "lookupService", &service)));
    for call in calls {
        assert_eq!(model.apply(&call).reply, real.call(&call), "{call:?}");
    }
}

/// A look at the real master, with the model as the state known before, must show the model.
fn look(real: &mut Rosmaster, model: &Master) {
    let mark = Mark::new("none");
    let look = match FirstLook::decode(&real.call(&FirstLook::call(&mark))) {
        Err(NotAMaster::ParamsUnreadable { .. }) => {
            FirstLook::decode(&real.call(&FirstLook::call_without_params(&mark)))
        }
        look => look,
    };
    let look = look.unwrap();
    assert_eq!((look.pid(), look.marked()), (real.pid, false));
    let second: Option<Reply> = look.second_call(model).map(|call| real.call(&call));
    let found = look.into_master(second.as_ref(), model).unwrap();
    assert_eq!(difference(model, &found), Vec::<String>::new());
}
