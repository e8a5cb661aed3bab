use std::collections::BTreeMap;
use std::fs;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{scope, sleep};
use std::time::Duration;

use ros1_master::xmlrpc::Value;
use rustix::process::Signal;

use crate::computer::{Computer, NAMES, PORT};
use crate::fleet::Fleet;
use crate::network::enter;
use crate::support::{Client, FakeNode, eventually, holds, params, signal};
use crate::traffic::Named;
use crate::{rounds, turn};

/// Number of parameters, each with its own writer.
const KEYS: usize = 8;
/// Pause between two calls of a writer.
const PAUSE: Duration = Duration::from_millis(20);

fn key(index: usize) -> String {
    format!("/of_writer_{index}")
}

/// Sets `key` to increasing numbers, starting with `number`, until `stop`. Returns the last number, which was
/// acknowledged.
fn count(key: &str, mut number: i32, stop: &AtomicBool) -> i32 {
    let client = Client::new(PORT);
    loop {
        client.ok("setParam", params!["/writer", key, number]);
        if stop.load(Ordering::Relaxed) {
            return number;
        }
        number += 1;
        sleep(PAUSE);
    }
}

/// The values of each parameter that the node was notified of, in order.
fn told(node: &FakeNode) -> BTreeMap<String, Vec<i32>> {
    let mut told: BTreeMap<String, Vec<i32>> = BTreeMap::new();
    for update in node.received("paramUpdate") {
        let key = update[1].as_str().unwrap().trim_end_matches('/').to_owned();
        told.entry(key).or_default().extend(update[2].as_int());
    }
    told
}

/// Panics unless the last value that the node was told is this one.
#[track_caller]
fn assert_last_told(watcher: &Named, value: i32) {
    if last_told(watcher) != Some(value) {
        let calls = watcher.it().calls();
        panic!("{value} is not what the node was told last: {calls:#?}");
    }
}

/// A node that subscribes to all parameters.
fn watch(computer: &Computer) -> Named {
    let watcher = Named::new(computer, "/watcher");
    for index in 0..KEYS {
        computer.within(|| watcher.it().watch_param(&computer.client(), &key(index)));
    }
    watcher
}

/// The leader's worker is stopped for longer than the time to live while calls of a follower are under way. The next
/// leader answers these and newer calls.
#[test]
fn a_leader_that_was_paused_sends_no_old_notifications() {
    let _turn = turn();
    let mut fleet = Fleet::start(&[]);
    let (mut first, mut watcher) = (0, None);
    for round in 0..rounds(1) {
        let leader = fleet.await_whole();
        let rest = fleet.others(leader);
        let [healthy, late] = [0, 1].map(|nth| &fleet.computers[rest[nth]]);
        let watcher = watcher.get_or_insert_with(|| watch(healthy)).it();
        let told_all = |least: i32| {
            let told = told(watcher);
            (0..KEYS).all(|index| told.get(&key(index)).and_then(|of| of.last()) >= Some(&least))
        };
        let worker = fleet.computers[leader].worker();
        let stop = AtomicBool::new(false);
        let last: Vec<i32> = scope(|scope| {
            let writers: Vec<_> = (0..KEYS)
                .map(|index| {
                    let (stop, namespace) = (&stop, [healthy, late][index % 2].namespace.clone());
                    scope.spawn(move || {
                        enter(&namespace);
                        count(&key(index), first, stop)
                    })
                })
                .collect();
            eventually("all writers count", || told_all(first + 5));
            signal(worker, Signal::STOP);
            let next = fleet.await_leader_of(&rest);
            println!(
                "round {round}: {} stands still, {} leads",
                NAMES[leader], NAMES[next]
            );
            stop.store(true, Ordering::Relaxed);
            writers
                .into_iter()
                .map(|writer| writer.join().unwrap())
                .collect()
        });
        let told_last = || {
            let told = told(watcher);
            (0..)
                .zip(&last)
                .all(|(index, last)| told[&key(index)].last() == Some(last))
        };
        eventually("the watcher gets the last values", told_last);
        signal(worker, Signal::CONT);
        fleet.await_same_state();
        for (index, last) in (0..).zip(&last) {
            assert_eq!(
                healthy.param(&key(index)),
                Some(Value::Int(*last)),
                "{}",
                key(index)
            );
        }
        // Late repetitions of notifications have arrived by then.
        if !holds(Duration::from_secs(1), told_last) {
            panic!(
                "round {round}: the last values are {last:?}; notified: {:?}",
                told(watcher)
            );
        }
        first = last.iter().max().unwrap() + 1;
    }
    fleet.assert_nodes_live();
}

