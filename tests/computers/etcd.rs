use std::time::Instant;

use crate::fleet::{Fleet, READ, TAKEOVER, TTL};
use crate::support::eventually;
use crate::traffic::Traffic;
use crate::turn;

#[test]
fn without_etcd_each_computer_serves_its_nodes_and_afterwards_one_leads() {
    let _turn = turn();
    let mut fleet = Fleet::start(&[]);
    let traffic = Traffic::start(&fleet);
    fleet.await_whole();
    traffic.await_writes(&[0, 1, 2]);
    let (mark, begin) = (fleet.mark(), Instant::now());
    for computer in &mut fleet.computers {
        computer.kill_etcd();
    }
    for computer in &fleet.computers {
        let what = format!("{} is alone", computer.name);
        eventually(&what, || computer.role_is("alone"));
    }
    let alone = begin.elapsed();
    traffic.await_writes(&[0, 1, 2]);
    fleet.assert_streams_whole(&[0, 1, 2], &mark);
    let back = Instant::now();
    for computer in &mut fleet.computers {
        computer.start_etcd();
    }
    fleet.await_whole();
    let healed = back.elapsed();
    traffic.await_writes(&[0, 1, 2]);
    let [write, read] = traffic.longest(&[0, 1, 2], begin);
    println!(
        "etcd is away: all are alone after {alone:.2?}, whole {healed:.2?} after its start; longest write {write:.2?}, \
         read {read:.2?}"
    );
    assert!(write < TTL + TAKEOVER && read < READ);
    traffic.assert_nothing_lost(&fleet);
    fleet.assert_streams_whole(&[0, 1, 2], &mark);
    fleet.assert_nodes_live();
}

#[test]
fn an_etcd_that_has_lost_its_data_gets_the_state_of_living_computers() {
    let _turn = turn();
    let mut fleet = Fleet::start(&[]);
    let leader = fleet.await_whole();
    for value in 1..=20 {
        fleet.computers[leader].set_param("/before", value);
    }
    fleet.await_same_state();
    for computer in &mut fleet.computers {
        computer.kill_etcd();
    }
    for computer in &fleet.computers {
        let what = format!("{} is alone", computer.name);
        eventually(&what, || computer.role_is("alone"));
    }
    let lonely = &fleet.computers[(leader + 1) % 3];
    lonely.set_param("/alone", 7);
    for computer in &mut fleet.computers {
        computer.wipe_etcd();
        computer.start_etcd();
    }
    let back = Instant::now();
    fleet.await_whole();
    println!(
        "etcd has lost its data: whole {:.2?} after its start",
        back.elapsed()
    );
    for computer in &fleet.computers {
        let what = format!("{} has what was written", computer.name);
        eventually(&what, || {
            let param = |key| computer.param(key);
            param("/before") == Some(20.into()) && param("/alone") == Some(7.into())
        });
        assert!(!computer.logged("etcd has lost its data").is_empty());
    }
    fleet.assert_nodes_live();
}
