//! The Master and Parameter API as a pure state machine.
//!
//! * [`Master`]: a complete master without IO. [`Master::apply`] answers a call as rosmaster does.
//! * [`Request`]: a call, parsed once; its [`Method`] and its [`Kind`].
//!
//! Everything follows rosmaster 1.15.15 under Python 3.11, function by function, including quirks that
//! clients see. Only texts of errors that no ROS client provokes are our own.

pub(crate) mod api;
pub(crate) mod checks;
mod forget;
pub(crate) mod kind;
mod methods;
pub(crate) mod multicall;
pub(crate) mod names;
mod notice;
pub(crate) mod params;
pub(crate) mod registry;
mod request;
pub(crate) mod returnable;
pub(crate) mod snapshot;
pub(crate) mod state;
mod tell;
#[cfg(test)]
mod tests;
mod updates;

pub use api::{Applied, Method, is_success};
pub use kind::Kind;
pub use multicall::entry_reply;
pub use names::CALLER_ID;
pub(crate) use names::{name_for, param_name_for};
pub use notice::{Notice, NoticeSink};
pub use request::{Entry, Request};
pub(crate) use returnable::is_readable;
pub use snapshot::{ServiceEntry, Snapshot, SnapshotNode};
pub use state::{Counts, InvalidSnapshot, Master};
pub use tell::{
    Displaced, MASTER, PARAM_UPDATE, PUBLISHER_UPDATE, get_pid, is_plain_topic, param_update,
    publisher_update, question, shutdown,
};
