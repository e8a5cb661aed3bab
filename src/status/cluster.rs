//! What is known of the other computers.

use std::time::{Duration, Instant};

use crate::cluster::machine::Role;

/// How this computer takes part, and what it knows of the others. Filled by `app::cluster`.
#[derive(Clone, Debug)]
pub struct ClusterFacts {
    /// This computer's name.
    pub name: String,
    pub role: Role,
    /// Since when it has this role.
    pub since: Instant,
    /// Who leads, as far as is known; the last one while there is none.
    pub leader: Option<LeaderFacts>,
    /// Since when nobody leads, as far as is known: the last leader gave up, or is silent. None while somebody does.
    pub leaderless: Option<Instant>,
    /// The journal's last record that is known.
    pub seq: u64,
    /// How many records of it this computer's mirror lacks.
    pub behind: u64,
    /// Writes that were made here and that etcd does not have yet.
    pub uncommitted: u64,
    /// Why etcd does not answer, and since when; none if it does.
    pub etcd: Option<(Instant, String)>,
    /// All computers that have ever taken part, this one included.
    pub members: Vec<MemberFacts>,
    /// Times that this computer has taken over.
    pub takeovers: u64,
    pub last_takeover: Option<Takeover>,
    /// Writes answered alone that did not hold, because others had changed the same meanwhile.
    pub lost_writes: u64,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LeaderFacts {
    pub name: String,
    /// Where nodes and other computers reach it.
    pub uri: String,
    /// Of its rosrescue.
    pub version: String,
    /// Grows with each leader.
    pub term: u64,
    /// Since when this computer knows of it.
    pub since: Instant,
}

/// A computer, as it said last.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MemberFacts {
    pub name: String,
    pub uri: String,
    pub version: String,
    pub role: Role,
    /// The journal's last record in its mirror.
    pub seq: u64,
    /// When it was heard of last; none if not since this rosrescue started.
    pub heard: Option<Instant>,
}

impl MemberFacts {
    /// How often a computer says how it is.
    pub const SAYS_EVERY: Duration = Duration::from_secs(5);
    /// A computer that has said nothing for this time is away.
    pub const AWAY_AFTER: Duration = Duration::from_secs(15);

    pub(crate) fn is_away(&self) -> bool {
        self.heard
            .is_none_or(|heard| heard.elapsed() > Self::AWAY_AFTER)
    }
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Takeover {
    /// When writes were answered here for the first time.
    pub at: Instant,
    /// From the last sign of the previous leader until then.
    pub took: Duration,
    /// Who led before; none if nobody did.
    pub from: Option<String>,
    /// Whether the previous leader gave up leading by itself.
    pub in_order: bool,
}

#[cfg(test)]
impl ClusterFacts {
    /// pc-2 as it follows pc-1, of which it was told a minute ago; pc-3 is away.
    pub(crate) fn of_three() -> Self {
        let minute = Duration::from_secs(60);
        let before = Instant::now().checked_sub(minute).unwrap();
        let member = |name: &str, role, seq, heard| MemberFacts {
            name: name.to_owned(),
            uri: format!("http://{name}:11311/"),
            version: "0.2.0".to_owned(),
            role,
            seq,
            heard,
        };
        Self {
            name: "pc-2".to_owned(),
            role: Role::Following,
            since: before,
            leader: Some(LeaderFacts {
                name: "pc-1".to_owned(),
                uri: "http://pc-1:11311/".to_owned(),
                version: "0.2.0".to_owned(),
                term: 7,
                since: before,
            }),
            leaderless: None,
            seq: 100,
            behind: 2,
            uncommitted: 0,
            etcd: None,
            members: vec![
                member("pc-3", Role::Following, 40, Some(before)),
                member("pc-1", Role::Leading, 100, Some(Instant::now())),
                member("pc-2", Role::Following, 90, Some(Instant::now())),
            ],
            takeovers: 0,
            last_takeover: None,
            lost_writes: 0,
        }
    }
}
