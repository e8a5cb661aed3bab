//! What every part works with.

use std::sync::atomic::AtomicU32;

use tokio::sync::{Notify, Semaphore};

use crate::{
    config::Config,
    gate, ledger,
    nodes::Nodes,
    server::{clients, idle},
    status::{Board, stats},
    upstream::{self, pool},
    write_queue,
};

/// What every part of the proxy works with.
pub struct Proxy {
    /// What it runs with.
    pub config: Config,
    /// What others use as `ROS_MASTER_URI`.
    pub uri: String,
    /// Names of this computer, for the checks on `Host` and `Origin`.
    pub names: Vec<String>,
    /// Tells this process from every other; see [`upstream::INSTANCE_HEADER`].
    pub instance: String,
    /// Notified when a request of our own came back to us: the master's address is our own.
    pub looped: Notify,
    /// Whether calls pass to the master.
    pub gate: gate::Rx,
    /// Notified when the master has not answered a call for longer than it should take.
    pub slow: Notify,
    /// The way to the master for writes.
    pub write_queue: write_queue::WriteQueue,
    /// The way to the master for reads.
    pub pool: pool::Pool,
    /// The master.
    pub upstream: upstream::Upstream,
    /// The mirror and its journal.
    pub ledger: ledger::Ledger,
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
