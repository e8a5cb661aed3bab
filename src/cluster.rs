//! Several computers: one leads, the others follow, and one of them takes over when it fails. The decisions are in
//! [`rescue_core::cluster`].
//!
//! * [`etcd`]: the keys `origin`, `leader` and `alive`, which decide who leads.
//! * [`survey`]: what is wrong with `--cluster`.
//! * [`replica`]: the robot's state in etcd.

pub mod etcd;
pub mod replica;
pub mod survey;