/// A follower without etcd learns of new writes only from the leader's answers. Its mirror must not return older
/// values, however long the leader is stopped.
#[test]
fn no_read_goes_back_on_a_follower_without_etcd_while_the_leader_is_paused() {
    let _turn = turn();
    // The leader is stopped for less than this time to live.
    let mut fleet = Fleet::start(&["--cluster-ttl", "20"]);
    let leader = fleet.await_whole();
    let follower = fleet.others(leader)[0];
    for other in fleet.others(follower) {
        fleet.network.cut_port(follower, other, 2379);
    }
    fleet.computers[follower].kill_etcd();
    let computer = &fleet.computers[follower];
    for value in 1..=30 {
        computer.set_param("/counted", value);
    }
    let worker = fleet.computers[leader].worker();
    signal(worker, Signal::STOP);
    scope(|scope| {
        let read = scope.spawn(|| computer.param("/counted"));
        holds(Duration::from_secs(5), || !read.is_finished());
        signal(worker, Signal::CONT);
        assert_eq!(read.join().unwrap(), Some(Value::Int(30)));
    });
    assert!(computer.role_is("following"));
    for other in fleet.others(follower) {
        fleet.network.mend_port(follower, other, 2379);
    }
    fleet.computers[follower].start_etcd();
    fleet.await_same_state();
    fleet.assert_nodes_live();
}

/// A connection to another computer that has unsent data.
struct Sending {
    /// Whether its process has it open.
    is_open: bool,
    /// When the kernel sends the data again.
    again: Duration,
}

/// The connections from this computer to `port` of another one that have unsent data. The table's format is in
/// `proc_net_tcp.rst` of Linux.
fn sending_to(computer: &Computer, port: u16) -> Vec<Sending> {
    let table = computer.within(|| fs::read_to_string("/proc/thread-self/net/tcp").unwrap());
    let sending = table.lines().skip(1).filter_map(|line| {
        let columns: Vec<_> = line.split_whitespace().collect();
        let is_there = columns[2].ends_with(&format!(":{port:04X}"));
        let (_, ticks) = columns[5].split_once(':')?;
        let ticks = u64::from_str_radix(ticks, 16).unwrap();
        (is_there && !columns[4].starts_with("00000000:")).then(|| Sending {
            is_open: columns[9] != "0",
            again: Duration::from_millis(ticks * 10),
        })
    });
    sending.collect()
}

fn is_sending_to(computer: &Computer, port: u16) -> bool {
    !sending_to(computer, port).is_empty()
}

/// The last value of the parameter that the node was told.
fn last_told(watcher: &Named) -> Option<i32> {
    told(watcher.it()).get(&key(0))?.last().copied()
}

