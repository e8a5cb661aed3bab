//! The paper's case 2 at five points: the master dies after it has changed its state, before or while it notifies the
//! subscribers. rosrescue then sends the full list to all of them, once or twice.

use std::thread;
use std::time::Instant;

use rescue_core::order::RECENT;
use ros1_master::xmlrpc::Value;

use crate::support::{
    FakeNode, Library, Mode, Node, ReceivedCall, Robot, eventually, in_both_modes, status,
};

const TOPIC: &str = "/chatter";

/// The change during which the master dies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Change {
    Registration,
    /// A publisher unregisters, as in the paper.
    Unregistration,
}

/// The subscribers: four fake nodes and a real node of each library, so there are six callbacks.
struct Audience {
    fakes: Vec<FakeNode>,
    real: [Node; 2],
}

impl Audience {
    fn start(robot: &Robot) -> Self {
        let client = robot.client();
        let fakes = (0..4).map(|i| FakeNode::start(&format!("/subscriber{i}")));
        let fakes: Vec<_> = fakes.collect();
        for fake in &fakes {
            fake.subscribe(&client, TOPIC, "std_msgs/String");
        }
        let subscribed = Instant::now();
        let real = [Library::Rospy, Library::Roscpp]
            .map(|library| robot.node(library, "listener", &[&format!("__name:={library:?}")]));
        // A node is told a state once more if it has just been answered. rosrescue may note an answer after the node has
        // it, so the test waits twice as long.
        eventually("the answers to the subscribers are old", || {
            subscribed.elapsed() > 2 * RECENT
        });
        Self { fakes, real }
    }

    /// Whether the last list that each subscriber got is `all`.
    fn knows(&self, all: &[String]) -> bool {
        let fakes = self.fakes.iter().map(|fake| fake.updates(TOPIC));
        let real = self.real.iter().map(|node| node.updates(TOPIC));
        fakes.chain(real).all(|updates| match updates.last() {
            Some(last) => last == all,
            None => all.is_empty(),
        })
    }
}

/// The lists of publishers in `calls`, and whether each came from rosrescue.
fn lists(calls: &[ReceivedCall]) -> Vec<(Vec<&str>, bool)> {
    let updates = calls.iter().filter(|call| call.method == "publisherUpdate");
    let lists = updates.map(|call| {
        let uris = call.params[2].as_array().unwrap().iter();
        let uris = uris.map(|uri| uri.as_str().unwrap()).collect();
        (uris, call.from_rosrescue)
    });
    lists.collect()
}

/// The points at which the master dies: 0 is before any callback, N is when the Nth of the six callbacks is about to be
/// sent. A core restarts its master at once for only five deaths within a minute.
const POINTS: [usize; 5] = [0, 1, 3, 4, 6];

/// Makes the master die at each of [`POINTS`]. A core's master has more threads for callbacks than there are callbacks;
/// that of a proxy has three, as roscore has.
fn the_master_dies(mode: Mode, change: Change) {
    let workers = match mode {
        Mode::Core => "16",
        Mode::Proxy => "3",
    };
    let mut robot = Robot::start_under(mode, "fragile_master.py", &["-w", workers]);
    let client = robot.client();
    let audience = Audience::start(&robot);
    let names = POINTS.iter().map(|point| format!("/publisher{point}"));
    let mut coming: Vec<_> = names.map(|name| FakeNode::start(&name)).collect();
    let mut there = Vec::new();
    if change == Change::Unregistration {
        // When the last publisher leaves, the list is empty.
        for publisher in coming.drain(..) {
            publisher.publish(&client, TOPIC, "std_msgs/String");
            there.push(publisher);
        }
    }
    let mut gone = Vec::new();
    let all = |there: &[FakeNode]| {
        there
            .iter()
            .map(|node| node.api.clone())
            .collect::<Vec<_>>()
    };
    let mut once = 0;
    for point in POINTS {
        let before = all(&there);
        eventually(
            "all subscribers know the publishers before the change",
            || audience.knows(&before),
        );
        let heard: Vec<_> = audience.fakes.iter().map(|it| it.calls().len()).collect();
        let dead = robot.master_pid();
        let file = robot.scratch.path("die-at");
        std::fs::write(&file, format!("publisherUpdate {point}")).unwrap();
        let calling = thread::spawn({
            let client = client.clone();
            let publisher = coming.pop().or_else(|| there.pop()).unwrap();
            move || {
                match change {
                    Change::Registration => publisher.publish(&client, TOPIC, "std_msgs/String"),
                    Change::Unregistration => publisher.unpublish(&client, TOPIC),
                }
                publisher
            }
        });
        eventually(&format!("the master dies at point {point}"), || {
            !file.exists()
        });
        if mode == Mode::Proxy {
            robot.kill_master();
            robot.revive_master();
        }
        robot.await_recovery(dead);
        let publisher = calling.join().unwrap();
        match change {
            Change::Registration => there.push(publisher),
            Change::Unregistration => gone.push(publisher),
        }
        let now = all(&there);
        eventually(
            &format!("all subscribers know the publishers, point {point}"),
            || audience.knows(&now),
        );
        let mut check_ms = None;
        eventually("the recovery is complete", || {
            let status = status(&client);
            let report = &status["last_recovery"];
            check_ms = report["health_check_ms"].as_f64();
            report["master_pid"] != dead && check_ms.is_some()
        });
        // All calls that a fake node got because of this change.
        for (fake, heard) in audience.fakes.iter().zip(heard) {
            let calls = &fake.calls()[heard..];
            let mut lists = lists(calls);
            // The list before the change may be repeated first.
            let again = lists
                .iter()
                .take_while(|(list, ours)| *ours && *list == before);
            lists.drain(..again.count());
            let full = |(list, _): &&(Vec<&str>, bool)| *list == now;
            // No list may be incomplete, and none may be outdated.
            assert!(
                lists.iter().all(|list| full(&list)),
                "{lists:?}, not {now:?}"
            );
            let ours = lists.iter().filter(|(_, ours)| *ours).count();
            // One list may come from the master that died, and one from the next master if the call was sent again
            // because its reply was lost. A master sends each list once.
            assert!(lists.len() - ours <= 2, "{lists:?}");
            assert!(ours >= 1, "{lists:?}");
            // A node that has not answered 300 ms after the change may delay the master, so rosrescue notifies the
            // nodes again. Lists that the dead master may have sent at the same time are repeated too.
            if check_ms.is_some_and(|ms| ms < 250.0) {
                assert!(ours <= 2, "point {point}: {lists:?}");
                once += 1;
            }
        }
    }
    println!("{once} fake nodes were notified without a repeat");
    let nodes = audience.fakes.iter().chain(&there).chain(&gone);
    for node in nodes {
        assert_eq!(node.received("shutdown"), Vec::<Vec<Value>>::new());
    }
    drop(audience);
    robot.kill_master();
}

in_both_modes!(
    subscribers_hear_of_a_new_publisher_although_the_master_dies,
    subscribers_hear_that_a_publisher_left_although_the_master_dies
);

fn subscribers_hear_of_a_new_publisher_although_the_master_dies(mode: Mode) {
    the_master_dies(mode, Change::Registration);
}

/// This is the change in the paper.
fn subscribers_hear_that_a_publisher_left_although_the_master_dies(mode: Mode) {
    the_master_dies(mode, Change::Unregistration);
}
