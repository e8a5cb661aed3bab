use super::*;
use crate::replay::{Plan, Skipped, Token, difference};
use ros1_master::master::Kind;
use ros1_master::xmlrpc::{decode_call, encode_call, encode_reply};
use test_support::dice::Dice;

fn token() -> Token {
    Token::new("m", 1)
}

/// The multicall that a plan sends.
fn sent(plan: &Plan) -> Request {
    let call = decode_call(plan.request()).unwrap();
    assert_eq!(plan.request(), &encode_call(&call));
    call.into()
}

/// Runs a plan on a model of the new master. Returns that master and the callbacks that it has sent.
fn run(plan: &Plan, found: &Master) -> (Master, Vec<Notice>) {
    let mut master = found.clone();
    let outcome = master.apply(&sent(plan));
    assert_eq!(plan.verify(&outcome.reply), Ok(()));
    assert_eq!(plan.answer(), &encode_reply(&outcome.reply));
    assert!(Token::is_found(&master.apply(&token().lookup()).reply));
    let [session, _] = token().set_calls();
    master.apply(&token().remove());
    master.apply(&Request::new(
        Method::UnsubscribeParam,
        session.params().to_vec(),
    ));
    assert_eq!(&master, plan.expected());
    (master, outcome.notices)
}

/// Brings an empty master to `target`, and checks that it then holds `target` and has sent no callback.
fn restores(target: &Master) -> Plan {
    let plan = Plan::new(target, &Master::default(), &token());
    let (master, notices) = run(&plan, &Master::default());
    assert_eq!(difference(target, &master), Vec::<String>::new());
    assert_eq!(&master, target);
    assert_eq!(notices, []);
    assert_eq!(plan.skipped(), []);
    plan
}

fn entries(plan: &Plan) -> Vec<String> {
    let sent = sent(plan);
    let names = sent.calls().into_iter().map(|call| call.method().name());
    names.map(str::to_owned).collect()
}

fn count(plan: &Plan, method: &str) -> usize {
    entries(plan).iter().filter(|name| *name == method).count()
}

#[test]
fn restoring_an_empty_state_takes_only_reads_and_the_token() {
    let plan = restores(&Master::default());
    let names = [
        "getSystemState",
        "getTopicTypes",
        "getParam",
        "subscribeParam",
        "subscribeParam",
    ];
    assert_eq!(entries(&plan), names);
    assert_eq!(sent(&plan).kind(), Kind::Mutate);
}

#[test]
fn a_whole_state_is_restored_with_the_order_of_every_list() {
    let master = after([
        subscribe("/late", "/x", "a/B"),
        publish("/one", "/t", "a/B"),
        publish("/two", "/t", "a/B"),
        publish("/one", "/x", "a/B"),
        subscribe("/one", "/any", "*"),
        provide("/one", "/s"),
        provide("/two", "/s"),
        provide("/two", "/r"),
        watch("/one", "/p"),
        watch("/root", "/"),
        set(
            "/p",
            tree([("a/b", 1.into()), ("", 2.into()), ("empty", tree([]))]),
        ),
        set("/q", Value::DateTime("20200101T00:00:00".into())),
    ]);
    restores(&master);
}

#[test]
fn only_addresses_that_the_master_already_had_are_read_back() {
    let target = after([publish("/one", "/t", "a/B"), provide("/one", "/s")]);
    assert_eq!(count(&restores(&target), "lookupNode"), 0);
    assert_eq!(count(&restores(&target), "lookupService"), 0);
    let found = after([provide("/two", "/r")]);
    let plan = Plan::new(&target, &found, &token());
    run(&plan, &found);
    assert_eq!(count(&plan, "lookupNode"), 1);
    assert_eq!(count(&plan, "lookupService"), 1);
}

#[test]
fn each_topic_type_out_of_order_takes_one_helper_registration() {
    // `/late` had a subscriber before any topic was published, so its type comes first.
    let master = after([
        subscribe("/s", "/late", "a/B"),
        publish("/p", "/early", "a/B"),
        publish("/p", "/late", "a/B"),
    ]);
    let plan = restores(&master);
    assert_eq!(count(&plan, "unregisterSubscriber"), 1);
    let natural = after([publish("/p", "/a", "a/B"), subscribe("/s", "/b", "a/B")]);
    assert_eq!(count(&restores(&natural), "unregisterSubscriber"), 0);
}

