//! Common parts of the nodes. `tests/field/clients/measure.py` describes what they do and print.

use std::fmt::{Debug, Display};
use std::time::{Duration, Instant};

/// Pause between two calls.
pub const PAUSE: Duration = Duration::from_millis(200);
/// Pause between two messages.
pub const TICK: Duration = Duration::from_millis(100);

rosrust::rosmsg_include!(std_msgs / String, std_srvs / Trigger);

/// The node's name, which is the only argument.
pub fn name() -> String {
    std::env::args().nth(1).expect("usage: PROGRAM NAME")
}

pub fn say(what: impl Display) {
    println!("{what}");
}

/// Prints how call `number` of a kind ended, and how long it took in milliseconds.
pub fn outcome<E: Debug>(what: &str, number: i32, start: Instant, result: Result<(), E>) {
    let ms = start.elapsed().as_millis();
    match result {
        Ok(()) => say(format_args!("{what} {number} {ms}")),
        Err(error) => say(format!("{what}-failed {number} {ms} {error:?}").replace('\n', " ")),
    }
}
