//! The computers of the robot in `/status.json` and in `rosrescue status`.

use std::fmt;

use rescue_core::cluster::machine::Role;
use serde::{Deserialize, Serialize};

use super::cluster_facts::{ClusterFacts, LeaderFacts, MemberFacts, Takeover};
use crate::{
    clock,
    printable::{Page, line},
    ros_env::MasterUri,
};

/// The facts about all computers of the robot. Times of day are seconds since 1970.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Computers {
    /// This computer's name.
    pub(crate) name: String,
    pub(crate) role: Role,
    /// Since when this computer has its present role.
    pub(crate) since: f64,
    /// The present leader. If there is none, the last one.
    pub(crate) leader: Option<LeaderStatus>,
    /// Since when there is no leader. `None` if there is a leader.
    pub(crate) leaderless_since: Option<f64>,
    /// The last journal record that this computer knows of.
    pub(crate) seq: u64,
    /// Number of journal records that this computer's mirror lacks.
    pub(crate) behind: u64,
    /// Number of writes by this computer that etcd does not have yet.
    pub(crate) uncommitted: u64,
    /// Why etcd does not answer. `None` if it answers.
    pub(crate) etcd_trouble: Option<Trouble>,
    /// All computers, sorted by name.
    pub(crate) computers: Vec<Computer>,
    /// Number of takeovers by this computer.
    pub(crate) takeovers: u64,
    /// The last takeover by this computer.
    pub(crate) last_takeover: Option<Taken>,
    /// Number of this computer's partition writes that were lost.
    pub(crate) lost_writes: u64,
    /// How often this computer was cut off since its rosrescue started.
    pub(crate) times_cut_off: u64,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct LeaderStatus {
    pub(crate) name: String,
    /// Address at which nodes and other computers reach the leader.
    pub(crate) uri: String,
    pub(crate) version: String,
    /// The leader's term: a number that grows with each leader.
    pub(crate) term: u64,
    /// When this computer learned of this leader.
    pub(crate) since: f64,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Trouble {
    pub(crate) since: f64,
    pub(crate) why: String,
}

/// A computer of the robot, as it last described itself.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Computer {
    pub(crate) name: String,
    pub(crate) uri: String,
    pub(crate) version: String,
    pub(crate) role: Role,
    /// Number of journal records that the described computer's mirror lacked when it described itself.
    pub(crate) behind: u64,
    /// When this computer last heard from the described computer. `None` for this computer itself.
    pub(crate) heard: Option<f64>,
    /// Whether the described computer has been silent for 15 s.
    pub(crate) away: bool,
}

/// A takeover by this computer.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Taken {
    /// When this computer answered its first write as the leader.
    pub(crate) at: f64,
    /// Seconds from the last sign of the previous leader to the first answered write.
    pub(crate) seconds: f64,
    /// Name of the previous leader. `None` if there was none.
    pub(crate) from: Option<String>,
    /// Whether the previous leader stepped down cleanly, as in a handover.
    pub(crate) in_order: bool,
}

impl From<&ClusterFacts> for Computers {
    fn from(facts: &ClusterFacts) -> Self {
        let mut computers: Vec<_> = facts
            .members
            .iter()
            .map(|of| Computer::new(of, facts))
            .collect();
        computers.sort_by(|a, b| a.name.cmp(&b.name));
        // The first leader has no predecessor.
        let last = facts.last_takeover.as_ref();
        let last = last.filter(|takeover| takeover.from.is_some());
        Self {
            name: facts.name.clone(),
            role: facts.role,
            since: clock::wall_time_of(facts.since),
            leader: facts.leader.as_ref().map(LeaderStatus::from),
            leaderless_since: facts.leaderless.map(clock::wall_time_of),
            seq: facts.seq,
            behind: facts.behind,
            uncommitted: facts.uncommitted,
            etcd_trouble: facts.etcd.as_ref().map(|(since, why)| Trouble {
                since: clock::wall_time_of(*since),
                why: why.clone(),
            }),
            computers,
            takeovers: facts.takeovers,
            last_takeover: last.map(Taken::from),
            lost_writes: facts.lost_writes,
            times_cut_off: facts.times_cut_off,
        }
    }
}

impl From<&LeaderFacts> for LeaderStatus {
    fn from(facts: &LeaderFacts) -> Self {
        Self {
            name: facts.name.clone(),
            uri: facts.uri.clone(),
            version: facts.version.clone(),
            term: facts.term,
            since: clock::wall_time_of(facts.since),
        }
    }
}

