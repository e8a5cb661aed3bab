use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{scope, sleep};
use std::time::Duration;

use ros1_master::xmlrpc::Value;

use crate::computer::Computer;
use crate::fleet::Fleet;
use crate::support::{Finish, eventually, params};
use crate::turn;

/// Number of parameters that are written while the computer is cut off.
const KEYS: usize = 600;
/// Others also write each 50th of these parameters during the merge.
const SHARED: usize = 50;

fn key(number: usize) -> String {
    format!("/bulk/k{number}")
}

/// Waits until the computer has sent the leader the writes that it acknowledged while it was cut off.
#[track_caller]
pub(crate) fn await_merged(computer: &Computer) {
    eventually("the writes made while cut off have been sent", || {
        !computer
            .logged("sent the writes made while cut off")
            .is_empty()
    });
}

pub(crate) fn lost_writes(computer: &Computer) -> Option<u64> {
    computer.status()?["cluster"]["lost_writes"].as_u64()
}

#[test]
fn writes_of_the_majority_win_and_each_lost_write_is_reported() {
    let _turn = turn();
    let mut fleet = Fleet::start(&["--alone", "serve"]);
    let leader = fleet.await_whole();
    let cut = (leader + 1) % 3;
    let before = [("/estop", 0), ("/back", 1), ("/wifi/password", 1)];
    for (key, value) in before {
        fleet.computers[leader].set_param(key, value);
    }
    fleet.await_same_state();
    fleet.network.cut_cable(cut);
    let next = fleet.await_leader_of(&fleet.others(cut));
    let (others, lonely) = (&fleet.computers[next], &fleet.computers[cut]);
    eventually("the computer is alone", || lonely.role_is("alone"));
    others.set_param("/estop", 1);
    lonely.set_param("/estop", 1);
    lonely.set_param("/estop", 0);
    // The value is the same as before, but the others have written the parameter.
    others.set_param("/back", 2);
    others.set_param("/back", 1);
    lonely.set_param("/back", 7);
    others.set_param("/wifi/password", 2);
    lonely.set_param("/wifi/password", 31337);
    for value in 0..100 {
        lonely.set_param("/only_here", value);
    }
    fleet.network.mend_cable(cut);
    fleet.await_whole();
    await_merged(lonely);
    fleet.await_same_state();
    let expected = [
        ("/estop", 1),
        ("/back", 1),
        ("/wifi/password", 2),
        ("/only_here", 99),
    ];
    for computer in &fleet.computers {
        for (key, value) in expected {
            let found = computer.param(key);
            assert_eq!(found, Some(Value::Int(value)), "{key} on {}", computer.name);
        }
    }
    eventually("the lost writes are counted", || {
        lost_writes(lonely) == Some(3)
    });
    let lines = lonely.logged("cut off was lost");
    assert_eq!(lines.len(), 3, "{lines:#?}");
    for (key, alone, others) in [
        ("`/estop`", "alone=0", "others=1"),
        ("`/back`", "alone=7", "others=1"),
        ("`/wifi/password`", "(hidden)", "(hidden)"),
    ] {
        let line = lines.iter().find(|line| line.contains(key));
        let line = line.unwrap_or_else(|| panic!("{key} is not in {lines:#?}"));
        assert!(line.contains("WARN") && line.contains(alone) && line.contains(others));
        assert!(!line.contains("31337"), "{line}");
    }
    fleet.assert_nodes_live();
}

#[test]
fn a_write_made_while_cut_off_does_not_replace_one_made_during_the_merge() {
    let _turn = turn();
    let mut fleet = Fleet::start(&["--alone", "serve"]);
    let leader = fleet.await_whole();
    let cut = (leader + 1) % 3;
    fleet.network.cut_cable(cut);
    let next = fleet.await_leader_of(&fleet.others(cut));
    let (others, lonely) = (&fleet.computers[next], &fleet.computers[cut]);
    eventually("the computer is alone", || lonely.role_is("alone"));
    lonely.within(|| {
        let client = lonely.client();
        for number in 0..KEYS {
            client.set_param(&key(number), -1);
        }
    });
    fleet.network.mend_cable(cut);
    let finish = AtomicBool::new(false);
    // The last acknowledged value of each shared parameter.
    let written = scope(|scope| {
        let writer = scope.spawn(|| {
            others.within(|| {
                let client = others.client();
                let mut written = vec![0; KEYS / SHARED];
                // The merge has reached the first parameters, and the last ones are not sent yet.
                while client.param(&key(1)).is_none() && !finish.load(Ordering::Relaxed) {}
                for round in 1.. {
                    for (nth, last) in written.iter_mut().enumerate().rev() {
                        let params = params!["/writer", key(nth * SHARED), round];
                        client.ok("setParam", params);
                        *last = round;
                    }
                    if finish.load(Ordering::Relaxed) {
                        break;
                    }
                    sleep(Duration::from_millis(5));
                }
                written
            })
        });
        let finish = Finish(&finish);
        await_merged(lonely);
        drop(finish);
        writer.join().unwrap()
    });
    fleet.await_whole();
    fleet.await_same_state();
    let state = fleet.computers[cut].state().unwrap();
    let bulk = state.params.as_struct().unwrap().get("bulk").unwrap();
    let bulk = bulk.as_struct().unwrap();
    let wrong: Vec<_> = (0..KEYS)
        .filter_map(|number| {
            let expected = match number % SHARED {
                0 => written[number / SHARED],
                _ => -1,
            };
            let found = bulk.get(&format!("k{number}"));
            (found != Some(&Value::Int(expected))).then_some((number, found, expected))
        })
        .collect();
    assert!(
        wrong.is_empty(),
        "{} keys are wrong: {wrong:?}",
        wrong.len()
    );
    println!(
        "{} writes, {:?} lost, the last one of others: {}",
        KEYS,
        lost_writes(&fleet.computers[cut]),
        written[0]
    );
    fleet.assert_nodes_live();
}
