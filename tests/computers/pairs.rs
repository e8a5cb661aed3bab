use std::time::{Duration, Instant};

use crate::computer::{NAMES, PORT};
use crate::fleet::{Fleet, READ, TAKEOVER, TTL};
use crate::lonely::{await_merged, lost_writes};
use crate::support::{Control, eventually};
use crate::traffic::Traffic;
use crate::turn;

/// Runs `cut` with the leader and a follower, and later `mend`. Meanwhile all computers must serve; the follower is
/// alone.
#[track_caller]
fn without_each_other(
    fleet: &mut Fleet,
    what: &str,
    cut: impl Fn(&Fleet, usize, usize),
    mend: impl Fn(&Fleet, usize, usize),
) {
    let traffic = Traffic::start(fleet);
    let leader = fleet.await_whole();
    let follower = (leader + 1) % 3;
    traffic.await_writes(&[0, 1, 2]);
    let (mark, begin, control) = (fleet.mark(), Instant::now(), Control::start());
    cut(fleet, leader, follower);
    eventually("the follower is alone", || {
        fleet.computers[follower].role_is("alone")
    });
    let alone = begin.elapsed();
    traffic.await_writes(&[0, 1, 2]);
    assert_eq!(
        fleet.await_leader_of(&[0, 1, 2]),
        leader,
        "the leader stays the same"
    );
    for index in [leader, follower] {
        fleet.assert_streams_whole(&[index, (leader + 2) % 3], &mark);
    }
    mend(fleet, leader, follower);
    let mended = Instant::now();
    fleet.await_whole();
    let healed = mended.elapsed();
    fleet.await_flow(&[0, 1, 2]);
    let [write, read] = traffic.longest(&[0, 1, 2], begin);
    println!(
        "{what}: {} is alone after {alone:.2?}, whole after {healed:.2?}; longest write {write:.2?}, read {read:.2?}",
        NAMES[follower]
    );
    let busy = control.allows(Duration::ZERO);
    assert!(write < TTL + TAKEOVER + busy && read < READ + busy);
    traffic.assert_nothing_lost(fleet);
    fleet.assert_nodes_live();
}

#[test]
fn two_computers_that_do_not_reach_each_other_both_serve() {
    let _turn = turn();
    // With its defaults, etcd 3.4 elects for up to 3 s when the pair is mended, which is longer than the time to live.
    let mut fleet = Fleet::quick(&[]);
    without_each_other(
        &mut fleet,
        "the leader's rosrescue is out of reach of one",
        |fleet, leader, follower| fleet.network.cut_port(follower, leader, PORT),
        |fleet, leader, follower| fleet.network.mend_port(follower, leader, PORT),
    );
    without_each_other(
        &mut fleet,
        "the leader and one do not reach each other",
        |fleet, leader, follower| fleet.network.cut_pair(leader, follower),
        |fleet, leader, follower| fleet.network.mend_pair(leader, follower),
    );
}

/// Meanwhile the former leader acknowledges the calls of its own nodes. It drops those that the followers had forwarded,
/// because they make them again at the new leader.
#[test]
fn a_leader_without_etcd_stops_leading_although_all_reach_it() {
    let _turn = turn();
    let mut fleet = Fleet::start(&[]);
    let traffic = Traffic::start(&fleet);
    let leader = fleet.await_whole();
    let rest = fleet.others(leader);
    traffic.await_writes(&[0, 1, 2]);
    let (mark, begin, control) = (fleet.mark(), Instant::now(), Control::start());
    for &other in &rest {
        fleet.network.cut_port(leader, other, 2379);
    }
    fleet.computers[leader].kill_etcd();
    let next = fleet.await_leader_of(&rest);
    let took = begin.elapsed();
    traffic.await_writes(&[0, 1, 2]);
    fleet.assert_streams_whole(&[0, 1, 2], &mark);
    let lonely = &fleet.computers[leader];
    assert!(!lonely.role_is("leading"));
    eventually("the computer is alone", || lonely.role_is("alone"));
    lonely.set_param("/alone", 1);
    for &other in &rest {
        fleet.network.mend_port(leader, other, 2379);
    }
    fleet.computers[leader].start_etcd();
    fleet.await_whole();
    await_merged(&fleet.computers[leader]);
    let [write, read] = traffic.longest(&[0, 1, 2], begin);
    println!(
        "{} reaches no etcd: {} leads after {took:.2?}; longest write {write:.2?}, read {read:.2?}",
        NAMES[leader], NAMES[next]
    );
    let busy = control.allows(Duration::ZERO);
    let limit = TTL + TAKEOVER + busy;
    assert!(took < limit && write < limit && read < READ + busy);
    traffic.assert_nothing_lost(&fleet);
    for computer in &fleet.computers {
        assert_eq!(
            computer.param("/alone"),
            Some(1.into()),
            "{}",
            computer.name
        );
    }
    assert_eq!(lost_writes(&fleet.computers[leader]), Some(0));
    fleet.assert_streams_whole(&[0, 1, 2], &mark);
    fleet.assert_nodes_live();
}
