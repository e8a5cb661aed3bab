//! rosrescue stands where the ROS 1 master stood and brings its state back when it dies.
//!
//! # Layout
//!
//! The *core* is pure: no runtime, no sockets, no files, no clock. Time comes in as an argument and
//! work goes out as values.
//!
//! * [`xmlrpc`]: XML-RPC text to values and back; knows nothing of ROS.
//! * [`master`]: the Master API as a state machine, the look at a foreign master, the injection plan.
//! * [`record`]: the checkpoint's snapshot and journal records to and from bytes, with check sums.
//!
//! The *shell* does the work and decides nothing:
//!
//! * [`store`]: the checkpoint on disk: lock, load, append, sync, compaction.

pub mod cli;
pub mod config;
pub mod lifecycle;
pub mod master;
pub mod record;
pub mod ros_env;
pub mod store;
pub mod xmlrpc;