impl Computer {
    fn new(member: &MemberFacts, facts: &ClusterFacts) -> Self {
        let is_this = member.name == facts.name;
        Self {
            name: member.name.clone(),
            uri: member.uri.clone(),
            version: member.version.clone(),
            role: match is_this {
                true => facts.role,
                false => member.role,
            },
            behind: member.behind,
            heard: (!is_this).then(|| clock::wall_time_of(member.last_heard)),
            away: !is_this && member.is_away(),
        }
    }
}

impl From<&Takeover> for Taken {
    fn from(takeover: &Takeover) -> Self {
        Self {
            at: clock::wall_time_of(takeover.at),
            seconds: takeover.took.as_secs_f64(),
            from: takeover.from.clone(),
            in_order: takeover.in_order,
        }
    }
}

impl Computers {
    /// The present leader. `None` if there is none.
    pub(crate) fn leads(&self) -> Option<&LeaderStatus> {
        self.leader
            .as_ref()
            .filter(|_| self.leaderless_since.is_none())
    }

    /// Finds the computer that `given` stands for: its whole name, its address, or the part of its name
    /// before a `-` or `.`. `None` if several computers match.
    pub(crate) fn find(&self, given: &str) -> Option<&str> {
        let names = || self.computers.iter().map(|of| of.name.as_str());
        if let Some(name) = names().find(|name| *name == given) {
            return Some(name);
        }
        let is_meant = |of: &&Computer| {
            let host = MasterUri::parse(&of.uri).map(|uri| uri.host);
            host.is_ok_and(|host| host == given)
                || of
                    .name
                    .strip_prefix(given)
                    .is_some_and(|rest| !given.is_empty() && rest.starts_with(['-', '.']))
        };
        let mut meant = self.computers.iter().filter(is_meant);
        let first = meant.next()?;
        meant.next().is_none().then_some(&first.name)
    }

    /// Writes the lines of `rosrescue status`. `now` is in seconds since 1970.
    pub(crate) fn lines(&self, now: f64, f: &mut Page) -> fmt::Result {
        let ago = |at: f64| format!("{} ({} ago)", clock::wall_text(at), clock::span(now - at));
        match (&self.leader, self.leaderless_since) {
            (Some(leader), None) => line!(
                f,
                "leader      {} at {}, since {}, term {}",
                leader.name,
                leader.uri,
                ago(leader.since),
                leader.term
            )?,
            (Some(leader), Some(since)) => line!(
                f,
                "leader      NONE since {}; the last was {}, term {}",
                ago(since),
                leader.name,
                leader.term
            )?,
            (None, _) => line!(f, "leader      NONE known yet")?,
        }
        for (number, computer) in self.computers.iter().enumerate() {
            let head = if number == 0 { "computers" } else { "" };
            write!(f, "{head:<12}{}", computer.name)?;
            match computer.heard {
                _ if computer.name == self.name => {
                    line!(f, " (this one) {}", computer.doing(self.leads()))?;
                }
                Some(heard) if computer.away => line!(f, " is AWAY, last contact {}", ago(heard))?,
                _ => line!(f, " {}", computer.doing(self.leads()))?,
            }
        }
        if let Some(Trouble { since, why }) = &self.etcd_trouble {
            line!(f, "etcd        NO ANSWER since {}: {why}", ago(*since))?;
        }
        if self.uncommitted > 0 {
            line!(f, "not in etcd {} changes made here", self.uncommitted)?;
        }
        if let Some(Taken {
            at,
            seconds,
            from,
            in_order,
        }) = &self.last_takeover
        {
            let from = from.as_ref().map(|from| format!(" from {from}"));
            let order = if *in_order { " (handover)" } else { "" };
            line!(
                f,
                "takeover    {}{}{order}, took {}; {} by this computer so far",
                ago(*at),
                from.unwrap_or_default(),
                match *seconds < 1.0 {
                    true => format!("{:.0} ms", seconds * 1e3),
                    false => format!("{seconds:.2} s"),
                },
                self.takeovers
            )?;
        }
        if self.lost_writes > 0 {
            line!(
                f,
                "lost        {} of the changes made while cut off: others had changed the same data. The log lists them",
                self.lost_writes
            )?;
        }
        Ok(())
    }

    /// The computers in one line, for `rosrescue top`.
    pub(crate) fn line(&self) -> String {
        let each = self.computers.iter().map(|computer| match computer.away {
            true => format!("{} is AWAY", computer.name),
            false => format!("{} {}", computer.name, computer.doing(self.leads())),
        });
        each.collect::<Vec<_>>().join("; ")
    }
}