#[test]
fn types_of_topics_without_nodes_are_restored_including_the_star() {
    let mut master = after([
        publish("/p", "/gone", "a/B"),
        publish("/p", "/star", "*"),
        subscribe("/s", "/star", "*"),
        subscribe("/s", "/first", "a/B"),
    ]);
    for call in master.unregister_calls("/p") {
        master.apply(&call);
    }
    restores(&master);
}

#[test]
fn nodes_whose_services_were_taken_over_stay_known() {
    let mut master = after([
        provide("/a", "/s"),
        provide("/b", "/s"),
        provide("/c", "/s"),
        provide("/a", "/r"),
        provide("/b", "/r"),
    ]);
    master.apply(&call("unregisterService", &["/b", "/r", "rosrpc://h/b"]));
    restores(&master);
}

#[test]
fn malformed_node_names_are_restored() {
    let master = after([
        publish("/n", "//", "a/B"),
        publish("/a b/c", "t", "a/B"),
        publish("a/n", "t", "a/B"),
        subscribe("/a//n", "t", "a/B"),
        subscribe("plain", "~", "a/B"),
        provide("a/n", "s"),
        watch("a/n", "k"),
        watch("/a//n", "k/"),
    ]);
    restores(&master);
}

#[test]
fn unreturnable_parameters_are_left_out_and_named_by_key() {
    let master = after([
        set("/good", 1),
        set("/ns/nil", vec![Value::Nil]),
        set("/ns/big", Value::BigInt("5000000000".into())),
        set("/ns/fine", 2),
    ]);
    let plan = Plan::new(&master, &Master::default(), &token());
    let skipped: Vec<_> = plan.skipped().iter().map(ToString::to_string).collect();
    assert_eq!(skipped.len(), 2);
    assert!(skipped[0].contains("`/ns/nil`") && skipped[1].contains("`/ns/big`"));
    let (restored, _) = run(&plan, &Master::default());
    assert_eq!(restored, after([set("/good", 1), set("/ns/fine", 2)]));
}

/// A master in any state can be brought to exactly any other state, and no node is notified.
#[test]
fn a_state_is_replaced_without_any_callback() {
    let roscore = roscore();
    let other = after([
        publish("/p", "/t", "a/B"),
        publish("/q", "/t", "a/B"),
        subscribe("/rosout", "/t", "a/B"),
        subscribe("/s", "/rosout_agg", "*"),
        call("subscribeParam", &["/s", &api("/s"), "/run_id"]),
        call(
            "registerService",
            &["/p", "/sv", "rosrpc://p:2", &api("/p")],
        ),
        set("/run_id", "old"),
        set("/gain", 1),
    ]);
    for (found, target) in [
        (&roscore, &other),
        (&other, &roscore),
        (&other, &Master::default()),
    ] {
        let mut wanted = target.snapshot();
        // rosmaster never forgets a topic type.
        for (topic, topic_type) in found.topic_types() {
            if !wanted.topic_types.contains_key(topic) {
                wanted.topic_types.insert(topic.clone(), topic_type.clone());
            }
        }
        let target = Master::from_snapshot(wanted).unwrap();
        let plan = Plan::replace(&target, found, &Token::new("m", 0), &token());
        let (master, notices) = run(&plan, found);
        assert_eq!(notices, []);
        assert_eq!(plan.skipped(), []);
        let expected = master.snapshot();
        let wanted = target.snapshot();
        assert_eq!(expected.nodes, wanted.nodes);
        assert_eq!(expected.publishers, wanted.publishers);
        assert_eq!(expected.subscribers, wanted.subscribers);
        assert_eq!(expected.services, wanted.services);
        assert_eq!(expected.param_subscribers, wanted.param_subscribers);
        assert_eq!(expected.params, wanted.params);
    }
}

#[test]
fn tokens_are_not_restored() {
    let mut master = after([publish("/p", "/t", "a/B")]);
    let bare = master.clone();
    master.apply(&Token::new("old", 1).set_calls()[0]);
    let plan = Plan::new(&master, &Master::default(), &token());
    assert_eq!(run(&plan, &Master::default()).0, bare);
    assert_eq!(plan.skipped(), []);
}

