//! The Master and Parameter API as a pure state machine.
//!
//! * [`Master`]: a complete master without IO. [`Master::apply`] answers a call as rosmaster does.
//! * [`kind`]: what a call may do.
//!
//! Everything follows rosmaster 1.15.15 under Python 3.11, function by function; its quirks are
//! kept, because clients see them.

pub(crate) mod api;
pub(crate) mod checks;
pub(crate) mod kind;
mod methods;
pub(crate) mod multicall;
pub(crate) mod names;
mod notice;
pub(crate) mod params;
pub(crate) mod python;
pub(crate) mod registry;
pub(crate) mod snapshot;
pub(crate) mod state;
mod tell;
#[cfg(test)]
mod tests;
mod updates;

pub use api::{Applied, is_success};
pub use kind::{Kind, is_answerable, kind, writes};
pub use names::CALLER_ID;
pub use notice::{Notice, NoticeSink};
pub use snapshot::{ServiceEntry, Snapshot, SnapshotNode};
pub use state::{Counts, InvalidSnapshot, Master};
pub use tell::{is_plain_topic, param_update, publisher_update, registrant, shutdown};
