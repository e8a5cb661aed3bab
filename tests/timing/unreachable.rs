//! Nodes that cannot be reached, because packets to them are dropped, delay no other node.

use std::time::{Duration, Instant};

use crate::support::{
    Client, Control, FakeNode, Library, Mode, Netns, Node, Robot, eventually, eventually_some,
    in_both_modes, names, params, status, within,
};

/// Number of unreachable nodes and of living fake nodes.
const UNREACHABLE: u8 = 20;
const LIVING: usize = 18;
/// Maximum time until a living subscriber knows a new publisher.
const SOON: Duration = Duration::from_secs(5);

/// The living nodes: fakes, and a real node of each library.
struct Living {
    fakes: Vec<FakeNode>,
    real: [Node; 2],
}

impl Living {
    fn start(robot: &Robot) -> Self {
        let client = robot.client();
        let fakes = (0..LIVING).map(|i| FakeNode::start(&format!("/living{i}")));
        let fakes: Vec<_> = fakes.collect();
        for fake in &fakes {
            fake.subscribe(&client, "/chatter", "std_msgs/String");
        }
        let real = [Library::Rospy, Library::Roscpp].map(|library| {
            let name = format!("__name:={}", format!("{library:?}").to_lowercase());
            robot.node(library, "listener", &[&name])
        });
        Self { fakes, real }
    }

    /// The time from the registration of `publisher` until each of these nodes knows it.
    #[track_caller]
    fn hear_of(&self, publisher: &FakeNode, client: &Client) -> Vec<Duration> {
        let start = Instant::now();
        publisher.publish(client, "/chatter", "std_msgs/String");
        let mut heard = vec![None; LIVING + 2];
        eventually("every living subscriber knows the publisher", || {
            for (i, heard) in heard.iter_mut().enumerate() {
                if heard.is_none() {
                    let updates = match i.checked_sub(LIVING) {
                        None => self.fakes[i].updates("/chatter"),
                        Some(real) => self.real[real].updates("/chatter"),
                    };
                    let knows = updates.iter().any(|list| list.contains(&publisher.api));
                    *heard = knows.then(|| start.elapsed());
                }
            }
            heard.iter().all(Option::is_some)
        });
        heard.into_iter().flatten().collect()
    }
}

/// Median and maximum in milliseconds.
fn summary(times: &[Duration]) -> (f64, f64) {
    let mut times: Vec<_> = times.iter().map(|time| time.as_secs_f64() * 1e3).collect();
    times.sort_by(f64::total_cmp);
    (times[times.len() / 2], times[times.len() - 1])
}

/// Kills the master. Returns the time from the open port of the new master to the open gate, in milliseconds;
/// the rest of a recovery is the start of a Python program.
#[track_caller]
fn crash(robot: &mut Robot) -> f64 {
    let before = status(&robot.client())["recoveries"].as_u64();
    robot.crash_master();
    eventually_some("the recovery has a report", || {
        let status = status(&robot.client());
        let new = status["recoveries"].as_u64() > before;
        let phase = |name: &str| status["last_recovery"]["phases"][name].as_f64();
        new.then(|| Some(phase("total_ms")? - phase("absence_ms")?))?
    })
}

in_both_modes!(with_twenty_unreachable_nodes_the_living_ones_are_still_told_soon);

/// More nodes cannot be reached than a master has threads that notify nodes: three, or eight of a core.
fn with_twenty_unreachable_nodes_the_living_ones_are_still_told_soon(mode: Mode) {
    let _turn = crate::turn();
    let net = Netns::new();
    let mut robot = Robot::start(mode);
    let client = robot.client();
    let living = Living::start(&robot);
    let gone = || (10..10 + UNREACHABLE).map(|host| (host, format!("/gone{host}")));
    let reachable: Vec<_> = gone().map(|(_, name)| FakeNode::start(&name)).collect();
    for node in &reachable {
        node.subscribe(&client, "/chatter", "std_msgs/String");
        node.watch_param(&client, "/gain");
    }
    let control = Control::start();
    let without = [(); 2].map(|()| crash(&mut robot));
    // The same registrations again, of nodes that cannot be reached.
    for (host, name) in gone() {
        net.cut(host);
        let api = format!("http://{}:4711/", net.far(host));
        let (name, api) = (name.as_str(), api.as_str());
        client.ok(
            "registerSubscriber",
            params![name, "/chatter", "std_msgs/String", api],
        );
        client.ok("subscribeParam", params![name, api, "/gain"]);
    }
    drop(reachable);
    let before = robot.settled_state();
    let with = [(); 2].map(|()| crash(&mut robot));
    let reserve = control.allows(Duration::from_millis(500)).as_secs_f64() * 1e3;

    // The times are measured at once, when rosrescue does not know yet which nodes are unreachable, and again later.
    let mut publishers: Vec<FakeNode> = Vec::new();
    let mut tell = |count: usize| {
        let control = Control::start();
        let mut times = Vec::new();
        for _ in 0..count {
            let publisher = FakeNode::start(&format!("/publisher{}", publishers.len()));
            times.extend(living.hear_of(&publisher, &client));
            publishers.push(publisher);
        }
        let allowed = control.allows(SOON);
        assert!(times.iter().all(|time| *time < allowed), "{times:?}");
        times
    };
    let at_once = tell(3);
    eventually("the nodes are known to be unreachable", || {
        names(&status(&client)["unreachable"]).len() == usize::from(UNREACHABLE)
    });
    let later = tell(3);
    let (median, most) = summary(&at_once);
    let (median_later, most_later) = summary(&later);
    println!(
        "{mode:?}: told after {median:.1} ms (most {most:.1}) at once, {median_later:.1} ms (most \
         {most_later:.1}) later; the master restored in {with:.1?} ms, and in {without:.1?} ms when \
         all could be reached"
    );
    let least = |times: [f64; 2]| times.into_iter().fold(f64::INFINITY, f64::min);
    // Waiting for a single connection attempt would take 1000 ms.
    assert!(
        least(with) < least(without) * 2.0 + reserve,
        "{with:?} {without:?}"
    );
    // The living nodes are also notified of parameters, and no node was unregistered or disturbed.
    let state = robot.state();
    assert!(gone().all(|(_, name)| state.knows(&name)));
    assert_eq!(
        before.subscribers_of("/chatter"),
        state.subscribers_of("/chatter")
    );
    let watcher = FakeNode::start("/watcher");
    watcher.watch_param(&client, "/gain");
    within(SOON, "a notification of a parameter", || {
        client.set_param("/gain", 7);
        eventually("a living node is told of a parameter", || {
            !watcher.received("paramUpdate").is_empty()
        });
    });
    // The nodes that cannot be reached hold up each of the master's threads, so the master may send an outdated list after
    // rosrescue has sent a newer one. It is corrected soon.
    let all: Vec<_> = publishers.iter().map(|node| node.api.clone()).collect();
    eventually("all nodes know all publishers", || {
        let fakes = living.fakes.iter().map(|fake| fake.updates("/chatter"));
        let real = living.real.iter().map(|node| node.updates("/chatter"));
        fakes
            .chain(real)
            .all(|updates| updates.last() == Some(&all))
    });
    for fake in &living.fakes {
        assert_eq!(fake.received("shutdown").len(), 0);
    }
}