/// A roscore that another program has restarted, with a `/rosout` of its own.
fn roscore() -> Master {
    after([
        set("/run_id", "new"),
        set("/rosversion", "1.17"),
        call(
            "registerSubscriber",
            &["/rosout", "/rosout", "rosgraph_msgs/Log", "http://new"],
        ),
        call(
            "registerPublisher",
            &["/rosout", "/rosout_agg", "rosgraph_msgs/Log", "http://new"],
        ),
        call(
            "registerService",
            &[
                "/rosout",
                "/rosout/get_loggers",
                "rosrpc://new",
                "http://new",
            ],
        ),
    ])
}

#[test]
fn the_state_of_a_new_master_stays_and_no_node_is_shut_down() {
    let nodes = ["/a", "/b", "/c"];
    let mut target = after([
        set("/run_id", "old"),
        set("/mine", 1),
        subscribe("/rosout", "/rosout", "rosgraph_msgs/Log"),
        provide("/rosout", "/rosout/get_loggers"),
    ]);
    for node in nodes {
        target.apply(&publish(node, "/rosout", "rosgraph_msgs/Log"));
    }
    let plan = Plan::new(&target, &roscore(), &token());
    let (master, notices) = run(&plan, &roscore());
    assert_eq!(master.api_of("/rosout"), Some("http://new"));
    assert!(matches!(plan.skipped(), [Skipped::Node { caller_id, .. }] if caller_id == "/rosout"));
    // The new subscriber gets one complete list, and nothing else is sent.
    let complete = Notice::PublisherUpdate {
        to: "http://new".to_owned(),
        topic: "/rosout".to_owned(),
        publishers: nodes.map(api).to_vec(),
    };
    assert_eq!(notices, [complete]);
    let params = tree([
        ("run_id", "old".into()),
        ("mine", 1.into()),
        ("rosversion", "1.17".into()),
    ]);
    assert_eq!(Value::Struct(master.params().clone()), params);
}

#[test]
fn registrations_that_the_master_already_has_are_not_repeated() {
    let target = after([
        publish("/p", "/t", "a/B"),
        subscribe("/s", "/t", "a/B"),
        provide("/p", "/srv"),
        watch("/s", "/k"),
        set("/k", 1),
    ]);
    let plan = Plan::new(&target, &target, &token());
    let (master, notices) = run(&plan, &target);
    assert_eq!((master, notices), (target, vec![]));
    for method in [
        "registerPublisher",
        "registerSubscriber",
        "registerService",
        "setParam",
    ] {
        assert_eq!(count(&plan, method), 0, "{method}");
    }
}

#[test]
fn a_service_keeps_the_provider_that_it_has_in_the_new_master() {
    let target = after([provide("/lost", "/s"), provide("/old", "/s")]);
    let found = after([provide("/new", "/s")]);
    let plan = Plan::new(&target, &found, &token());
    assert_eq!(run(&plan, &found).0, found);
    assert!(matches!(
        plan.skipped(),
        [Skipped::Service { .. }, Skipped::Reference { .. }]
    ));
}

#[test]
fn parameters_are_merged_namespace_by_namespace() {
    let target = after([
        set("/ns/ours", 1),
        set("/both", 1),
        set("/ns/clash", tree([("x", 1.into())])),
    ]);
    let found = after([set("/ns/theirs", 2), set("/both", 2), set("/ns/clash", 2)]);
    let (master, _) = run(&Plan::new(&target, &found, &token()), &found);
    let ns = tree([
        ("ours", 1.into()),
        ("clash", tree([("x", 1.into())])),
        ("theirs", 2.into()),
    ]);
    let expected = tree([("ns", ns), ("both", 1.into())]);
    assert_eq!(Value::Struct(master.params().clone()), expected);
}

#[test]
fn verification_finds_every_kind_of_deviation_and_shows_no_values() {
    let target = after([publish("/p", "/t", "a/B"), set("/secret", "s3cret")]);
    let plan = Plan::new(&target, &Master::default(), &token());
    let mut other = after([publish("/q", "/t", "a/B")]);
    let deviation = plan.verify(&other.apply(&sent(&plan)).reply).unwrap_err();
    assert_eq!(deviation.failed, Vec::<String>::new());
    let text = deviation.changed.concat();
    assert!(
        text.contains("getSystemState") && !text.contains("s3cret"),
        "{text}"
    );
    let fault = |text: &str| Reply::Fault {
        code: 1,
        text: text.to_owned(),
    };
    let failed = plan.verify(&fault("boom")).unwrap_err().failed;
    assert!(failed[0].ends_with("answered with boom"));
    let raced = fault("<class 'RuntimeError'>:dictionary changed size during iteration");
    assert!(plan.verify(&raced).unwrap_err().failed.is_empty());
    assert!(plan.verify(&Reply::Value(Value::Array(vec![]))).is_err());
}

