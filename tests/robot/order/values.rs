//! A node that is notified of a parameter again and again never gets an older value after a newer one, and finally gets
//! the last one. The simulation of the write queue plays this without deaths, too.

use std::thread;
use std::time::{Duration, Instant};

use ros1_master::xmlrpc::Value;

use crate::support::{
    Mode, Robot, State, eventually,
    writers::{Subscriber, WRITERS, key, topic, write},
};

/// Maximum pause between two calls of a writer. All writers together make some 600 calls per second.
const PAUSE: Duration = Duration::from_millis(18);
const TIME: Duration = Duration::from_secs(4);

#[test]
fn no_value_goes_back_while_the_mirror_answers_first_and_the_master_dies_again_and_again() {
    let options = ["--no-rosout", "--writes", "mirror"];
    no_value_goes_back(Robot::start_with(Mode::Core, &options));
}

#[test]
fn no_value_goes_back_while_the_master_dies_again_and_again() {
    no_value_goes_back(Robot::start(Mode::Proxy));
}

#[track_caller]
fn no_value_goes_back(mut robot: Robot) {
    let master = &robot.client();
    let seed = u64::from(std::process::id()) << 20;
    println!("seed {seed}");
    let subscribers = Subscriber::start_all(master);
    let mut outages = Vec::new();
    let calls = thread::scope(|scope| {
        let start = |writer| scope.spawn(move || write(master, writer, seed, PAUSE, TIME).len());
        let writers: Vec<_> = (0..WRITERS).map(start).collect();
        for _ in 0..2 {
            let begin = Instant::now();
            robot.crash_master();
            outages.push(begin..Instant::now());
        }
        let calls = writers.into_iter().map(|writer| writer.join().unwrap());
        calls.sum::<usize>()
    });
    let (mut told, mut back) = (0, Vec::new());
    for (number, subscriber) in subscribers.iter().enumerate() {
        for writer in 0..WRITERS {
            let (key, topic) = (key(writer), topic(writer));
            let value = master.param(&key).and_then(|value| value.as_int());
            eventually(
                &format!("subscriber {number} gets the last value of {key}"),
                || {
                    let told = subscriber.told();
                    told.values
                        .get(&key)
                        .and_then(|updates| updates.last())
                        .map(|last| last.value)
                        == value
                },
            );
            eventually(
                &format!("subscriber {number} gets the last publishers of {topic}"),
                || {
                    // No process listens at the addresses of the writers, so a rescue's health check
                    // unregisters them, possibly while the state is read.
                    let Ok(state) = State::try_read(master) else {
                        return false;
                    };
                    let publishers = state.publishers_of(&topic).len();
                    let told = subscriber.told();
                    let last = told.publishers.get(&topic).and_then(|lists| lists.last());
                    last.and_then(Value::as_array).map(<[Value]>::len) == Some(publishers)
                },
            );
            let mut updates = subscriber.told().values[&key].clone();
            told += updates.len();
            // The subscriber may read what the killed master has sent after what rosrescue sent next.
            updates.dedup_by(|now, before| {
                now.value < before.value
                    && before.from_rosrescue
                    && !now.from_rosrescue
                    && outages.iter().any(|outage| outage.contains(&now.at))
            });
            let values: Vec<_> = updates.iter().map(|update| update.value).collect();
            let steps = (1..values.len()).filter(|&at| values[at] < values[at - 1]);
            let around = steps.map(|at| &values[at.saturating_sub(4)..values.len().min(at + 4)]);
            back.extend(around.map(|values| format!("subscriber {number}: {key} {values:?}")));
        }
    }
    println!(
        "{calls} calls, {told} notifications of values, {} went back",
        back.len()
    );
    assert!(
        back.is_empty(),
        "{} values went back:\n{}",
        back.len(),
        back.join("\n")
    );
}
