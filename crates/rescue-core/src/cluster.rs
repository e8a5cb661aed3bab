//! Several computers: one leads, the others follow, and one of them takes over when it fails.
//!
//! Two keys in etcd, below the robot's prefix, decide who leads. `leader` names the leader, and its revision is the
//! *term*. Every transaction of the leader writes `alive`, at least four times per time to live. A computer that has
//! seen no change of either key for the time to live, by its own clock, may claim leadership. A leader's transaction
//! succeeds only if `leader` has its term and `alive` is as the previous transaction left it. So a leader that is cut
//! off cannot commit, and a transaction that is sent twice takes effect once. The records of calls are in `journal/`,
//! and are written in the same transaction. See decision 29.
//!
//! * [`displaced`]: nodes that the next leader must tell to shut down.
//! * [`machine`]: who leads, and what may be acknowledged.
//! * [`member`]: what one computer follows, answers, writes to the journal and merges, and when it runs a master.
//! * [`standing`]: who has the master, and where calls go.
//! * [`sharing`]: changes that the other computers must get; [`outgoing`]: those that are not in the journal yet.
//! * [`cut_off`]: the partition writes of this computer.
//! * [`journal`]: records and snapshots to and from keys and values.
//! * [`merge`]: which partition writes still hold.
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
