//! Recognises a master, reads its state, and brings it to the mirror's state.
//!
//! * [`Token`] and [`Inspection`]: recognising a master, and reading the state of an unknown one.
//! * [`Plan`]: the one call that brings a new master to the mirror's state, and its verification.
//! * [`treatment`]: what is done with a master, by what it bears and what is known of it.
//! * [`reconcile`]: the state for a master that was unreachable.
//! * [`accepted`]: which parts of a call a master has executed, by its reply.
//! * [`difference`]: how two states differ, for people.

mod accepted;
mod difference;
mod inspect;
mod order;
mod plan;
mod reconcile;
mod restore;
#[cfg(test)]
mod tests;
mod token;
mod treatment;

pub use accepted::{Accepted, Answered, accepted};
pub use difference::difference;
pub use inspect::{Inspection, NotAMaster};
pub use plan::{Plan, Skipped};
pub use reconcile::{Authority, may_hold, reconcile};
pub use token::{Bears, Token};
pub use treatment::{Known, Treatment, treatment};
