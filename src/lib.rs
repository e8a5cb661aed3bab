//! rosrescue stands where the ROS 1 master stood. When the master dies it answers in its place, and brings
//! a new one to the same state.
//!
//! # Layout
//!
//! The *core* is pure: no runtime, no sockets, no files, no clock. Time comes in as an argument and
//! work goes out as values.
//!
//! * [`xmlrpc`]: XML-RPC text to values and back; knows nothing of ROS.
//! * [`master`]: the Master API as a state machine.
//! * [`replay`]: knowing a master again, learning what it holds, and the one call that brings it to a state.
//! * [`lifecycle`]: phases, deadlines, backoff, when the gate opens and shuts.
//! * `health`: what is to be made of what a node says of itself; which nodes are unreachable.
//! * [`checkpoint::session`]: whether a checkpoint's session goes on, and what state it holds.
//! * [`checkpoint::format`]: the checkpoint's snapshot and records to and from bytes.
//!
//! The *shell* does IO and decides as little as possible. From the bottom to the top:
//!
//! * [`cli`], [`config`], [`ros_env`]: what is to be run, and what ROS's environment means.
//! * `clock`, `resolver`, `wait`: the wall clock; addresses of hosts; waiting for what may not be there.
//! * `gate`: whether calls pass to the master.
//! * `status`: plain data for people and monitors, which others fill.
//! * [`checkpoint::store`]: the checkpoint on the disk.
//! * `ledger`: mirror and journal under one lock.
//! * `upstream`: connections to the master.
//! * `write_queue`: where writes wait for the master.
//! * `process`: the processes of rosmaster and rosout, and those that an earlier rosrescue left behind.
//! * `nodes`: calls to nodes: health check and notifications.
//! * `recovery`: watching the master, examining and injecting.
//! * `roscore`: roscore's other duties.
//! * `server`: what clients talk to.
//! * [`guardian`]: the parent process that keeps the sockets and starts the worker again.
//! * [`app`]: puts it all together.
//!
//! `docs/architecture.md` follows a call, and a record, through them by the names of functions.

pub mod app;
pub mod checkpoint;
pub mod cli;
pub mod clock;
pub mod config;
pub(crate) mod gate;
pub mod guardian;
pub(crate) mod health;
pub(crate) mod ledger;
pub mod lifecycle;
pub mod master;
pub(crate) mod nodes;
pub(crate) mod process;
pub(crate) mod recovery;
pub mod replay;
pub(crate) mod resolver;
pub mod ros_env;
pub(crate) mod roscore;
pub(crate) mod server;
pub(crate) mod status;
pub(crate) mod upstream;
pub(crate) mod wait;
pub(crate) mod write_queue;
pub mod xmlrpc;

pub use server::listener;
