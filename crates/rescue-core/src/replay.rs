//! Recognises a master, reads its state, and brings it to the state of the *mirror*, which is rosrescue's model of the
//! master. An *incarnation* is one life of a master process. An *injection* is the one call that brings a master to a
//! state.
//!
//! * [`Token`] and [`Inspection`] recognise a master and read the state of an unknown one.
//! * [`Plan`] is the one call that brings a new master to the mirror's state, and verifies the answer.
//! * [`treatment`] decides what to do with a master, by its token and by what is known about the master.
//! * [`reconcile`] computes the state for a master that has missed writes because it was unreachable.
//! * [`withheld_run_id`] and [`rosout_to_ask`] leave a new roscore what it does itself.
//! * [`accepted`] tells from a master's reply which parts of a call the master has executed.
//! * [`difference`] describes how two states differ.

mod accepted;
mod difference;
mod inspect;
mod plan;
mod reconcile;
mod restore;
mod roscore;
#[cfg(test)]
mod tests;
mod token;
mod treatment;
mod unordered;

pub use accepted::{Accepted, Answered, accepted};
pub use difference::difference;
pub use inspect::{Inspection, NotAMaster};
pub use plan::{Deviation, Plan, Skipped};
pub use reconcile::{Authority, may_hold, reconcile, registrants, without_ended};
pub use roscore::{
    ROSOUT, RUN_ID_AFTER, has_run_id, is_run_id_set, rosout_to_ask, withheld_run_id,
};
pub use token::{Token, TokenState};
pub use treatment::{KnownMaster, Treatment, treatment};
