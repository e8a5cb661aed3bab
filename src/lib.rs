//! rosrescue stands where the ROS 1 master stood and brings its state back when it dies.
//!
//! # Layout
//!
//! The *core* is pure: no runtime, no sockets, no files, no clock. Time comes in as an argument and
//! work goes out as values.
//!
//! * [`xmlrpc`]: XML-RPC text to values and back; knows nothing of ROS.
//! * [`master`]: the Master API as a state machine, inspecting a foreign master, reconciling,
//!   the injection plan.
//! * [`lifecycle`]: phases, deadlines, backoff, when the gate opens and shuts.
//! * [`census`]: what is to be made of what a node says of itself; who is suspect.
//! * [`session`]: whether a checkpoint's session goes on.
//! * [`record`]: the checkpoint's snapshot and records to and from bytes.
//!
//! The *shell* does IO and decides as little as possible.
//!
//! * [`cli`], [`config`], [`ros_env`]: what is to be run, and what ROS's environment means.
//! * [`store`]: the checkpoint on the disk.
//! * [`guardian`]: the parent process that keeps the sockets and starts the worker again.
//! * [`proxy`]: listener, admission, gate, write queue, pool, ledger, checkpointer.
//! * [`recovery`]: watching the master, reconciling and injecting, notifications, census.
//! * [`process`]: the processes of rosmaster and rosout.
//! * [`admin`]: the status page.
//! * [`resolver`]: the addresses of hosts, by name servers that may not answer.
//! * [`wait`]: waiting for what may not be there.
//! * [`app`]: puts it all together.

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
