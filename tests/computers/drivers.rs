use std::time::Instant;

use crate::computer::NAMES;
use crate::fleet::{Fleet, TAKEOVER, TTL};
use crate::support::{Control, Library, Node, eventually};
use crate::{rounds, turn};

/// Starts a driver like those of real robots: it publishes and logs at 50 Hz, and reads parameters that are not set.
#[track_caller]
fn driver(fleet: &Fleet, index: usize) -> Node {
    let name = format!("__name:=driver_{}", NAMES[index]);
    fleet.computers[index].node(Library::Rospy, "driver", &[&name])
}

/// Waits until the driver's loop has run for another second.
#[track_caller]
fn go_on(driver: &Node) {
    let before = driver.said("pass").len();
    eventually("the driver goes on", || {
        driver.said("pass").len() >= before + 5
    });
}

#[test]
fn no_driver_fails_when_the_leaders_computer_dies() {
    let _turn = turn();
    let mut fleet = Fleet::quick(&[]);
    let mut drivers = [0, 1, 2].map(|index| Some(driver(&fleet, index)));
    let mut longest = Vec::new();
    let control = Control::start();
    for round in 0..rounds(1) {
        let leader = fleet.await_whole();
        let rest = fleet.others(leader);
        let driver_of = |index: usize| drivers[index].as_ref().unwrap();
        rest.iter().for_each(|&index| go_on(driver_of(index)));
        let before: Vec<_> = rest
            .iter()
            .map(|&index| driver_of(index).said("pass").len())
            .collect();
        let begin = Instant::now();
        fleet.network.cut_cable(leader);
        fleet.computers[leader].power_off();
        let next = fleet.await_leader_of(&rest);
        let took = begin.elapsed();
        rest.iter().for_each(|&index| go_on(driver_of(index)));
        let passes: Vec<f64> = rest
            .iter()
            .zip(before)
            .map(|(&index, before)| {
                let passes = driver_of(index).said("pass");
                let passes = passes[before..].iter().map(|ms| ms.parse::<f64>().unwrap());
                passes.fold(0.0, f64::max)
            })
            .collect();
        println!(
            "round {round}: {} leads after {took:.2?}; longest passes of the drivers on {} and {}: {passes:?} ms",
            NAMES[next], NAMES[rest[0]], NAMES[rest[1]]
        );
        longest.extend(passes);
        for &index in &rest {
            let driver = drivers[index].as_mut().unwrap();
            assert_eq!(driver.exited(), None, "{}", driver.log());
            let log = driver.output().join("\n");
            for bad in ["Traceback", "Error", "xception"] {
                assert!(!log.contains(bad), "{bad}:\n{}", driver.log());
            }
        }
        drivers[leader] = None;
        fleet.network.mend_cable(leader);
        fleet.bring_back(leader);
        drivers[leader] = Some(driver(&fleet, leader));
    }
    longest.sort_by(f64::total_cmp);
    let most = longest.last().copied().unwrap_or_default();
    println!(
        "the longest pass: {most} ms, the median of {}: {} ms",
        longest.len(),
        longest[longest.len() / 2]
    );
    let limit = control.allows(TTL + TAKEOVER);
    assert!(most < limit.as_secs_f64() * 1e3, "{most} ms");
    fleet.assert_nodes_live();
}
