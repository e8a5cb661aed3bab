use std::thread::{scope, sleep};
use std::time::{Duration, Instant};

use ros1_master::xmlrpc::Value;
use rustix::process::Signal;

use crate::chance::Chance;
use crate::computer::{NAMES, send};
use crate::fleet::{Fleet, TAKEOVER, TTL, victim};
use crate::support::{Control, Library, PATIENCE, State, eventually, holds, params};
use crate::traffic::{Named, TYPE, Traffic};
use crate::{rounds, turn};

/// Waits until the parameter has the value `value` on each computer.
#[track_caller]
fn await_param(fleet: &Fleet, key: &str, value: i32) {
    let all = || fleet.computers.iter().map(|computer| computer.param(key));
    let done = holds(PATIENCE, || {
        all().any(|found| found != Some(Value::Int(value)))
    });
    assert!(
        !done,
        "{key} is not {value} but {:?}",
        all().collect::<Vec<_>>()
    );
}

#[test]
fn a_computer_that_is_cut_off_serves_its_nodes_and_keeps_its_writes() {
    let _turn = turn();
    let mut chance = Chance::new();
    let mut fleet = Fleet::start(&["--alone", "serve"]);
    let traffic = Traffic::start(&fleet);
    for round in 0..rounds(1) {
        let leader = fleet.await_whole();
        let cut = victim(round, leader);
        let rest = fleet.others(cut);
        let contested = format!("/contested_{round}");
        fleet.computers[leader].set_param(&contested, 1);
        await_param(&fleet, &contested, 1);
        traffic.await_writes(&[0, 1, 2]);
        sleep(chance.time(Duration::from_secs(1)));
        let (mark, begin, control) = (fleet.mark(), Instant::now(), Control::start());
        fleet.network.cut_cable(cut);
        let next = fleet.await_leader_of(&rest);
        let led = begin.elapsed();
        let lonely = &fleet.computers[cut];
        eventually("the computer is alone", || lonely.role_is("alone"));
        let alone = begin.elapsed();
        traffic.await_writes(&[0, 1, 2]);
        lonely.set_param(&contested, 2);
        fleet.computers[next].set_param(&contested, 3);
        // The cut-off computer's nodes go on, and new nodes can be started there.
        let name = format!("late_{round}");
        let rename = format!("__name:={name}");
        let mut late = lonely.node(Library::Roscpp, "talker", &["30", &rename]);
        let listener = lonely.listener.as_ref().unwrap();
        listener.wait_messages(&format!("/{name}"), 1);
        fleet.assert_streams_whole(&[cut], &mark);
        fleet.assert_streams_whole(&rest, &mark);
        let mended = Instant::now();
        fleet.network.mend_cable(cut);
        fleet.await_whole();
        let healed = mended.elapsed();
        fleet.await_flow(&[0, 1, 2]);
        // The others' nodes receive messages from the node that was started while its computer was cut off.
        for &index in &rest {
            let listener = fleet.computers[index].listener.as_ref().unwrap();
            listener.wait_messages(&format!("/{name}"), 1);
        }
        traffic.await_writes(&[0, 1, 2]);
        let [write, read] = traffic.longest(&[0, 1, 2], begin);
        println!(
            "{} is cut off (leader {}): alone after {alone:.2?}, {} leads after {led:.2?}; whole {healed:.2?} after the \
             cable; longest write {write:.2?}, read {read:.2?}",
            NAMES[cut], NAMES[leader], NAMES[next],
        );
        // TCP takes a while to resume after a cable was mended. A read waits for the next leader if the follower's
        // mirror lacks the last record that the dead leader announced. The members of etcd learn from etcd's leader
        // that a record is committed, and that leader may have been cut off too.
        let limit = control.allows(TTL + TAKEOVER);
        assert!(
            led < limit && write < limit && read < limit,
            "longest read {read:?}, write {write:?}"
        );
        await_param(&fleet, &contested, 3);
        // The warning usually comes from the computer that was cut off. If etcd elects a leader meanwhile, another
        // computer may have been alone too. The warning is logged once the other computers have the writes.
        let warnings = || -> Vec<_> {
            let computers = fleet.computers.iter();
            let reported = computers.flat_map(|it| it.logged(&contested));
            reported.filter(|line| line.contains("WARN")).collect()
        };
        eventually("the lost write is reported", || !warnings().is_empty());
        let warnings = warnings();
        assert_eq!(warnings.len(), 1, "{warnings:#?}");
        send(&late, Signal::TERM);
        late.wait();
        traffic.assert_nothing_lost(&fleet);
        fleet.assert_nodes_live();
    }
}

