//! Knowing a master again, learning what it holds, and bringing it to the mirror's state.
//!
//! * [`Token`] and [`Inspection`]: recognising a master, and learning the state of an unknown one.
//! * [`Plan`]: the one call that brings a new master to the mirror's state, and its verification.
//! * [`reconcile`]: what a master that was out of reach is to hold when it is reached again.
//! * [`accepted`]: what of a call a master has done, by its reply.
//! * [`difference`]: what two states do not have in common, for people.

mod accepted;
mod difference;
mod inspect;
mod plan;
mod reconcile;
mod restore;
mod token;

pub use accepted::{Accepted, Answered, accepted};
pub use difference::difference;
pub use inspect::{Inspection, NotAMaster};
pub use plan::{Plan, Skipped};
pub use reconcile::{Authority, may_hold, reconcile};
pub use token::{Bears, Token};
