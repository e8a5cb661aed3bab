//! Recognises a master, reads its state, and brings it to the mirror's state.
//!
//! * [`Token`] and [`Inspection`] recognise a master and read the state of an unknown one.
//! * [`Plan`] is the one call that brings a new master to the mirror's state, and verifies the answer.
//! * [`treatment`] decides what to do with a master, by its token and by what is known of it.
//! * [`reconcile`] computes the state for a master that was unreachable.
//! * [`accepted`] tells from a master's reply which parts of a call it has executed.
//! * [`difference`] describes how two states differ.

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
pub use treatment::{KnownMaster, Treatment, treatment};