/// The computer is cut off for the second time as soon as the first time is over, whether or not its writes have
/// reached the leader.
#[test]
fn a_computer_that_is_cut_off_twice_continues_from_its_own_writes() {
    let _turn = turn();
    let mut fleet = Fleet::start(&["--alone", "serve"]);
    let leader = fleet.await_whole();
    let cut = (leader + 1) % 3;
    let lonely = &fleet.computers[cut];
    for value in 1..=3 {
        fleet.network.cut_cable(cut);
        eventually("the computer is alone", || lonely.role_is("alone"));
        if value > 1 {
            assert_eq!(lonely.param("/count"), Some(Value::Int(value - 1)));
        }
        lonely.set_param("/count", value);
        lonely.set_param(&format!("/written_{value}"), value);
        fleet.network.mend_cable(cut);
        eventually("the computer is not alone any more", || {
            !lonely.role_is("alone")
        });
    }
    fleet.await_whole();
    await_param(&fleet, "/count", 3);
    for value in 1..=3 {
        await_param(&fleet, &format!("/written_{value}"), value);
    }
    let lonely = &fleet.computers[cut];
    assert!(lonely.logged("cut off was lost").is_empty());
    assert!(lonely.logged("cannot be kept").is_empty());
    fleet.await_same_state();
    fleet.assert_nodes_live();
}

/// The kernel sends what was written to a connection again and again, also after its computer has answered the call
/// itself.
#[test]
fn a_call_that_a_cut_cable_held_up_does_not_replace_a_later_one() {
    let _turn = turn();
    let mut fleet = Fleet::start(&["--alone", "serve"]);
    let leader = fleet.await_whole();
    let cut = (leader + 1) % 3;
    let lonely = &fleet.computers[cut];
    // Its connection to the leader exists.
    lonely.set_param("/contested", 0);
    fleet.network.cut_cable(cut);
    lonely.set_param("/contested", 1);
    assert!(lonely.role_is("alone"));
    fleet.network.mend_cable(cut);
    fleet.computers[leader].set_param("/contested", 2);
    fleet.await_whole();
    let stays = holds(Duration::from_secs(2), || {
        fleet.computers[leader].param("/contested") == Some(Value::Int(2))
    });
    assert!(stays, "{:?}", fleet.computers[leader].param("/contested"));
    await_param(&fleet, "/contested", 2);
    fleet.await_same_state();
    fleet.assert_nodes_live();
}

#[test]
fn with_alone_refuse_writes_to_a_computer_that_is_cut_off_wait() {
    let _turn = turn();
    let mut fleet = Fleet::start(&["--alone", "refuse"]);
    let leader = fleet.await_whole();
    fleet.computers[leader].set_param("/steady", 7);
    for cut in [leader, (leader + 1) % 3] {
        await_param(&fleet, "/steady", 7);
        // A computer answers no reads while it lacks a record that the leader has announced to it. The last such records
        // are of the leader's own rosout, which starts after a takeover.
        let leads = &fleet.computers[fleet.await_whole()];
        eventually("the leader's rosout is registered", || {
            let client = leads.client();
            let rosout = leads.within(|| client.ask("lookupNode", params!["/test", "/rosout"]));
            let is_its_own = rosout.is_some_and(|api| {
                api.as_str()
                    .is_some_and(|api| api.contains(&leads.address()))
            });
            // The subscription comes last.
            let nodes = leads.within(|| State::read_subscribers(&client, "/rosout"));
            is_its_own && nodes.is_some_and(|nodes| !nodes.is_empty())
        });
        fleet.await_same_state();
        let key = format!("/written_{cut}");
        fleet.network.cut_cable(cut);
        let lonely = &fleet.computers[cut];
        eventually("the computer is alone", || lonely.role_is("alone"));
        fleet.await_leader_of(&fleet.others(cut));
        eventually("the computer runs no master", || {
            lonely.master_state().is_err()
        });
        let answer = scope(|scope| {
            let write = || {
                let params = params!["/test", key.as_str(), 1];
                lonely.within(|| lonely.client().status("setParam", params))
            };
            let write = scope.spawn(write);
            let waits = holds(Duration::from_secs(2), || {
                assert_eq!(lonely.param("/steady"), Some(Value::Int(7)));
                !write.is_finished()
            });
            assert!(waits, "the write was answered: {:?}", write.join());
            fleet.network.mend_cable(cut);
            write.join().unwrap()
        });
        fleet.await_whole();
        println!("a write to {} waited until: {answer:?}", NAMES[cut]);
        if answer.is_ok() {
            await_param(&fleet, &key, 1);
        }
        fleet.await_flow(&[0, 1, 2]);
        fleet.await_same_state();
        fleet.assert_nodes_live();
    }
}

