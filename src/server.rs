//! The side of rosrescue that clients talk to: listener, admission, calls and pages.

pub(crate) mod access;
pub(crate) mod answers;
pub(crate) mod body;
pub(crate) mod calls;
pub(crate) mod clients;
pub(crate) mod compare;
pub(crate) mod deadlines;
pub(crate) mod hold;
pub(crate) mod hosts;
pub(crate) mod idle;
pub mod listener;
pub(crate) mod others;
pub(crate) mod pages;
pub(crate) mod replies;
pub(crate) mod service;

use std::sync::{Arc, Mutex};

use tokio::sync::{Notify, Semaphore};

use self::{
    access::{AccessRules, LastLogged},
    answers::AnswerMemory,
    calls::Calls,
    clients::Clients,
    idle::Idle,
    pages::Pages,
};
use crate::status::stats::Stats;

/// What every request handler needs.
pub struct Server {
    /// Names of this computer, for the checks on `Host` and `Origin`.
    pub names: Vec<String>,
    /// The networks that may call and make changes.
    pub(crate) access: AccessRules,
    /// When each refused address was last logged.
    pub(crate) refused: Mutex<LastLogged>,
    /// Signals that a request from this rosrescue has arrived here: the master's address leads back to it.
    pub looped: Arc<Notify>,
    pub clients: Arc<Clients>,
    /// Connections without a request in progress.
    pub idle: Idle,
    /// Largest body, in bytes.
    pub max_body: usize,
    /// Memory for large request bodies, in KiB.
    pub bodies: Semaphore,
    /// Memory for large answers.
    pub answers: Arc<AnswerMemory>,
    pub stats: &'static Stats,
    pub calls: Calls,
    pub pages: Pages,
}
