//! The computers of the robot, as `/status.json` has them.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::cluster::{ClusterFacts, LeaderFacts, MemberFacts, Takeover};
use crate::{clock, cluster::machine::Role, ros_env::MasterUri};

/// What is known of the computers of the robot, this one included. All times of day are seconds since 1970.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Computers {
    /// This computer's name.
    pub(crate) name: String,
    pub(crate) role: Role,
    /// Since when it has this role.
    pub(crate) since: f64,
    /// Who leads, or led last.
    pub(crate) leader: Option<Leader>,
    /// Since when nobody leads; none while somebody does.
    pub(crate) leaderless_since: Option<f64>,
    /// The journal's last record that is known.
    pub(crate) seq: u64,
    /// Records that this computer's mirror lacks.
    pub(crate) behind: u64,
    /// Writes that were made here and that etcd does not have yet.
    pub(crate) uncommitted: u64,
    /// Why etcd does not answer; none if it does.
    pub(crate) etcd_trouble: Option<Trouble>,
    /// Sorted by name.
    pub(crate) computers: Vec<Computer>,
    /// Times that this computer has taken over.
    pub(crate) takeovers: u64,
    /// The last of them.
    pub(crate) last_takeover: Option<Taken>,
    /// Writes that were answered alone and did not hold.
    pub(crate) lost_writes: u64,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Leader {
    pub(crate) name: String,
    /// Where nodes and other computers reach it.
    pub(crate) uri: String,
    pub(crate) version: String,
    /// Grows with each leader.
    pub(crate) term: u64,
    /// Since when this computer knows of it.
    pub(crate) since: f64,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Trouble {
    pub(crate) since: f64,
    pub(crate) why: String,
}

/// A computer, as it said last.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Computer {
    pub(crate) name: String,
    pub(crate) uri: String,
    pub(crate) version: String,
    pub(crate) role: Role,
    /// Records that its mirror lacks.
    pub(crate) behind: u64,
    /// When it was heard of last; none if not since this rosrescue started, or if it is this computer.
    pub(crate) heard: Option<f64>,
    /// It is not heard of any more.
    pub(crate) away: bool,
}

/// A takeover by this computer.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Taken {
    /// When writes were answered here for the first time.
    pub(crate) at: f64,
    /// From the last sign of the previous leader until then.
    pub(crate) seconds: f64,
    /// Who led before; none if nobody did.
    pub(crate) from: Option<String>,
    /// Whether the previous leader gave up leading by itself.
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
        // The first leader took over from nobody.
        let last = facts.last_takeover.as_ref();
        let last = last.filter(|takeover| takeover.from.is_some());
        Self {
            name: facts.name.clone(),
            role: facts.role,
            since: clock::wall_time_of(facts.since),
            leader: facts.leader.as_ref().map(Leader::from),
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
        }
    }
}

impl From<&LeaderFacts> for Leader {
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
            behind: match is_this {
                true => facts.behind,
                false => facts.seq.saturating_sub(member.seq),
            },
            heard: member.heard.filter(|_| !is_this).map(clock::wall_time_of),
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
    /// Who leads now.
    pub(crate) fn leads(&self) -> Option<&Leader> {
        self.leader
            .as_ref()
            .filter(|_| self.leaderless_since.is_none())
    }

    /// The name of the computer that a person means by `given`: its name, the beginning of one name, or its
    /// address.
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

    /// The lines of `rosrescue status`, at `now` in seconds since 1970.
    pub(crate) fn lines(&self, now: f64, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ago = |at: f64| format!("{} ({} ago)", clock::wall_text(at), clock::span(now - at));
        match (&self.leader, self.leaderless_since) {
            (Some(leader), None) => writeln!(
                f,
                "leader      {} at {}, since {}, term {}",
                leader.name,
                leader.uri,
                ago(leader.since),
                leader.term
            )?,
            (Some(leader), Some(since)) => writeln!(
                f,
                "leader      NONE since {}; the last was {}, term {}",
                ago(since),
                leader.name,
                leader.term
            )?,
            (None, _) => writeln!(f, "leader      NONE is known")?,
        }
        for (number, computer) in self.computers.iter().enumerate() {
            let head = if number == 0 { "computers" } else { "" };
            write!(f, "{head:<12}{}", computer.name)?;
            match (computer.name == self.name, computer.heard) {
                (true, _) => writeln!(f, " (this one) {}", computer.doing(self.leads()))?,
                (false, None) => writeln!(f, " is AWAY, no contact since the start")?,
                (false, Some(heard)) if computer.away => {
                    writeln!(f, " is AWAY, last contact {}", ago(heard))?;
                }
                (false, Some(_)) => writeln!(f, " {}", computer.doing(self.leads()))?,
            }
        }
        if let Some(Trouble { since, why }) = &self.etcd_trouble {
            writeln!(f, "etcd        NO ANSWER since {}: {why}", ago(*since))?;
        }
        if self.uncommitted > 0 {
            writeln!(
                f,
                "not in etcd {} changes of this computer",
                self.uncommitted
            )?;
        }
        if let Some(Taken {
            at,
            seconds,
            from,
            in_order,
        }) = &self.last_takeover
        {
            let from = from.as_ref().map(|from| format!(" from {from}"));
            let order = if *in_order { ", in order" } else { "" };
            writeln!(
                f,
                "takeover    {}{}{order}: in {}; {} by this computer so far",
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
            writeln!(
                f,
                "lost        {} of the changes made alone: others had changed the same. The log lists them",
                self.lost_writes
            )?;
        }
        Ok(())
    }

    /// In a line, as `rosrescue top` shows it.
    pub(crate) fn line(&self) -> String {
        let each = self.computers.iter().map(|computer| match computer.away {
            true => format!("{} is AWAY", computer.name),
            false => format!("{} {}", computer.name, computer.doing(self.leads())),
        });
        each.collect::<Vec<_>>().join("; ")
    }
}

impl Computer {
    /// A computer that is cut off may have heard last that another one leads.
    fn doing(&self, leader: Option<&Leader>) -> String {
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

    /// As `rosrescue status` prints it.
    struct Lines<'a>(&'a Computers);

    impl fmt::Display for Lines<'_> {
        fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            self.0.lines(clock::wall_time(), f)
        }
    }

    /// The lines, with `THEN` for times.
    fn lines(facts: &ClusterFacts) -> Vec<String> {
        let time = regex::Regex::new(r"\S+Z \([^)]* ago\)").unwrap();
        let text = Lines(&Computers::from(facts)).to_string();
        let plain = text.lines().map(|line| time.replace(line, "THEN"));
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
        for member in &mut facts.members {
            member.heard = None;
        }
        assert_eq!(
            lines(&facts),
            [
                "leader      NONE since THEN; the last was pc-1, term 7",
                "computers   pc-1 is AWAY, no contact since the start",
                "            pc-2 (this one) is following, 2 records behind",
                "            pc-3 is AWAY, no contact since the start",
                "etcd        NO ANSWER since THEN: no majority",
                "not in etcd 3 changes of this computer",
                "takeover    THEN from pc-3: in 2.04 s; 2 by this computer so far",
                "lost        1 of the changes made alone: others had changed the same; the log names each",
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
