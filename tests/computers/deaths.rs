use std::thread::{scope, sleep};
use std::time::{Duration, Instant};

use crate::chance::Chance;
use crate::computer::{Computer, NAMES, send};
use crate::fleet::{Fleet, TAKEOVER, TTL, victim};
use crate::support::{Control, Library, eventually, params, signal};
use crate::traffic::{Named, TYPE, Traffic};
use crate::{rounds, turn};
use rustix::process::Signal;

/// The computer dies by a power cut, after which the others get no packet from it, or by SIGKILL for all its processes,
/// after which the kernel closes their connections.
#[test]
fn no_node_notices_that_another_computer_dies_and_comes_back() {
    let _turn = turn();
    let mut chance = Chance::new();
    let mut fleet = Fleet::start(&[]);
    let traffic = Traffic::start(&fleet);
    for round in 0..rounds(2) {
        let leader = fleet.await_whole();
        let dies = victim(round, leader);
        let rest = fleet.others(dies);
        traffic.await_writes(&[0, 1, 2]);
        sleep(chance.time(Duration::from_secs(1)));
        let (mark, begin, control) = (fleet.mark(), Instant::now(), Control::start());
        let power = round % 2 == 0;
        if power {
            fleet.network.cut_cable(dies);
        }
        fleet.computers[dies].power_off();
        let late = format!("late_{round}");
        let (mut node, next, took) = scope(|scope| {
            let library = [Library::Roscpp, Library::Rospy][round % 2];
            let name = format!("__name:={late}");
            let computer = &fleet.computers[rest[round % 2]];
            let node = scope.spawn(move || computer.node(library, "talker", &["30", &name]));
            let next = fleet.await_leader_of(&rest);
            let took = begin.elapsed();
            (node.join().expect("a late node"), next, took)
        });
        let came_up = begin.elapsed();
        traffic.await_writes(&rest);
        for &index in &rest {
            let listener = fleet.computers[index].listener.as_ref().unwrap();
            listener.wait_messages(&format!("/{late}"), 1);
        }
        fleet.assert_streams_whole(&rest, &mark);
        let [write, read] = traffic.longest(&rest, begin);
        println!(
            "{} dies ({}, leader {}): {} leads after {took:.2?}; longest write {write:.2?}, read {read:.2?}; a new \
             node is at work after {came_up:.2?}",
            NAMES[dies],
            if power { "power" } else { "SIGKILL" },
            NAMES[leader],
            NAMES[next],
        );
        // A read waits for the next leader if the follower's mirror lacks the last record that the dead leader
        // announced. The members of etcd learn from etcd's leader that a record is committed, and that leader may have
        // died too.
        let limit = control.allows(TTL + TAKEOVER);
        assert!(
            took < limit && write < limit && read < limit,
            "longest read {read:?}, write {write:?}"
        );
        send(&node, Signal::TERM);
        node.wait();
        if power {
            fleet.network.mend_cable(dies);
        }
        fleet.bring_back(dies);
        fleet.await_whole();
        fleet.await_flow(&[0, 1, 2]);
        traffic.await_writes(&[0, 1, 2]);
        traffic.assert_nothing_lost(&fleet);
        fleet.assert_nodes_live();
    }
}

/// The leader cannot reach the old node, and dies before it has told it to shut down.
#[test]
fn a_node_whose_name_was_taken_is_told_to_shut_down_by_the_next_leader() {
    let _turn = turn();
    let mut fleet = Fleet::start(&[]);
    let leader = fleet.await_whole();
    let rest = fleet.others(leader);
    let computers = [&fleet.computers[rest[0]], &fleet.computers[rest[1]]];
    let [old, new] = computers.map(|computer| Named::new(computer, "/twin"));
    let publish = |nth: usize, node: &Named| {
        let computer = computers[nth];
        computer.within(|| node.it().publish(&computer.client(), "/of_twin", TYPE));
    };
    publish(0, &old);
    fleet.await_same_state();
    fleet.network.cut_port(leader, rest[0], old.it().port());
    publish(1, &new);
    let told = |node: &Named| !node.it().received("shutdown").is_empty();
    assert!(!told(&old), "the leader has reached it");
    fleet.computers[leader].power_off();
    fleet.await_leader_of(&rest);
    eventually("the next leader tells the old node to shut down", || {
        told(&old)
    });
    assert!(!told(&new));
    fleet.network.mend_port(leader, rest[0], old.it().port());
    fleet.bring_back(leader);
    fleet.await_same_state();
    fleet.assert_nodes_live();
}

/// When the worker dies, the guardian starts a new one, and the computer stays the leader. The test runs without
/// [`Traffic`], so that the processor is idle.
#[test]
fn writes_go_on_soon_after_the_death_of_the_leaders_worker_or_computer() {
    let _turn = turn();
    let mut chance = Chance::new();
    let mut fleet = Fleet::quick(&[]);
    let (mut workers, mut computers) = (Vec::new(), Vec::new());
    let control = Control::start();
    for round in 0..rounds(1) {
        let leader = fleet.await_whole();
        let rest = fleet.others(leader);
        let caller = [rest[round / 2 % 2], leader][round % 2];
        sleep(chance.time(Duration::from_secs(1)));
        let worker = fleet.computers[leader].worker();
        let begin = Instant::now();
        signal(worker, Signal::KILL);
        workers.push(first_write(&fleet.computers[caller], begin));
        let leads = fleet.await_whole();
        println!(
            "the worker of {} dies: first write on {} after {:.2?}; {} leads",
            NAMES[leader], NAMES[caller], workers[round], NAMES[leads]
        );

        let leader = leads;
        let rest = fleet.others(leader);
        let caller = rest[round % 2];
        sleep(chance.time(Duration::from_secs(1)));
        fleet.network.cut_cable(leader);
        let begin = Instant::now();
        fleet.computers[leader].power_off();
        computers.push(first_write(&fleet.computers[caller], begin));
        let leads = fleet.await_leader_of(&rest);
        println!(
            "{} dies: first write on {} after {:.2?}; {} leads",
            NAMES[leader], NAMES[caller], computers[round], NAMES[leads]
        );
        fleet.network.mend_cable(leader);
        fleet.bring_back(leader);
    }
    let busy = control.allows(Duration::ZERO);
    for (what, mut took, most) in [
        ("a worker", workers, TAKEOVER + busy),
        ("a computer", computers, TTL + TAKEOVER + busy),
    ] {
        took.sort();
        let (median, longest) = (took[took.len() / 2], took[took.len() - 1]);
        println!(
            "the death of {what}, {} times: first write after {median:.2?} in the median, {longest:.2?} at most",
            took.len()
        );
        assert!(longest < most, "{took:?}");
    }
    fleet.await_flow(&[0, 1, 2]);
    fleet.assert_nodes_live();
}

/// The time from `begin` until the first write is answered on `computer`.
fn first_write(computer: &Computer, begin: Instant) -> Duration {
    let write = || {
        computer
            .client()
            .ask("setParam", params!["/test", "/first", 1])
    };
    computer.within(|| eventually("a write is answered", || write().is_some()));
    begin.elapsed()
}
