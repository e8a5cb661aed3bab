//! Several computers: one leads, the others follow, and one of them takes over.
//!
//! Two keys in etcd, below the robot's prefix, decide who leads. `leader` says who, and its revision is the
//! *term*. `alive` is written by every transaction of the leader, at least four times in the time to live.
//! Whoever has seen no change of both for the time to live, by its own clock, may claim. Every transaction of
//! the leader succeeds only if `leader` has its term and `alive` is as the previous one left it. So one that
//! was cut off can commit nothing, and one that is sent twice has its effect once. The records of calls are
//! in `journal/`, and travel in the same transaction. See decision 29.
//!
//! * [`displaced`]: who is to be told to shut down by the next leader.
//! * [`machine`]: who leads, and what may be acknowledged.
//! * [`member`]: what one computer follows, adopts, answers, gives and merges, and when it has a master.
//! * [`outgoing`], [`cut_off`], [`sharing`], [`standing`]: parts of that.
//! * [`journal`]: records and snapshots to and from keys and values.
//! * [`merge`]: what of the writes of a computer that was alone still holds.
//! * [`namesake`]: another computer with this one's name.

pub mod cut_off;
pub mod displaced;
pub mod journal;
pub mod machine;
pub mod member;
pub mod merge;
mod mutant;
pub mod namesake;
pub mod outgoing;
pub mod sharing;
pub mod standing;
#[cfg(test)]
mod tests;
