use std::time::Instant;

use crate::alone;
use crate::fleet::{Fleet, READ, TAKEOVER, TTL};
use crate::support::eventually;
use crate::traffic::Traffic;

#[test]
fn without_etcd_each_serves_its_nodes_and_afterwards_one_leads() {
    let _alone = alone();
    let mut fleet = Fleet::start(&[]);
    let traffic = Traffic::start(&fleet);
    fleet.await_whole();
    traffic.await_writes(&[0, 1, 2]);
    let (mark, begin) = (fleet.mark(), Instant::now());
    for computer in &mut fleet.computers {
        computer.kill_etcd();
    }
    for computer in &fleet.computers {
        let what = format!("{} says that it is alone", computer.name);
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
