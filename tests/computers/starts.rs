use ros1_master::xmlrpc::Value;

use crate::computer::{Computer, NAMES, PORT, endpoints};
use crate::fleet::Fleet;
use crate::network::{COUNT, address};
use crate::support::eventually;
use crate::turn;

#[test]
fn two_start_at_the_same_moment_and_a_third_joins_later() {
    let _turn = turn();
    let mut fleet = Fleet::empty(&[]);
    for index in [0, 1] {
        fleet.computers[index].start_rescue();
    }
    for index in [0, 1] {
        fleet.computers[index].await_answers();
    }
    let leader = fleet.await_leader_of(&[0, 1]);
    eventually("the other computer follows", || {
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
    assert_eq!(
        fleet.await_whole(),
        leader,
        "a computer that joins does not change the leader"
    );
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
fn a_session_goes_on_after_restarts_and_a_new_one_begins_after_a_reboot_of_all() {
    let _turn = turn();
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
    let _turn = turn();
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
        // A computer that has just started may be cut off for a moment if it is busy.
        eventually("the computer leads", || {
            fleet.computers[leader].rosrescue(&["handover", "--to", NAMES[to]]);
            fleet.leader() == Some(to)
        });
    }
    fleet.await_same_state();
    for (index, computer) in fleet.computers.iter().enumerate() {
        assert_eq!(computer.param("/of_the_old_session"), None, "{index}");
        let kept = computer.param("/of_the_new_session");
        assert_eq!(kept, Some(Value::Int(1)), "{index}");
    }
}

#[test]
fn a_computer_with_a_name_in_use_does_not_start_and_disturbs_nothing() {
    let _turn = turn();
    let mut fleet = Fleet::empty(&[]);
    for index in [0, 1] {
        fleet.computers[index].start_rescue();
    }
    for index in [0, 1] {
        fleet.computers[index].await_answers();
    }
    let leader = fleet.await_leader_of(&[0, 1]);
    let follower = 1 - leader;
    await_entry(&fleet, leader, NAMES[follower], follower);
    let before = [leader, follower].map(|index| lasting(&fleet.computers[index]));
    assert!(before.iter().all(|of| of[0] == 0), "{before:?}");
    for namesake in [leader, follower] {
        let third = &mut fleet.computers[2];
        third.called = NAMES[namesake].to_owned();
        third.start_rescue();
        assert_eq!(third.await_end(), Some(1));
        let said = third.logged("--cluster-name");
        let [said] = said.as_slice() else {
            panic!("{said:?}");
        };
        for address in [2, namesake].map(address) {
            assert!(said.contains(&format!("http://{address}:11311/")), "{said}");
        }
        assert!(said.contains(&format!("`{}`", NAMES[namesake])), "{said}");
    }
    assert_eq!(
        [leader, follower].map(|index| lasting(&fleet.computers[index])),
        before
    );
    for computer in &fleet.computers[..2] {
        assert_eq!(computer.logged("same name"), <[String; 0]>::default());
    }
}

#[test]
fn a_computer_that_has_another_address_than_before_starts() {
    let _turn = turn();
    let mut fleet = Fleet::empty(&[]);
    for index in [0, 1] {
        fleet.computers[index].start_rescue();
    }
    for index in [0, 1] {
        fleet.computers[index].await_answers();
    }
    let leader = fleet.await_leader_of(&[0, 1]);
    let follower = 1 - leader;
    await_entry(&fleet, leader, NAMES[follower], follower);
    // The follower dies without notice. The third computer then takes its name, like the same computer with a new
    // address.
    fleet.computers[follower].power_off();
    let third = &mut fleet.computers[2];
    third.called = NAMES[follower].to_owned();
    third.start_rescue();
    third.await_answers();
    // Only after its wait does the computer write an entry. If etcd was away when it started, it answers before that.
    await_entry(&fleet, leader, NAMES[follower], 2);
    assert_eq!(fleet.leader_of(&[leader]), Some(leader));
    let waits = fleet.computers[2].logged("knows this computer's name at another address");
    assert_eq!(waits.len(), 1, "{waits:?}");
}

#[test]
fn wrong_options_are_reported_with_what_to_do() {
    let _turn = turn();
    let mut fleet = Fleet::empty(&[]);
    fleet.computers[0].start_rescue();
    fleet.computers[0].await_answers();
    fleet.await_leader_of(&[0]);
    let [first, second, third] = <[String; 3]>::try_from(endpoints()).unwrap();
    let peer = third.replace(":2379", ":2380");
    let nobody = second.replace(":2379", ":2378");
    let unknown = "http://nobody.invalid:2379";
    let cluster = format!("{first},{peer},{nobody},{unknown}/robt");
    let (status, said) = fleet.computers[1].rosrescue(&["check", "--cluster", &cluster]);
    assert_eq!(status, Some(1), "{said}");
    fleet.computers[1].cluster = Some(cluster);
    fleet.computers[1].start_rescue();
    for wrong in [
        format!("{peer} is etcd's port for its peers; clients use another one, usually 2379"),
        format!("cannot connect to etcd at {nobody}"),
        format!("cannot connect to etcd at {unknown}"),
        "etcd has no robot `robt` yet, but it has `robot`".to_owned(),
    ] {
        assert!(said.contains(&wrong), "{wrong} is not in {said}");
        eventually(&format!("the log has {wrong}"), || {
            let lines = fleet.computers[1].logged(&wrong);
            lines.iter().any(|line| line.contains("check --cluster"))
        });
    }
    fleet.computers[1].await_answers();
}

/// Waits until the entry in etcd of the computer `follower`, which is called `name`, has the role `following`.
fn await_entry(fleet: &Fleet, leader: usize, name: &str, follower: usize) {
    let uri = format!("http://{}:{PORT}/", address(follower));
    eventually("the follower's entry has the role", || {
        let page = fleet.computers[leader].status();
        let all = page.and_then(|page| page["cluster"]["computers"].as_array().cloned());
        all.is_some_and(|all| {
            let mut all = all.iter();
            all.any(|of| of["name"] == name && of["uri"] == uri && of["role"] == "following")
        })
    });
}

/// Facts that a takeover or the death of a worker would change: worker restarts, role, takeovers, leader and term.
fn lasting(computer: &Computer) -> [serde_json::Value; 5] {
    let page = computer.status().unwrap();
    let cluster = &page["cluster"];
    let leader = &cluster["leader"];
    [
        &page["worker_restarts"],
        &cluster["role"],
        &cluster["takeovers"],
        &leader["name"],
        &leader["term"],
    ]
    .map(Clone::clone)
}

/// Cuts the power of all computers and switches them on again.
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
