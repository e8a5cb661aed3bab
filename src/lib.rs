//! rosrescue is a proxy in front of the ROS 1 master. When the master dies, it answers in the master's place,
//! and brings a new one to the same state.
//!
//! # Layout
//!
//! What is decided without IO is in crates of its own: `ros1_master` (XML-RPC and the Master API as a state machine) and
//! `rescue_core` (checkpoint format, recovery, node health, the order of notifications, several computers). The checkpoint
//! on the disk is in `checkpoint_store`, etcd's client in `etcd_kv`.
//!
//! This crate does IO and decides as little as possible. From the bottom to the top:
//!
//! * `clock`: the wall clock. `limit`, [`logging`]: how often a line is logged; where the log goes. `printable`: foreign
//!   text, made safe to print. `task`, `wait`: starting tasks; waiting for optional events.
//! * [`cli`], [`ros_env`], [`config`], `resolver`: command line, ROS's environment variables, configuration, addresses of
//!   hosts.
//! * [`cluster`]: the robot's keys in etcd, for several computers.
//! * `gate`: whether calls pass to the master.
//! * `status`: plain data for people and monitors, filled by other modules.
//! * `ledger`: mirror and journal under one lock.
//! * `upstream`: connections to the master and to other computers.
//! * `write_queue`: writes on their way to the master, in order.
//! * [`guardian`]: the parent process that keeps the sockets and restarts the worker.
//! * `process`: the processes of rosmaster and rosout, and orphans of an earlier rosrescue.
//! * `nodes`: calls to nodes: health check and notifications.
//! * `recovery`: watching the master, reading its state, and restoring it.
//! * `roscore`: roscore's other duties.
//! * `server`: the side that clients talk to.
//! * [`app`]: assembles the program.
//! * [`commands`]: the commands that do not serve nodes.
//! * [`program`]: arguments, logging, signals and exit statuses.
//!
//! `docs/architecture.md` names the functions that a call and a record pass on their way through these modules.

pub mod app;
pub mod cli;
pub mod clock;
pub mod cluster;
pub mod commands;
pub mod config;
pub(crate) mod gate;
pub mod guardian;
pub(crate) mod ledger;
pub(crate) mod limit;
pub mod logging;
pub(crate) mod nodes;
pub(crate) mod printable;
pub(crate) mod process;
pub mod program;
pub(crate) mod recovery;
pub(crate) mod resolver;
pub mod ros_env;
pub(crate) mod roscore;
pub(crate) mod server;
pub(crate) mod status;
pub(crate) mod task;
pub(crate) mod upstream;
pub(crate) mod wait;
pub(crate) mod write_queue;

pub use server::listener;