impl Computer {
    /// Describes the computer's role. A computer that is cut off may still name an earlier leader.
    fn doing(&self, leader: Option<&LeaderStatus>) -> String {
        let doing = match self.role {
            Role::Joining => "is joining",
            Role::Following => "is following",
            Role::CatchingUp => "is taking over",
            Role::Leading => {
                let leads = leader.is_some_and(|leader| leader.name == self.name);
                return if leads { "leads" } else { "led" }.to_owned();
            }
            Role::Alone => "is ALONE",
        };
        match self.behind {
            0 => doing.to_owned(),
            1 => format!("{doing}, 1 record behind"),
            behind => format!("{doing}, {behind} records behind"),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use super::*;
    use crate::printable::{Lines, Printable};

    /// Prints the lines of `rosrescue status`.
    struct Shown<'a>(&'a Computers);

    impl Lines for Shown<'_> {
        fn lines(&self, page: &mut Page) -> fmt::Result {
            self.0.lines(clock::wall_time(), page)
        }
    }

    /// The lines, with `THEN` for times.
    fn lines(facts: &ClusterFacts) -> Vec<String> {
        let time = regex::Regex::new(r"\S+Z \([^)]* ago\)").unwrap();
        let text = Printable::lines(&Shown(&Computers::from(facts)));
        let plain = text.as_str().lines().map(|line| time.replace(line, "THEN"));
        plain.map(String::from).collect()
    }

    #[test]
    fn each_computer_has_a_line() {
        let mut facts = ClusterFacts::of_three();
        assert_eq!(
            lines(&facts),
            [
                "leader      pc-1 at http://pc-1:11311/, since THEN, term 7",
                "computers   pc-1 leads",
                "            pc-2 (this one) is following, 2 records behind",
                "            pc-3 is AWAY, last contact THEN",
            ]
        );
        facts.leaderless = Some(Instant::now());
        facts.etcd = Some((Instant::now(), "no majority".to_owned()));
        facts.uncommitted = 3;
        facts.takeovers = 2;
        facts.last_takeover = Some(Takeover {
            at: Instant::now(),
            took: Duration::from_millis(2040),
            from: Some("pc-3".to_owned()),
            in_order: false,
        });
        facts.lost_writes = 1;
        assert_eq!(
            lines(&facts),
            [
                "leader      NONE since THEN; the last was pc-1, term 7",
                "computers   pc-1 led",
                "            pc-2 (this one) is following, 2 records behind",
                "            pc-3 is AWAY, last contact THEN",
                "etcd        NO ANSWER since THEN: no majority",
                "not in etcd 3 changes made here",
                "takeover    THEN from pc-3, took 2.04 s; 2 by this computer so far",
                "lost        1 of the changes made while cut off: others had changed the same data. The log lists them",
            ]
        );
    }

    #[test]
    fn a_computer_is_meant_by_its_name_its_beginning_or_its_address() {
        let mut facts = ClusterFacts::of_three();
        for (index, member) in facts.members.iter_mut().enumerate() {
            member.name = ["base-10.0.0.1", "arm-10.0.0.2", "arm-10.0.0.3"][index].to_owned();
            member.uri = format!("http://10.0.0.{}:11311/", index + 1);
        }
        let computers = Computers::from(&facts);
        for (given, meant) in [
            ("base-10.0.0.1", Some("base-10.0.0.1")),
            ("base", Some("base-10.0.0.1")),
            ("10.0.0.3", Some("arm-10.0.0.3")),
            ("arm-10.0.0.3", Some("arm-10.0.0.3")),
            ("arm", None),
            ("bas", None),
            ("", None),
        ] {
            assert_eq!(computers.find(given), meant, "{given}");
        }
    }

    #[test]
    fn json_says_the_same_to_another_rosrescue() {
        let facts = ClusterFacts::of_three();
        let computers = Computers::from(&facts);
        let json = serde_json::to_value(&computers).unwrap();
        assert_eq!(json["role"], "following");
        assert_eq!(json["computers"][2]["name"], "pc-3");
        assert_eq!(json["computers"][2]["away"], true);
        assert_eq!(json["computers"][2]["behind"], 60);
        assert_eq!(json["leader"]["term"], 7);
        assert_eq!(
            serde_json::from_value::<Computers>(json).unwrap(),
            computers
        );
        assert_eq!(
            computers.line(),
            "pc-1 leads; pc-2 is following, 2 records behind; pc-3 is AWAY"
        );
    }
}
