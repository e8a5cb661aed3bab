//! The Master and Parameter API as a pure state machine.
//!
//! * [`Master`]: a complete master without IO. [`Master::apply`] answers a call as rosmaster does.
//! * [`kind`] and [`accepted`]: what a call may do, and what of it a master has done.
//! * [`Token`] and [`Inspection`]: recognising a master, and learning the state of an
//!   unknown one.
//! * [`Plan`]: the one call that brings a new master to the mirror's state, and its verification.
//! * [`reconcile`]: what a master that was out of reach is to hold when it is reached again.
//! * [`difference`]: what two states do not have in common, for people.
//!
//! Everything follows rosmaster 1.15.15 under Python 3.11, function by function; its quirks are
//! kept, because clients see them.

mod accepted;
mod api;
mod checks;
mod difference;
mod inspect;
mod kind;
mod methods;
mod multicall;
mod names;
mod notice;
mod params;
mod plan;
mod python;
mod reconcile;
mod registry;
mod restore;
mod snapshot;
mod state;
mod tell;
#[cfg(test)]
mod tests;
mod token;
mod updates;

pub use accepted::{Accepted, Agreement, Answered, accepted, is_success};
pub use api::Outcome;
pub use difference::difference;
pub use inspect::{Inspection, NotAMaster};
pub use kind::{Kind, is_answerable, kind, writes};
pub use names::CALLER_ID;
pub use notice::{Notice, NoticeSink};
pub use plan::{Mismatch, Plan, Skipped};
pub use reconcile::{Authority, may_hold, reconcile};
pub use snapshot::{ServiceEntry, Snapshot, SnapshotNode};
pub use state::{Counts, InvalidSnapshot, Master};
pub use tell::{is_plain_topic, param_update, publisher_update, registrant, shutdown};
pub use token::{Bears, Token};
