//! Between the nodes and the master: listener, door, gate, lane, pool, mirror.

pub mod activity;
pub mod body;
pub mod clients;
pub mod door;
mod flight;
pub mod gate;
pub mod idle;
pub mod journey;
pub mod keeper;
pub mod lane;
pub mod listener;
pub mod look;
pub mod pace;
pub mod pool;
pub mod service;
pub mod shadow;
pub mod stats;
pub mod upstream;

use std::sync::atomic::{AtomicBool, AtomicU32};

use tokio::sync::Semaphore;

use crate::{admin::Board, config::Config, master::Mark, recovery::Nodes};

/// What every part of the proxy works with.
pub struct Proxy {
    /// What it runs with.
    pub config: Config,
    /// What others use as `ROS_MASTER_URI`.
    pub uri: String,
    /// Names of this computer, for the door.
    pub names: Vec<String>,
    /// Tells this process from every other; see [`upstream::INSTANCE_HEADER`].
    pub instance: String,
    /// Set when a request of our own came back to us: the master's address is our own.
    pub looped: AtomicBool,
    /// The mark that the master bears when it holds the state.
    pub mark: Mark,
    /// The gate.
    pub gate: gate::Gate,
    /// The way to the master for mutating calls.
    pub lane: lane::Lane,
    /// The way to the master for reads.
    pub pool: pool::Pool,
    /// The master.
    pub upstream: upstream::Upstream,
    /// The mirror and its checkpoint.
    pub shadow: shadow::Shadow,
    /// Who is connected.
    pub clients: clients::Clients,
    /// Those of them without a request.
    pub idle: idle::Idle,
    /// Memory for large bodies, in KiB.
    pub bodies: Semaphore,
    /// What was counted.
    pub stats: &'static stats::Stats,
    /// Process id of rosout, if we run it; else 0.
    pub rosout: AtomicU32,
    /// What people and monitors are told.
    pub board: Board,
    /// What is known of the nodes beyond their registrations.
    pub nodes: Nodes,
}