#[test]
fn the_answer_of_another_master_than_the_late_one_differs_beyond_parameters() {
    let behind = after([publish("/p", "/t", "a/B"), set("/a", 1)]);
    let writes = vec![subscribe("/s", "/t", "a/B"), set("/b", 2)];
    let plan = Plan::run(&behind, writes, &Token::new("m", 0), &token());
    let deviation =
        |mut master: Master| plan.verify(&master.apply(&sent(&plan)).reply).unwrap_err();
    let mut changed = behind.clone();
    changed.apply(&set("/direct", 3));
    let differs = deviation(changed);
    assert!(
        differs.failed.is_empty() && !differs.beyond_params,
        "{differs:?}"
    );
    assert!(deviation(Master::default()).beyond_params);
    assert!(deviation(after([set("/a", 1)])).beyond_params);
}

/// The topic was used only while the master did not answer.
#[test]
fn a_type_without_nodes_keeps_its_place_in_a_master_that_is_emptied_first() {
    let mut target = after([
        publish("/p", "/old", "a/B"),
        publish("/p", "/gone", "a/B"),
        publish("/p", "/new", "a/B"),
    ]);
    target.apply(&call("unregisterPublisher", &["/p", "/gone", &api("/p")]));
    let held = after([publish("/p", "/old", "a/B")]);
    let plan = Plan::replace(&target, &held, &Token::new("m", 0), &token());
    assert_eq!(plan.expected(), &target);
}

/// The topics were registered with another type while the master did not answer.
#[test]
fn a_changed_type_is_corrected_in_a_master_that_is_emptied_first() {
    let before = [
        publish("/p", "/published", "a/B"),
        publish("/p", "/subscribed", "a/B"),
        publish("/p", "/gone", "a/B"),
        subscribe("/s", "/subscribed", "a/B"),
    ];
    let held = after(before.clone());
    let mut target = after(before);
    for topic in ["/published", "/subscribed", "/gone"] {
        target.apply(&publish("/p", topic, "a/C"));
    }
    for topic in ["/subscribed", "/gone"] {
        target.apply(&call("unregisterPublisher", &["/p", topic, &api("/p")]));
    }
    let plan = Plan::replace(&target, &held, &Token::new("m", 0), &token());
    assert_eq!(plan.expected(), &target);
    assert_eq!(run(&plan, &held).1, []);
}

#[test]
fn an_answer_with_another_text_counts_as_predicted() {
    // Some members have slashes in their names, and a node subscribes to one of them.
    let target = after([set("/k", tree([("x/y", 1.into())]))]);
    let found = after([watch("/n", "/k/x/y")]);
    let plan = Plan::new(&target, &found, &token());
    let Reply::Value(mut results) = found.clone().apply(&sent(&plan)).reply else {
        panic!("no results")
    };
    let answer = |results: &mut Value, entry: usize, at: usize, to: Value| {
        let Value::Array(results) = results else {
            return;
        };
        let Value::Array(one) = &mut results[entry] else {
            return;
        };
        let Value::Array(answer) = &mut one[0] else {
            return;
        };
        answer[at] = to;
    };
    // The first entry shows what the `setParam` overwrites.
    answer(&mut results, 1, 1, "Internal failure: 'x'".into());
    // A vendor's patched master.
    answer(&mut results, 0, 1, "here it is".into());
    let reply = Reply::Value(results.clone());
    assert_eq!(plan.verify(&reply), Ok(()));
    assert_eq!(plan.verify_in_any_order(&reply), Ok(()));
    let mut overwritten = results.clone();
    answer(&mut overwritten, 0, 2, 1.into());
    assert!(plan.verify(&Reply::Value(overwritten)).is_err());
    answer(&mut results, 1, 0, 1.into());
    assert!(plan.verify(&Reply::Value(results)).is_err());
}

