//! The ROS 1 Master API as a pure state machine, and XML-RPC as rosmaster and its clients speak it.
//!
//! * [`master`]: the Master and Parameter API. [`Master::apply`](master::Master::apply) answers a call as rosmaster
//!   does, and lists the notifications that rosmaster would send to nodes.
//! * [`xmlrpc`]: XML-RPC text to values and back. It knows nothing of ROS.
//!
//! Nothing here opens a socket, reads a clock or starts a thread.

pub mod master;
pub mod xmlrpc;