/// A computer that was cut off has another list of publishers. It must not send that list to the others' nodes, which
/// would drop a stream.
#[test]
fn a_computer_that_was_cut_off_does_not_notify_nodes_of_others() {
    let _turn = turn();
    let mut fleet = Fleet::start(&[]);
    for round in 0..rounds(2) {
        let leader = fleet.await_whole();
        let cut = victim(round, leader);
        let rest = fleet.others(cut);
        let (lonely, healthy) = (&fleet.computers[cut], &fleet.computers[rest[0]]);
        let topic = format!("/of_both_{round}");
        let subscribers = ["one", "two", "three"]
            .map(|name| Named::new(healthy, &format!("/subscriber_{name}_{round}")));
        for subscriber in &subscribers {
            healthy.within(|| subscriber.it().subscribe(&healthy.client(), &topic, TYPE));
        }
        fleet.await_same_state();
        fleet.network.cut_cable(cut);
        eventually("the computer is alone", || lonely.role_is("alone"));
        fleet.await_leader_of(&rest);
        let publishers = [lonely, healthy].map(|computer| {
            let publisher = Named::new(computer, &format!("/publisher_{}_{round}", computer.name));
            computer.within(|| publisher.it().publish(&computer.client(), &topic, TYPE));
            publisher
        });
        let [of_lonely, of_healthy] = [0, 1].map(|nth| publishers[nth].it().api.clone());
        // Calls one by one, because the master of the cut-off computer repeats its attempts to reach the subscribers.
        for _ in 0..20 {
            lonely.within(|| {
                publishers[0].it().unpublish(&lonely.client(), &topic);
                publishers[0].it().publish(&lonely.client(), &topic, TYPE);
            });
        }
        let heard = |of: &Named| of.it().updates(&topic);
        eventually("the subscribers know their publisher", || {
            subscribers
                .iter()
                .all(|it| heard(it).last() == Some(&vec![of_healthy.clone()]))
        });
        let before = subscribers.each_ref().map(|it| heard(it).len());
        fleet.network.mend_cable(cut);
        fleet.await_whole();
        let all = |it: &Named| {
            let last = heard(it).pop().unwrap_or_default();
            last.contains(&of_lonely) && last.contains(&of_healthy)
        };
        eventually("the subscribers know both publishers", || {
            subscribers.iter().all(all)
        });
        // TCP retransmits after 1, 2, 4 and 8 seconds.
        holds(Duration::from_secs(8), || subscribers.iter().all(all));
        for (subscriber, before) in subscribers.iter().zip(before) {
            let since = heard(subscriber).split_off(before);
            let dropped = since
                .iter()
                .find(|publishers| !publishers.contains(&of_healthy));
            assert_eq!(
                dropped,
                None,
                "round {round}, {}: {since:?}",
                subscriber.it().name
            );
        }
        for (computer, publisher) in [lonely, healthy].into_iter().zip(&publishers) {
            computer.within(|| publisher.it().unpublish(&computer.client(), &topic));
        }
        for subscriber in &subscribers {
            healthy.within(|| subscriber.it().unsubscribe(&healthy.client(), &topic));
        }
    }
    fleet.await_same_state();
    fleet.assert_nodes_live();
}