/// A rosmaster notifies a node whose cable is cut, and is killed. Its kernel would send the notification again and again
/// until the cable is mended, and then the node would get it after the next leader's.
#[test]
fn no_old_notification_arrives_after_a_cut() {
    let _turn = turn();
    let mut fleet = Fleet::start(&[]);
    let leader = fleet.await_whole();
    let rest = fleet.others(leader);
    let (first, cut, next) = (
        &fleet.computers[leader],
        &fleet.computers[rest[0]],
        &fleet.computers[rest[1]],
    );
    let watcher = watch(cut);
    let last = || last_told(&watcher);
    // Each thread of rosmaster has its own connection to the node. Soon all of them exist.
    for value in -50..=1 {
        first.set_param(&key(0), value);
        eventually("the node is told", || last() == Some(value));
    }
    fleet.network.cut_cable(rest[0]);
    first.set_param(&key(0), 2);
    eventually("rosmaster has notified the node", || {
        is_sending_to(first, watcher.it().port())
    });
    // etcd may elect a leader because of the cut, and be late meanwhile.
    eventually("the next computer leads", || {
        first.rosrescue(&["handover", "--to", next.name]);
        next.role_is("leading")
    });
    next.set_param(&key(0), 3);
    eventually("the computer is alone", || cut.role_is("alone"));
    fleet.network.mend_cable(rest[0]);
    eventually("the node is told 3", || last() == Some(3));
    // The kernel doubles its pause each time, so it sends once more within the time for which the cable was cut.
    holds(Duration::from_secs(8), || last() == Some(3));
    assert_last_told(&watcher, 3);
    fleet.await_whole();
    fleet.assert_nodes_live();
}

/// The mirror of a leader without a master notifies a node whose answers do not arrive. The connection would be made when
/// the cable is mended, after the next leader has told the node something newer.
#[test]
fn no_old_notification_of_the_mirror_arrives_after_a_cut() {
    let _turn = turn();
    let mut fleet = Fleet::start(&[]);
    let leader = fleet.await_whole();
    let rest = fleet.others(leader);
    let (first, cut, next) = (
        &fleet.computers[leader],
        &fleet.computers[rest[0]],
        &fleet.computers[rest[1]],
    );
    let watcher = watch(cut);
    let last = || last_told(&watcher);
    first.set_param(&key(0), 1);
    eventually("the node is told", || last() == Some(1));
    fleet.network.cut_way(rest[0], leader);
    first.kill_master();
    first.set_param(&key(0), 2);
    eventually("the mirror connects to the node", || {
        is_sending_to(first, watcher.it().port())
    });
    // etcd may elect a leader because of the cut, and be late meanwhile.
    eventually("the next computer leads", || {
        next.rosrescue(&["handover", "--to", next.name]);
        fleet.leader() == Some(rest[1])
    });
    next.set_param(&key(0), 3);
    eventually("the node is told 3", || last() == Some(3));
    fleet.network.mend_way(rest[0], leader);
    // The kernel tries again after 1 and 3 seconds, and rosrescue waits 3 seconds for a node.
    holds(Duration::from_secs(5), || last() == Some(3));
    assert_last_told(&watcher, 3);
    fleet.await_whole();
    fleet.assert_nodes_live();
}

/// rosmaster gives up a node that does not answer for 5 s, and closes the connection. Its kernel would go on sending the
/// notification, and the node would get it after newer ones, although rosmaster lives.
#[test]
fn no_old_notification_arrives_after_rosmaster_has_given_up() {
    let _turn = turn();
    let mut fleet = Fleet::start(&[]);
    let leader = fleet.await_whole();
    let cut = fleet.others(leader)[0];
    let first = &fleet.computers[leader];
    let watcher = watch(&fleet.computers[cut]);
    let last = || last_told(&watcher);
    for value in -50..=1 {
        first.set_param(&key(0), value);
        eventually("the node is told", || last() == Some(value));
    }
    let port = watcher.it().port();
    fleet.network.cut_cable(cut);
    first.set_param(&key(0), 2);
    eventually("rosmaster has notified the node", || {
        is_sending_to(first, port)
    });
    // The next value is on its way in less time.
    eventually("rosmaster has given up, and the kernel pauses", || {
        let late = |of: &Sending| !of.is_open && of.again > Duration::from_secs(4);
        sending_to(first, port).iter().all(late)
    });
    first.set_param(&key(0), 3);
    fleet.network.mend_cable(cut);
    eventually("the node is told 3", || last() == Some(3));
    // The kernel doubles its pause each time, so it sends once more within the time for which the cable was cut.
    holds(Duration::from_secs(15), || last() == Some(3));
    assert_last_told(&watcher, 3);
    fleet.await_whole();
    fleet.assert_nodes_live();
}
