//! A real rosmaster that dies again and again: the rate of restarts is bounded, the status says so, a
//! record that kills is found and set aside and nothing else ever is, and when the cause is gone the
//! state is whole.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

mod support;

use std::fs;
use std::thread;
use std::time::{Duration, Instant};

use rosrescue::xmlrpc::Value;
use support::{
    Client, FakeNode, Heard, Rescue, SICK_ROSMASTER, Scratch, Setup, Sickness, State, eventually,
    free_port, holds, http_request, page, params, signal, status, tree,
};

/// rosrescue core with a rosmaster that can be made to die, and a state.
struct Patient {
    rescue: Rescue,
    master_port: u16,
    sickness: Sickness,
    nodes: Vec<FakeNode>,
    before: State,
    #[allow(dead_code, reason = "its drop ends everything")]
    scratch: Scratch,
}

impl Patient {
    fn new(options: &[&str]) -> Self {
        let scratch = Scratch::new();
        let sickness = Sickness::new(&scratch);
        let master_port = free_port();
        let rescue = Setup::core(&scratch, master_port)
            .args(["--no-rosout", "--rosmaster", SICK_ROSMASTER])
            .args(options)
            .env("SICK", &sickness.file)
            .start();
        let client = rescue.client();
        let nodes: Vec<_> = (0..3)
            .map(|i| FakeNode::start(&format!("/node{i}")))
            .collect();
        for (i, node) in nodes.iter().enumerate() {
            node.publish(&client, "/camera", "std_msgs/String");
            node.publish(&client, &format!("/topic{i}"), "std_msgs/UInt64");
            node.subscribe(&client, "/camera", "std_msgs/String");
            if i == 0 {
                node.subscribe(&client, "/nobody", "std_msgs/Bool");
            }
            node.offer(&client, &format!("/service{i}"));
            node.watch_param(&client, "/robot");
        }
        let arm = tree! { "gain" => 1.5, "limits" => tree! { "low" => -1, "high" => 1 } };
        client.set_param("/robot", tree! { "name" => "r2", "arm" => arm });
        client.set_param("/other", vec![Value::from(1), Value::from("two")]);
        eventually("the parameters of core are set", || {
            ["/rosversion", "/rosdistro", "/run_id"]
                .iter()
                .all(|key| client.param(key).is_some())
        });
        let before = State::read(&Client::new(master_port));
        Self {
            rescue,
            master_port,
            sickness,
            nodes,
            before,
            scratch,
        }
    }

    fn client(&self) -> Client {
        self.rescue.client()
    }

    fn state(&self) -> Option<State> {
        State::try_read(&Client::new(self.master_port)).ok()
    }

    fn kill_master(&self) {
        let pid = Client::new(self.master_port).master_pid().unwrap();
        signal(pid, rustix::process::Signal::KILL);
    }

    /// Makes masters die of this, beginning with the next, which begins now.
    fn fall_ill(&self, lines: &str) {
        self.sickness.set(lines);
        self.kill_master();
    }

    #[track_caller]
    fn await_crash_loop(&self, crash_loop: bool) {
        let client = self.client();
        eventually(&format!("the status says crash_loop: {crash_loop}"), || {
            status(&client)["crash_loop"] == crash_loop
        });
        let metric = format!("\nrosrescue_crash_loop {}\n", u8::from(crash_loop));
        assert!(page(&client, "/metrics").contains(&metric));
        let word = page(&client, "/").contains("crash loop");
        assert_eq!(word, crash_loop);
    }

    /// Waits until the real master's state is `wanted` and calls pass.
    #[track_caller]
    fn await_state(&self, wanted: &State, when: &str) {
        let client = self.client();
        let start = Instant::now();
        loop {
            let open = status(&client)["open"] == true;
            match self.state() {
                Some(now) if open && now == *wanted => return,
                Some(now) if start.elapsed() > support::PATIENCE => wanted.assert_same(&now, when),
                _ => assert!(start.elapsed() <= support::PATIENCE, "no master {when}"),
            }
            thread::sleep(Duration::from_millis(20));
        }
    }

    fn set_aside(&self) -> Vec<String> {
        let status = status(&self.client());
        let names = status["set_aside"].as_array().unwrap().iter();
        names
            .map(|name| name.as_str().unwrap().to_owned())
            .collect()
    }

    /// How many calls each node has got, once all that was to be told has been told.
    fn heard(&self) -> Vec<usize> {
        let heard = || {
            let nodes = self.nodes.iter();
            nodes.map(|node| node.calls().len()).collect::<Vec<_>>()
        };
        eventually("what was still to be told has been told", || {
            let before = heard();
            holds(Duration::from_millis(500), || heard() == before)
        });
        heard()
    }

