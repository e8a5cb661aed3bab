use std::thread::sleep;
use std::time::{Duration, Instant};

use crate::chance::Chance;
use crate::computer::NAMES;
use crate::fleet::{Fleet, READ};
use crate::support::{Control, eventually};
use crate::traffic::Traffic;
use crate::{rounds, turn};

/// The documented limit is 200 ms; the test allows more, because the machine is busy.
const HANDOVER: Duration = Duration::from_secs(2);

#[test]
fn the_leader_hands_over_when_it_is_told_to_and_when_it_is_stopped() {
    let _turn = turn();
    let mut chance = Chance::new();
    let mut fleet = Fleet::start(&[]);
    let traffic = Traffic::start(&fleet);
    let mark = fleet.mark();
    for round in 0..rounds(1) {
        let leader = fleet.await_whole();
        let rest = fleet.others(leader);
        traffic.await_writes(&[0, 1, 2]);
        sleep(chance.time(Duration::from_millis(500)));
        let (begin, control) = (Instant::now(), Control::start());
        let to = rest[round % 2];
        // The command may be run on any computer.
        let (status, said) =
            fleet.computers[(leader + 1 + round) % 3].rosrescue(&["handover", "--to", NAMES[to]]);
        assert_eq!(status, Some(0), "{said}");
        eventually("the computer leads", || fleet.leader() == Some(to));
        traffic.await_writes(&[0, 1, 2]);
        let [write, read] = traffic.longest(&[0, 1, 2], begin);
        println!(
            "{} hands over to {}: longest write {write:.2?}, read {read:.2?}; output: {said}",
            NAMES[leader], NAMES[to]
        );
        let busy = control.allows(Duration::ZERO);
        assert!(write < HANDOVER + busy && read < READ + busy);

        let leader = fleet.await_whole();
        let rest = fleet.others(leader);
        traffic.await_writes(&[0, 1, 2]);
        let (begin, control) = (Instant::now(), Control::start());
        fleet.computers[leader].stop_rescue();
        let next = fleet.await_leader_of(&rest);
        traffic.await_writes(&rest);
        let [write, read] = traffic.longest(&rest, begin);
        println!(
            "{} is stopped, {} leads: longest write {write:.2?}, read {read:.2?}",
            NAMES[leader], NAMES[next]
        );
        let busy = control.allows(Duration::ZERO);
        assert!(write < HANDOVER + busy && read < READ + busy);
        fleet.computers[leader].start_rescue();
        fleet.computers[leader].await_answers();
        traffic.await_writes(&[0, 1, 2]);
        traffic.assert_nothing_lost(&fleet);
    }
    fleet.assert_streams_whole(&[0, 1, 2], &mark);
    fleet.assert_nodes_live();
}
