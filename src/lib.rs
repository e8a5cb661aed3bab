//! rosrescue stands where the ROS 1 master stood and brings its state back when it dies.
//!
//! # Layout
//!
//! The *core* is pure: no runtime, no sockets, no files, no clock. Time comes in as an argument and
//! work goes out as values.
//!
//! * [`lifecycle`]: phases, deadlines, backoff, when the gate opens and shuts.
//! * [`xmlrpc`]: XML-RPC text to values and back; knows nothing of ROS.
//! * [`master`]: the Master API as a state machine, the look at a foreign master, the injection plan.

pub mod cli;
pub mod config;
pub mod lifecycle;
pub mod master;
pub mod ros_env;
pub mod xmlrpc;