    /// Panics if a master has called a node since it had `heard` so much, or rosrescue has told a node
    /// anything but how things are and were before.
    #[track_caller]
    fn assert_nobody_disturbed(&self, heard: &[usize]) {
        for (node, heard) in self.nodes.iter().zip(heard) {
            let calls = node.calls();
            let (before, since) = calls.split_at(*heard);
            let told: Vec<_> = since.iter().filter(|call| !is_question(call)).collect();
            assert!(told.iter().all(|call| call.from_rosrescue), "{told:?}");
            for call in told {
                let mut earlier = before.iter().rev().filter(|it| it.method == call.method);
                let earlier = earlier.find(|it| it.params[1] == call.params[1]);
                let earlier = earlier.map(|it| &it.params);
                // What nobody has told before is what `registerSubscriber` answered.
                assert!(earlier.is_none_or(|it| *it == call.params), "{call:?}");
            }
        }
    }

    /// The files of what was set aside.
    fn kept(&self) -> Vec<String> {
        let folder = self.rescue.checkpoint().parent().unwrap().to_owned();
        let files = fs::read_dir(folder).unwrap().flatten();
        files
            .filter(|file| file.file_name().to_string_lossy().contains(".set-aside-"))
            .map(|file| fs::read_to_string(file.path()).unwrap())
            .collect()
    }
}

/// Whether it is what the census asks.
fn is_question(call: &Heard) -> bool {
    ["getPid", "getPublications", "getSubscriptions"].contains(&call.method.as_str())
}

#[test]
fn a_master_that_dies_at_once() {
    let mut patient = Patient::new(&["--hold", "40"]);
    let before = patient.sickness.starts().len();
    patient.fall_ill("at once");
    patient.await_crash_loop(true);
    // Reads are answered all the while.
    assert_eq!(patient.client().param("/robot/name"), Some("r2".into()));
    let setters: Vec<_> = (0..4)
        .map(|i| {
            let parked = || status(&patient.client())["counters"]["parked"].as_u64();
            let (client, before) = (patient.client(), parked());
            let setter = thread::spawn(move || client.set_param("/last", i));
            // Sent one after the other, so that there is an order.
            eventually("the call is parked", || parked() > before);
            setter
        })
        .collect();
    assert!(holds(Duration::from_secs(6), || setters
        .iter()
        .all(|setter| !setter.is_finished())));
    // Five at once, then after 0.5, 1, 2, 4 and 8 s.
    let starts = patient.sickness.starts().split_off(before);
    let first_ten = starts.iter().filter(|at| **at - starts[0] < 10.0).count();
    assert!((6..=10).contains(&first_ten), "{starts:?}");
    patient.sickness.cure();
    for setter in setters {
        setter.join().unwrap();
    }
    assert_eq!(patient.client().param("/last"), Some(3.into()));
    patient
        .client()
        .ok("deleteParam", params!["/test", "/last"]);
    patient.await_state(&patient.before, "after the crash loop");
    assert_eq!(
        status(&patient.client())["crash_loop"],
        true,
        "not yet over"
    );
    patient.await_crash_loop(false);
    assert_eq!(patient.set_aside(), Vec::<String>::new());
    patient.rescue.wait_line("the crash loop", |line| {
        line.contains("crash loop: the master has died")
    });
    patient
        .rescue
        .wait_line("its end", |line| line.contains("the crash loop is over"));
}

#[test]
fn a_master_that_dies_after_two_seconds() {
    let patient = Patient::new(&["--hold", "1"]);
    let client = patient.client();
    let body = support::encode_call("setParam", params!["/test", "/late", 1]);
    patient.fall_ill("after 2");
    patient.await_crash_loop(true);
    // Between two deaths it is whole, and yet it is a crash loop.
    eventually("a master serves in between", || {
        let status = status(&client);
        status["open"] == true && status["crash_loop"] == true
    });
    // In the longer pauses calls are held for as long as they should be, and not answered falsely.
    eventually("a call is given back when its time is over", || {
        let start = Instant::now();
        let given_back = client.exchange(&http_request(&body)).is_err();
        assert!(
            start.elapsed() < Duration::from_secs(20),
            "{:?}",
            start.elapsed()
        );
        given_back
    });
    patient.sickness.cure();
    patient.await_crash_loop(false);
    client.set_param("/late", 1);
    client.ok("deleteParam", params!["/test", "/late"]);
    patient.await_state(&patient.before, "after the crash loop");
    assert_eq!(patient.set_aside(), Vec::<String>::new());
}

/// It would live if it were left alone; the first thing that it is given kills it.
#[test]
fn a_master_that_dies_only_when_it_is_given_the_state() {
    let patient = Patient::new(&[]);
    patient.fall_ill("registration 1");
    patient.await_crash_loop(true);
    eventually("more masters have died", || {
        patient.sickness.deaths().len() >= 9
    });
    assert_eq!(patient.set_aside(), Vec::<String>::new());
    patient.sickness.cure();
    patient.await_state(&patient.before, "after the crash loop");
    assert_eq!(patient.set_aside(), Vec::<String>::new());
    assert_eq!(patient.kept(), Vec::<String>::new());
}