#[test]
fn differences_are_described_without_parameter_values() {
    let a = after([
        publish("/p", "/t", "a/B"),
        set("/k", "s3cret"),
        provide("/p", "/s"),
    ]);
    let b = after([publish("/q", "/t", "a/C"), set("/k", "other"), set("/l", 1)]);
    let words = difference(&a, &b);
    assert!(
        words
            .iter()
            .any(|words| words.contains("`/k` has another value")),
        "{words:?}"
    );
    assert!(words.iter().all(|words| !words.contains("s3cret")));
    assert_eq!(difference(&a, &a), Vec::<String>::new());
    let many = after((0..100).map(|i| set(&format!("/p{i}"), 1)));
    assert_eq!(difference(&many, &a).len(), 20);
}

#[test]
fn the_type_star_is_left_out_if_subscribers_would_be_notified_of_a_helper() {
    let mut target = after([publish("/p", "/star", "*"), publish("/p", "/t", "a/B")]);
    target.apply(&call("unregisterPublisher", &["/p", "/star", &api("/p")]));
    let found = after([subscribe("/s", "/star", "*")]);
    let plan = Plan::new(&target, &found, &token());
    let (_, notices) = run(&plan, &found);
    assert_eq!(notices, []);
    let topic = "/star".to_owned();
    assert_eq!(plan.skipped(), [Skipped::Type { topic }]);
}

#[test]
fn a_helper_never_takes_the_name_of_a_node() {
    // Only `/o d` itself can name this topic, as `~`. A helper with that name would displace the node.
    let mut target = after([publish("/o d", "/t", "a/B"), subscribe("/o d", "~", "a/B")]);
    target.apply(&call("unregisterSubscriber", &["/o d", "~", &api("/o d")]));
    let plan = Plan::new(&target, &Master::default(), &token());
    let (master, notices) = run(&plan, &Master::default());
    assert_eq!(
        (master.publishers_of("/t"), notices),
        (vec![api("/o d")], vec![])
    );
    assert!(matches!(plan.skipped(), [Skipped::Unnameable { .. }]));
}

#[test]
fn a_restored_master_answers_as_one_that_once_had_a_service() {
    let gone = call("unregisterService", &["/s", "/add", "rosrpc://h/s"]);
    let mut before = after([
        provide("/s", "/add"),
        publish("/s", "/t", "a/B"),
        gone.clone(),
    ]);
    let plan = restores(&before);
    assert_eq!(count(&plan, "registerService"), 1);
    let (mut successor, _) = run(&plan, &Master::default());
    assert_eq!(successor.apply(&gone), before.apply(&gone));
    // The same holds when the restored master is restored again.
    let (mut successor, _) = run(&restores(&successor), &Master::default());
    assert_eq!(successor.apply(&gone), before.apply(&gone));
}

/// Runs `plan` on `master`. Right before the entry `moment`, another program makes `calls`. Returns the reply.
fn run_beside(plan: &Plan, master: &mut Master, moment: usize, calls: &[Request]) -> Reply {
    let sent = sent(plan);
    let entries = sent.calls();
    let mut results = Vec::new();
    for (index, entry) in entries.iter().enumerate() {
        if index == moment {
            for call in calls {
                master.apply(call);
            }
            // rosmaster encodes the answer of a `getParam` at the end, from the tree that it still holds.
            if let Some(before) = index.checked_sub(1)
                && *entries[before].method() == Method::GetParam
            {
                let Reply::Value(value) = master.apply(entries[before]).reply else {
                    panic!("a fault");
                };
                results[before] = Value::Array(vec![value]);
            }
        }
        let Reply::Value(value) = master.apply(entry).reply else {
            panic!("a fault");
        };
        results.push(Value::Array(vec![value]));
    }
    Reply::Value(Value::Array(results))
}

