//! What the unit tests of several crates share. No program uses this crate.
//!
//! * [`calls`]: calls to a master, and their answers.
//! * [`dice`]: random numbers that can be repeated.

#![allow(clippy::panic, reason = "for tests")]

pub mod calls;
pub mod dice;