#[test]
fn five_deaths_in_a_row_during_recovery() {
    for sickness in ["registration 7", "registration 14", "call 12", "call 21"] {
        let patient = Patient::new(&[]);
        let heard = patient.heard();
        let call = {
            let client = patient.client();
            move || client.status("setParam", params!["/test", "/held", 1])
        };
        patient.fall_ill(&format!("{sickness}\ntimes 5"));
        let held = thread::spawn(call);
        assert_eq!(held.join().unwrap().expect("the call is answered").0, 1);
        patient
            .client()
            .ok("deleteParam", params!["/test", "/held"]);
        patient.await_state(&patient.before, &format!("after five deaths ({sickness})"));
        assert_eq!(patient.sickness.deaths().len(), 5);
        assert_eq!(patient.set_aside(), Vec::<String>::new());
        patient.assert_nobody_disturbed(&heard);
    }
}

#[test]
fn a_master_that_hangs_while_it_is_given_the_state() {
    let probes = ["--probe-interval", "100", "--probe-timeout", "500"];
    let patient = Patient::new(&probes);
    patient.fall_ill("hang 9\ntimes 1");
    let begin = Instant::now();
    // It is not replaced only when a whole injection takes too long.
    let soon = Duration::from_secs(20);
    eventually("a master hangs", || patient.sickness.deaths().len() == 1);
    eventually("another one serves", || {
        status(&patient.client())["open"] == true
    });
    assert!(begin.elapsed() < soon, "{:?}", begin.elapsed());
    patient.await_state(&patient.before, "after a hang");
}

#[test]
fn a_parameter_that_kills() {
    let mut patient = Patient::new(&[]);
    let client = patient.client();
    patient.fall_ill("name /robot/arm/gain");
    let mut after = patient.before.clone();
    if let Value::Struct(tree) = &mut after.params
        && let Some(Value::Struct(robot)) = tree.get_mut("robot")
        && let Some(Value::Struct(arm)) = robot.get_mut("arm")
    {
        assert_eq!(arm.shift_remove("gain"), Some(1.5.into()));
    }
    after.param_names.retain(|name| name != "/robot/arm/gain");
    patient.await_state(&after, "without the parameter that kills");
    assert_eq!(
        patient.sickness.deaths().len(),
        4,
        "{:?}",
        patient.sickness.deaths()
    );
    let name = "the parameter `/robot/arm/gain`";
    assert_eq!(patient.set_aside(), [name]);
    let report = &status(&client)["last_recovery"];
    assert_eq!(report["set_aside"][0], name);
    assert!(page(&client, "/metrics").contains("\nrosrescue_set_aside 1\n"));
    patient.rescue.wait_line("what is set aside", |line| {
        line.contains("set aside: the parameter")
    });
    let kept = patient.kept();
    assert_eq!(kept.len(), 1);
    let line = r#"call: "setParam", params: ["/rosrescue", "/robot/arm/gain", 1.5]"#;
    assert!(kept[0].contains(line), "{}", kept[0]);

    // It is not injected again, neither by this rosrescue nor by the next.
    patient.kill_master();
    eventually("the next master is there", || {
        status(&client)["recoveries"] == 3
    });
    patient.await_state(&after, "after another crash");
    let pid = client.master_pid().unwrap();
    patient.rescue.kill();
    signal(pid, rustix::process::Signal::KILL);
    patient.rescue.start_again();
    patient.rescue.wait_serving();
    patient.await_state(&after, "after a crash of both");
    assert_eq!(
        patient.sickness.deaths().len(),
        4,
        "{:?}",
        patient.sickness.deaths()
    );

    // Whoever sets it again makes a call like any other.
    patient.sickness.cure();
    patient.kill_master();
    client.set_param("/robot/arm/gain", 2.5);
    patient.kill_master();
    eventually("it is there again", || {
        Client::new(patient.master_port).param("/robot/arm/gain") == Some(2.5.into())
    });
}

#[test]
fn registrations_that_kill() {
    let cases: [(&str, &[&str]); 3] = [
        ("/service1", &["the service `/service1` of `/node1`"]),
        // The type of the topic goes with who would bring it.
        ("/topic0", &["the publisher `/node0` of `/topic0`"]),
        (
            "/nobody",
            &[
                "the subscriber `/node0` of `/nobody`",
                // It comes before its turn, for the order of the types.
                "the type of the topic `/nobody`",
            ],
        ),
    ];
    for (name, records) in cases {
        let patient = Patient::new(&[]);
        patient.fall_ill(&format!("name {name}"));
        let mut after = patient.before.clone();
        after.publishers.retain(|(topic, _)| topic != name);
        after.subscribers.retain(|(topic, _)| topic != name);
        after.services.retain(|(service, _)| service != name);
        after.service_apis.retain(|(service, _)| service != name);
        after.topic_types.retain(|(topic, _)| topic != name);
        patient.await_state(&after, &format!("without {name}"));
        let mut set_aside = patient.set_aside();
        set_aside.sort();
        assert_eq!(set_aside, records);
        let deaths = patient.sickness.deaths();
        assert_eq!(deaths.len(), 2 + 2 * records.len(), "{deaths:?}");
        assert_eq!(patient.kept().len(), 1);
        assert!(
            patient
                .nodes
                .iter()
                .all(|node| node.heard("shutdown").is_empty())
        );
    }
}