#[test]
fn nothing_is_lost_that_another_program_does_at_any_moment_of_an_injection() {
    let target = after([
        publish("/p", "/t", "a/B"),
        subscribe("/s", "/t", "a/B"),
        set("/ours", 1),
        set("/ns/ours", 1),
        set("/ns/x", tree([("a/b", 1.into())])),
        watch("/s", "/ns"),
    ]);
    let found = after([set("/found", 1), set("/gone", 1), set("/ns/clash", 1)]);
    let theirs = [
        set("/theirs", 2),
        set("/ns/theirs", 2),
        set("/found", 2),
        set("/ns/deep/theirs", 2),
        call("deleteParam", &["/n", "/gone"]),
        publish("/q", "/t", "a/B"),
    ];
    let replaced = |_: &Master| Plan::replace(&target, &found, &Token::new("m", 0), &token());
    let added = |found: &Master| Plan::new(&target, found, &token());
    let plans: [&dyn Fn(&Master) -> Plan; 2] = [&added, &replaced];
    for (number, plan) in plans.iter().enumerate() {
        let plan = plan(&found);
        let count = entries(&plan).len();
        let last_read = entries(&plan).iter().rposition(|name| name == "getParam");
        for moment in 0..=last_read.unwrap() {
            let mut master = found.clone();
            let reply = run_beside(&plan, &mut master, moment, &theirs);
            let deviation = plan.verify(&reply).expect_err("a difference");
            assert_eq!(deviation.failed, Vec::<String>::new());
            for call in token().set_calls() {
                let params = call.params().to_vec();
                master.apply(&Request::new(Method::UnsubscribeParam, params));
            }
            let wanted = plan.remaining(&target, &found, &deviation, &master);
            let repair = Plan::repair(&wanted, &master, &token());
            let (master, _) = run(&repair, &master);
            let when = format!("plan {number}, moment {moment} of {count}");
            for (key, value) in [
                ("/ours", Some(1)),
                ("/ns/ours", Some(1)),
                ("/theirs", Some(2)),
                ("/ns/theirs", Some(2)),
                ("/ns/deep/theirs", Some(2)),
                ("/found", Some(2)),
                ("/gone", None),
            ] {
                let value = value.map(Value::Int);
                assert_eq!(master.param(key), value, "{key}, {when}");
            }
            let topics = |node| master.subscriptions(node).collect::<Vec<_>>();
            assert_eq!(topics("/s"), ["/t"], "{when}");
            let publishers = &master.registry().publishers;
            assert!(
                publishers.get("/t").unwrap().contains(&"/p".to_owned()),
                "{when}"
            );
        }
    }
}

/// A random write of one of a few nodes, some of which have two addresses.
fn random_write(dice: &mut Dice) -> Request {
    let node = format!("/n{}", dice.below(5));
    let api = format!("http://h:{}{}/", &node[2..], dice.below(9) / 8);
    let (topic, key) = (
        format!("/t{}", dice.below(4)),
        format!("/p{}", dice.below(3)),
    );
    let topic_type = ["a/B", "c/D", "*"][usize::try_from(dice.below(3)).unwrap()];
    let strings = |method: &str, params: &[&str]| call(method, params);
    match dice.below(10) {
        0..3 => strings("registerPublisher", &[&node, &topic, topic_type, &api]),
        3 | 4 => strings("registerSubscriber", &[&node, &topic, topic_type, &api]),
        5 => strings("unregisterPublisher", &[&node, &topic, &api]),
        6 => strings("unregisterSubscriber", &[&node, &topic, &api]),
        7 => strings(
            "registerService",
            &[&node, &topic, &format!("rosrpc://{node}"), &api],
        ),
        8 => strings("subscribeParam", &[&node, &api, &key]),
        _ => set(&key, i32::try_from(dice.below(3)).unwrap()),
    }
}

#[test]
fn a_state_follows_another_without_any_callback() {
    let mut dice = Dice(7);
    let mut small = 0;
    for round in 0..1_000 {
        let mut found = Master::default();
        for _ in 0..dice.below(30) {
            found.apply(&random_write(&mut dice));
        }
        let mut target = found.clone();
        for _ in 0..dice.below(8) {
            target.apply(&random_write(&mut dice));
        }
        let before = Token::new("m", 0);
        let mut master = found.clone();
        for call in before.set_calls() {
            master.apply(&call);
        }
        let plan = Plan::update(&target, &found, &before, &token());
        let outcome = master.apply(&sent(&plan));
        assert_eq!(plan.verify(&outcome.reply), Ok(()));
        // No node is at the address of tokens and helpers.
        let to_node = |notice: &Notice| match notice {
            Notice::PublisherUpdate { to, .. }
            | Notice::ParamUpdate { to, .. }
            | Notice::Shutdown { to, .. } => !to.starts_with("rosrpc://rosrescue"),
        };
        let notices: Vec<_> = outcome.notices.into_iter().filter(to_node).collect();
        assert_eq!(notices, [], "round {round}");
        assert_eq!(plan.expected(), &target, "round {round}");
        small += u32::from(count(&plan, "getSystemState") == 0);
        assert!(Token::is_found(&master.apply(&token().lookup()).reply));
        assert!(!Token::is_found(&master.apply(&before.lookup()).reply));
    }
    println!("{small} plans change only what differs");
    assert!(small > 900);
}
