use rosrescue::xmlrpc::Value;

use crate::alone;
use crate::computer::NAMES;
use crate::fleet::Fleet;
use crate::network::COUNT;
use crate::support::eventually;

#[test]
fn two_start_at_the_same_moment_and_a_third_joins_later() {
    let _alone = alone();
    let mut fleet = Fleet::empty(&[]);
    for index in [0, 1] {
        fleet.computers[index].start_rescue();
    }
    for index in [0, 1] {
        fleet.computers[index].await_answers();
    }
    let leader = fleet.await_leader_of(&[0, 1]);
    eventually("the other one follows", || {
        fleet.computers[1 - leader].role_is("following")
    });
    fleet.computers[1 - leader].set_param("/early", 1);
    for index in [0, 1] {
        fleet.start_nodes(index);
    }
    fleet.await_flow(&[0, 1]);
    let mark = fleet.mark();
    fleet.computers[2].start_rescue();
    fleet.computers[2].await_answers();
    assert_eq!(fleet.await_whole(), leader, "who joins changes nothing");
    assert_eq!(fleet.computers[2].param("/early"), Some(Value::Int(1)));
    fleet.start_nodes(2);
    fleet.await_flow(&[0, 1, 2]);
    fleet.assert_streams_whole(&[0, 1], &mark);
    let state = fleet.await_same_state();
    for node in ["/talker_a", "/listener_b", "/talker_c"] {
        assert!(state.knows(node), "{state}");
    }
}

#[test]
fn the_session_goes_on_where_nodes_live_and_begins_anew_when_all_are_booted() {
    let _alone = alone();
    let mut fleet = Fleet::start(&[]);
    fleet.computers[1].set_param("/of_this_session", 1);
    let before = fleet.await_same_state();
    let mark = fleet.mark();
    for index in 0..COUNT {
        fleet.computers[index].stop_rescue();
    }
    for index in 0..COUNT {
        fleet.computers[index].start_rescue();
    }
    for index in 0..COUNT {
        fleet.computers[index].await_answers();
    }
    let after = fleet.await_same_state().without_node("/rosout");
    before
        .without_node("/rosout")
        .assert_same(&after, "after all were stopped");
    fleet.assert_streams_whole(&[0, 1, 2], &mark);
    fleet.assert_nodes_live();

    switch_off_and_on(&mut fleet);
    fleet.await_whole();
    let state = fleet.await_same_state();
    for (index, computer) in fleet.computers.iter().enumerate() {
        assert_eq!(computer.param("/of_this_session"), None, "{index}");
    }
    assert!(!state.knows("/talker_a"), "{state}");
    fleet.start_all_nodes();
    fleet.await_same_state();
}

#[test]
fn a_new_session_goes_on_when_its_first_leader_leads_again() {
    let _alone = alone();
    let mut fleet = Fleet::empty(&[]);
    for index in 0..COUNT {
        fleet.computers[index].start_rescue();
    }
    fleet.computers[0].await_answers();
    fleet.computers[0].set_param("/of_the_old_session", 1);
    switch_off_and_on(&mut fleet);
    let first = fleet.await_whole();
    fleet.computers[0].set_param("/of_the_new_session", 1);
    for to in [(first + 1) % COUNT, first] {
        let leader = fleet.await_whole();
        let (status, said) = fleet.computers[leader].rosrescue(&["handover", "--to", NAMES[to]]);
        assert_eq!(status, Some(0), "{said}");
        eventually("it leads", || fleet.leader() == Some(to));
    }
    fleet.await_same_state();
    for (index, computer) in fleet.computers.iter().enumerate() {
        assert_eq!(computer.param("/of_the_old_session"), None, "{index}");
        let kept = computer.param("/of_the_new_session");
        assert_eq!(kept, Some(Value::Int(1)), "{index}");
    }
}

/// The power of all computers fails, and comes back.
fn switch_off_and_on(fleet: &mut Fleet) {
    for index in 0..COUNT {
        fleet.computers[index].power_off();
    }
    for index in 0..COUNT {
        let computer = &mut fleet.computers[index];
        computer.boot();
        computer.start_etcd();
        computer.start_rescue();
    }
    for index in 0..COUNT {
        fleet.computers[index].await_answers();
    }
}
