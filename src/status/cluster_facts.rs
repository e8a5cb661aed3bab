//! What this computer knows about the other computers of the robot.

use std::time::{Duration, Instant};

use rescue_core::cluster::machine::Role;

/// This computer's role, and the facts about the other computers. `app::cluster` fills it.
#[derive(Clone, Debug)]
pub struct ClusterFacts {
    /// This computer's name.
    pub name: String,
    pub role: Role,
    /// Since when this computer has its present role.
    pub since: Instant,
    /// The present leader as far as this computer knows. If there is none, the last one.
    pub leader: Option<LeaderFacts>,
    /// Since when there is no leader, as far as this computer knows: the last one stepped down or is silent. `None` if
    /// there is a leader.
    pub leaderless: Option<Instant>,
    /// The last journal record that this computer knows of.
    pub seq: u64,
    /// Number of journal records that this computer's mirror lacks.
    pub behind: u64,
    /// Number of writes by this computer that etcd does not have yet.
    pub uncommitted: u64,
    /// Since when etcd does not answer, and why. `None` if it answers.
    pub etcd: Option<(Instant, String)>,
    /// All computers that this one has heard from since this rosrescue started, and this one.
    pub members: Vec<MemberFacts>,
    /// Number of takeovers by this computer.
    pub takeovers: u64,
    pub last_takeover: Option<Takeover>,
    /// Number of this computer's partition writes that were lost, because other computers had changed the same data.
    pub lost_writes: u64,
    /// How often this computer was cut off since this process started.
    pub times_cut_off: u64,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LeaderFacts {
    pub name: String,
    /// Address at which nodes and other computers reach the leader.
    pub uri: String,
    /// Version of the leader's rosrescue.
    pub version: String,
    /// The leader's term: a number that grows with each leader.
    pub term: u64,
    /// When this computer learned of this leader.
    pub since: Instant,
}

/// A computer of the robot, as it last described itself.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MemberFacts {
    pub name: String,
    pub uri: String,
    pub version: String,
    pub role: Role,
    /// Number of journal records that the described computer's mirror lacked when it described itself.
    pub behind: u64,
    /// When this computer last heard from the described computer.
    pub last_heard: Instant,
}

impl MemberFacts {
    /// A computer counts as away if it has not reported for this long.
    pub const AWAY_AFTER: Duration = Duration::from_secs(15);

    pub(crate) fn is_away(&self) -> bool {
        self.last_heard.elapsed() > Self::AWAY_AFTER
    }
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Takeover {
    /// When this computer answered its first write as the leader.
    pub at: Instant,
    /// Time from the last sign of the previous leader to the first answered write.
    pub took: Duration,
    /// Name of the previous leader. `None` if there was none.
    pub from: Option<String>,
    /// Whether the previous leader stepped down cleanly, as in a handover.
    pub in_order: bool,
}

#[cfg(test)]
impl ClusterFacts {
    /// A view from pc-2, which follows pc-1; pc-3 is away.
    pub(crate) fn of_three() -> Self {
        let minute = Duration::from_secs(60);
        let before = Instant::now().checked_sub(minute).unwrap();
        let member = |name: &str, role, behind, last_heard| MemberFacts {
            name: name.to_owned(),
            uri: format!("http://{name}:11311/"),
            version: "0.2.0".to_owned(),
            role,
            behind,
            last_heard,
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
                member("pc-3", Role::Following, 60, before),
                member("pc-1", Role::Leading, 0, Instant::now()),
                member("pc-2", Role::Following, 2, Instant::now()),
            ],
            takeovers: 0,
            last_takeover: None,
            lost_writes: 0,
            times_cut_off: 0,
        }
    }
}
