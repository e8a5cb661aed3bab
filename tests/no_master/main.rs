//! A robot without a master: nodes start, find each other, talk, are displaced and end as if there were one, and
//! are notified of what they must know; the next master is given what came of it.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

mod life;
mod namesakes;
mod notifications;
mod start;
#[path = "../support/mod.rs"]
mod support;
mod tools;

use support::{Library, Robot, eventually};

const LIBRARIES: [(Library, &str); 2] = [(Library::Rospy, "py"), (Library::Roscpp, "cpp")];

/// Kills the master, and waits until the mirror stands in.
#[track_caller]
fn take_master_away(robot: &mut Robot) {
    robot.kill_master();
    eventually("the mirror stands in", || !robot.is_open());
}
