use std::time::{Duration, Instant};

use rustix::process::Signal;

use crate::computer::endpoints;
use crate::fleet::{Fleet, READ, TAKEOVER, TTL};
use crate::support::{Control, eventually, params, signal};
use crate::traffic::Traffic;
use crate::turn;

#[test]
fn without_etcd_each_computer_serves_its_nodes_and_afterwards_one_leads() {
    let _turn = turn();
    let mut fleet = Fleet::start(&[]);
    let traffic = Traffic::start(&fleet);
    fleet.await_whole();
    traffic.await_writes(&[0, 1, 2]);
    let (mark, begin, control) = (fleet.mark(), Instant::now(), Control::start());
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
    let busy = control.allows(Duration::ZERO);
    assert!(write < TTL + TAKEOVER + busy && read < READ + busy);
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

/// Deletes all keys that begin with `prefix`, as `etcdctl del --prefix` does.
pub(crate) fn delete_keys(fleet: &Fleet, prefix: &str) {
    let range = prefix.to_owned()..format!("{prefix}\u{7f}");
    fleet.computers[0].within(|| {
        let runtime = tokio::runtime::Runtime::new().unwrap();
        runtime.block_on(async {
            let options = etcd_kv::Options {
                endpoints: endpoints(),
                access: etcd_kv::Credentials::default(),
            };
            let client = etcd_kv::Client::new(&options).unwrap();
            let txn = etcd_kv::Txn {
                success: vec![etcd_kv::TxnOp::Delete(range)],
                ..etcd_kv::Txn::default()
            };
            // After a failure, etcd may have to elect its leader first.
            let until = Instant::now() + Duration::from_secs(60);
            while let Err(error) = client.txn(&txn, READ).await {
                println!("deleting {prefix}: {error}; trying again");
                assert!(Instant::now() < until, "etcd does not answer: {error}");
            }
        });
    });
}

/// The leader used to go on with a journal that began with record 1 and without the state. When a follower started
/// again, everything older was gone on all computers.
#[test]
fn keys_that_are_deleted_in_a_living_etcd_come_back_and_no_write_is_lost() {
    let _turn = turn();
    let mut fleet = Fleet::start(&[]);
    fleet.await_whole();
    for (round, prefix) in ["/robot/", "/robot/journal/", "/robot/origin"]
        .into_iter()
        .enumerate()
    {
        let leader = fleet.await_whole();
        let key = format!("/before{round}");
        for value in 1..=20 {
            fleet.computers[leader].set_param(&key, value);
        }
        fleet.await_same_state();
        let mark = Instant::now();
        delete_keys(&fleet, prefix);
        // A write that the former journal did not get is closed, as in a takeover.
        eventually("a write is answered", || {
            let computer = &fleet.computers[leader];
            let params = params!["/test", format!("/after{round}"), 1];
            computer.within(|| computer.client().ask("setParam", params).is_some())
        });
        println!("{prefix} is gone: a write takes {:.2?}", mark.elapsed());
        let follower = &fleet.computers[(leader + 1) % 3];
        signal(follower.worker(), Signal::KILL);
        fleet.await_whole();
        fleet.await_same_state();
        for computer in &fleet.computers {
            for round in 0..=round {
                let [before, after] = ["before", "after"].map(|key| format!("/{key}{round}"));
                let what = format!("{prefix}: {} has what was written", computer.name);
                eventually(&what, || {
                    computer.param(&before) == Some(20.into())
                        && computer.param(&after) == Some(1.into())
                });
            }
        }
        let lost = fleet.computers[leader].ever_logged("etcd has lost its data");
        assert!(!lost.is_empty(), "{prefix}");
    }
    fleet.assert_nodes_live();
}

/// Large values are stored beside the journal, in parts.
#[test]
fn deleted_parts_of_a_large_value_come_back() {
    let _turn = turn();
    let mut fleet = Fleet::start(&[]);
    let leader = fleet.await_whole();
    let value = "x".repeat(1 << 20);
    let computer = &fleet.computers[leader];
    computer.within(|| {
        computer
            .client()
            .ok("setParam", params!["/test", "/large", value.as_str()])
    });
    fleet.await_same_state();
    delete_keys(&fleet, "/robot/values/");
    eventually("the leader has noticed it", || {
        !fleet.computers[leader]
            .logged("etcd has lost its data")
            .is_empty()
    });
    fleet.await_whole();
    let follower = &fleet.computers[(leader + 1) % 3];
    signal(follower.worker(), Signal::KILL);
    fleet.await_whole();
    fleet.await_same_state();
    let follower = &fleet.computers[(leader + 1) % 3];
    assert_eq!(follower.param("/large"), Some(value.as_str().into()));
    fleet.assert_nodes_live();
}

/// The older copy lacks what was written after it was made. That used to count as a change by others.
#[test]
fn an_older_copy_of_etcd_is_no_conflict_with_what_was_written_while_cut_off() {
    let _turn = turn();
    let mut fleet = Fleet::start(&[]);
    let leader = fleet.await_whole();
    fleet.computers[leader].set_param("/before", 1);
    fleet.await_same_state();
    for computer in &mut fleet.computers {
        computer.kill_etcd();
    }
    for computer in &mut fleet.computers {
        computer.save_etcd();
        computer.start_etcd();
    }
    let leader = fleet.await_whole();
    for value in 1..=20 {
        fleet.computers[leader].set_param("/later", value);
    }
    fleet.await_same_state();
    for computer in &mut fleet.computers {
        computer.kill_etcd();
    }
    for computer in &fleet.computers {
        let what = format!("{} is alone", computer.name);
        eventually(&what, || computer.role_is("alone"));
    }
    for value in 1..=11 {
        fleet.computers[leader].set_param(&format!("/leader{value}"), value);
        fleet.computers[(leader + 1) % 3].set_param(&format!("/follower{value}"), value);
    }
    fleet.computers[(leader + 1) % 3].set_param("/later", 100);
    for computer in &mut fleet.computers {
        computer.restore_etcd();
        computer.start_etcd();
    }
    fleet.await_whole();
    for computer in &fleet.computers {
        let has_all = || {
            let alone = (1..=11).all(|value| {
                let keys = [format!("/leader{value}"), format!("/follower{value}")];
                keys.iter()
                    .all(|key| computer.param(key) == Some(value.into()))
            });
            let later = computer.param("/later") == Some(100.into());
            alone && later && computer.param("/before") == Some(1.into())
        };
        let what = format!("{} has what was written", computer.name);
        eventually(&what, has_all);
        let lost = computer.status().unwrap()["cluster"]["lost_writes"].as_u64();
        assert_eq!(lost, Some(0), "{}", computer.name);
    }
    fleet.await_same_state();
    fleet.assert_nodes_live();
}
