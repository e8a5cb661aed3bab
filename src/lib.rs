//! rosrescue stands where the ROS 1 master stood. When the master dies it answers in its place, and brings
//! a new one to the same state.
//!
//! # Layout
//!
//! The *core* is pure: no runtime, no sockets, no files, no clock. Time comes in as an argument and
//! work goes out as values.
//!
//! * [`xmlrpc`]: XML-RPC text to values and back; knows nothing of ROS.
//! * [`master`]: the Master API as a state machine; what a master holds and is to hold, and the one call
//!   that brings it there.
//! * [`lifecycle`]: phases, deadlines, backoff, when the gate opens and shuts.
//! * [`census`]: what is to be made of what a node says of itself; which nodes are unreachable.
//! * [`session`]: whether a checkpoint's session goes on, and what state it holds.
//! * [`record`]: the checkpoint's snapshot and records to and from bytes.
//!
//! The *shell* does IO and decides as little as possible.
//!
//! * [`cli`], [`config`], [`ros_env`]: what is to be run, and what ROS's environment means.
//! * [`store`]: the checkpoint on the disk.
//! * [`guardian`]: the parent process that keeps the sockets and starts the worker again.
//! * [`proxy`]: listener, gate, write queue, read pool, and the ledger of mirror and journal.
//! * [`recovery`]: watching the master, examining and injecting; notifications and the health check of nodes.
//! * [`process`]: the processes of rosmaster and rosout, and those that an earlier rosrescue left behind.
//! * [`admin`]: the status page.
//! * [`clock`]: the one place that reads the wall clock.
//! * [`resolver`]: the addresses of hosts, by name servers that may not answer.
//! * [`wait`]: waiting for what may not be there.
//! * [`app`]: puts it all together.
//!
//! `docs/architecture.md` follows a call, and a record, through them by the names of functions.

pub mod admin;
pub mod app;
pub mod census;
pub mod cli;
pub mod clock;
pub mod config;
pub mod guardian;
pub mod lifecycle;
pub mod master;
pub mod process;
pub mod proxy;
pub mod record;
pub mod recovery;
pub mod resolver;
pub mod ros_env;
pub mod session;
pub mod store;
pub mod wait;
pub mod xmlrpc;
