//! A real rosmaster that dies again and again causes no outage: the mirror answers all the time, restarts are
//! limited, the status reports it, and the state is complete when the cause is gone.

use std::ops::{Deref, DerefMut};
use std::thread;
use std::time::{Duration, Instant};

use ros1_master::xmlrpc::Value;

use crate::support::{
    Failing, FakeNode, ReceivedCall, State, eventually, holds, page, params, status, tree,
    unreadable, within,
};

/// Maximum time for a call on a busy computer.
const SOON: Duration = Duration::from_secs(5);

/// rosrescue core with some state and a rosmaster that can be made to fail.
struct Robot {
    failing: Failing,
    nodes: Vec<FakeNode>,
    before: State,
}

impl Deref for Robot {
    type Target = Failing;

    fn deref(&self) -> &Failing {
        &self.failing
    }
}

impl DerefMut for Robot {
    fn deref_mut(&mut self) -> &mut Failing {
        &mut self.failing
    }
}

impl Robot {
    fn new(options: &[&str]) -> Self {
        let failing = Failing::core(options);
        let client = failing.client();
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
        Self {
            before: failing.state(),
            failing,
            nodes,
        }
    }

    /// Makes masters die for the reasons in `lines`, beginning with the next one, and kills the present one.
    fn fail_with(&self, lines: &str) {
        self.failures.set(lines);
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

    /// Waits until the real master's state is `wanted` and calls pass to it.
    #[track_caller]
    fn await_state(&self, wanted: &State, when: &str) {
        let client = self.client();
        let start = Instant::now();
        loop {
            let open = status(&client)["open"] == true;
            match State::try_read(&self.bare()).ok() {
                Some(now) if open && now == *wanted => return,
                Some(now) if start.elapsed() > crate::support::PATIENCE => {
                    wanted.assert_same(&now, when)
                }
                _ => assert!(
                    start.elapsed() <= crate::support::PATIENCE,
                    "no master {when}"
                ),
            }
            thread::sleep(Duration::from_millis(20));
        }
    }

    /// Number of calls that each node has received, once all pending notifications have been sent.
    fn questions(&self) -> Vec<usize> {
        let counts = || {
            let nodes = self.nodes.iter();
            nodes.map(|node| node.calls().len()).collect::<Vec<_>>()
        };
        eventually("all pending notifications have been sent", || {
            let before = counts();
            holds(Duration::from_secs(3), || counts() == before)
        });
        counts()
    }

    /// Panics if a master has called a node after its first `counts` calls, or if rosrescue has sent a node anything but
    /// the present state, which has not changed.
    #[track_caller]
    fn assert_no_node_disturbed(&self, counts: &[usize]) {
        for (node, counts) in self.nodes.iter().zip(counts) {
            let calls = node.calls();
            let (before, since) = calls.split_at(*counts);
            let told: Vec<_> = since.iter().filter(|call| !is_question(call)).collect();
            assert!(told.iter().all(|call| call.from_rosrescue), "{told:?}");
            for call in told {
                let mut earlier = before.iter().rev().filter(|it| it.method == call.method);
                let earlier = earlier.find(|it| it.params[1] == call.params[1]);
                let earlier = earlier.map(|it| &it.params);
                // The list may also be the one that the answer to `registerSubscriber` contained.
                assert!(earlier.is_none_or(|it| *it == call.params), "{call:?}");
            }
        }
    }
}

/// Whether the call belongs to the health check.
fn is_question(call: &ReceivedCall) -> bool {
    ["getPid", "getPublications", "getSubscriptions"].contains(&call.method.as_str())
}

#[test]
fn calls_are_answered_while_every_master_dies_at_once() {
    let mut robot = Robot::new(&["--hold", "1"]);
    let before = robot.failures.starts().len();
    robot.fail_with("at once");
    robot.await_crash_loop(true);
    // Reads are answered all the time.
    assert_eq!(robot.client().param("/robot/name"), Some("r2".into()));
    // Writes are answered too.
    for i in 0..50 {
        within(SOON, "a write", || robot.client().set_param("/last", i));
        thread::sleep(Duration::from_millis(100));
    }
    // Only calls that the mirror does not understand are affected: they are held until their time limit, and never
    // answered wrongly.
    within(Duration::from_secs(20), "a held call", || {
        let answer = robot.client().exchange(&unreadable("/late", 0));
        assert!(answer.is_err(), "{answer:?}");
    });
    // Five restarts at once, then after pauses of 0.5, 1, 2, 4 and 8 s.
    let starts = || robot.failures.starts().split_off(before);
    eventually("the first pauses are over", || starts().len() > 6);
    let starts = starts();
    let first_ten = starts.iter().filter(|at| **at - starts[0] < 10.0).count();
    assert!(first_ten <= 10, "{starts:?}");
    robot.failures.clear();
    assert_eq!(robot.client().param("/last"), Some(49.into()));
    robot.client().ok("deleteParam", params!["/test", "/last"]);
    robot.await_state(&robot.before, "after the crash loop");
    assert_eq!(
        status(&robot.client())["crash_loop"],
        true,
        "the crash loop is not over yet"
    );
    robot.await_crash_loop(false);
    robot
        .rescue
        .wait_line("the log reports the crash loop", |line| {
            line.contains("crash loop: the master has died")
        });
    robot.rescue.wait_line("the log reports its end", |line| {
        line.contains("the crash loop is over")
    });
}

#[test]
fn a_master_that_hangs_during_the_injection_is_replaced() {
    let probes = ["--probe-interval", "100", "--probe-timeout", "500"];
    let robot = Robot::new(&probes);
    robot.fail_with("hang 9\ntimes 1");
    // rosrescue must not wait until a whole injection would take too long, which is after 60 s. On a busy computer two
    // starts take long.
    within(Duration::from_secs(50), "the replacement", || {
        eventually("a master hangs", || robot.failures.deaths().len() == 1);
        eventually("another one serves", || {
            status(&robot.client())["open"] == true
        });
    });
    robot.await_state(&robot.before, "after a hang");
}

/// Records that kill every master that gets them. No node notices this, and it ends when a client removes the last one.
#[test]
fn records_that_kill_masters_cause_no_outage() {
    let robot = Robot::new(&[]);
    let client = robot.client();
    let questions = robot.questions();
    robot.fail_with("name /robot/arm/gain\nname /topic0");
    // If masters start slowly, their deaths are no crash loop.
    eventually("several masters have died", || {
        robot.failures.deaths().len() >= 3
    });
    let away = |state: &State| state.assert_same(&State::read(&client), "in the mirror");
    away(&robot.before);
    client.set_param("/while/it/dies", 1);
    client.ok("deleteParam", params!["/test", "/while"]);
    robot.assert_no_node_disturbed(&questions);
    robot.nodes[0].unpublish(&client, "/topic0");
    let after = robot.before.without_publisher("/topic0", "/node0");
    away(&after);
    // The topic keeps its type, which is also a record.
    robot.failures.set("name /robot/arm/gain");
    client.ok("deleteParam", params!["/test", "/robot/arm/gain"]);
    let after = after.with_params_of(&State::read(&client));
    away(&after);
    robot.await_state(&after, "after the records were removed");
    robot.rescue.assert_no_panic();
    let mut nodes = robot.nodes.iter();
    assert!(nodes.all(|node| node.received("shutdown").is_empty()));
}
