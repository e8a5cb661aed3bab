//! The condition of the robot in words: its name, what nodes notice now, and what to do.

mod computers;
mod nodes;

use std::time::Instant;

use serde::{Deserialize, Serialize};

pub(crate) use self::nodes::NodesTrouble;
use super::{Facts, Guarded, Mode, summary::shortened};
use crate::{clock, gate::State};

/// The conditions, from best to worst.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum ConditionName {
    /// Calls pass to the master and every change is recorded.
    Protected,
    /// Another computer leads, and this one forwards calls to it.
    Following,
    /// The master is away, and the mirror answers in its place.
    StandingIn,
    /// This computer knows of no leader: the mirror answers reads, and writes wait.
    NoLeader,
    /// The master keeps dying. Calls may pass between two deaths.
    CrashLoop,
    /// Calls are answered, but changes are not recorded.
    Unprotected,
    /// This computer is cut off from the other computers.
    Alone,
    /// Nodes are registered at an address at which no other computer can reach them.
    WrongAddresses,
    /// Nodes do not answer, and nothing shows whether they are dead.
    NodesUnreachable,
    /// Nodes have died without unregistering.
    NodesDead,
    /// The state is unknown: no master has been seen yet, and calls wait for one.
    Waiting,
}

impl ConditionName {
    pub(crate) const ALL: [Self; 11] = [
        Self::Protected,
        Self::Following,
        Self::StandingIn,
        Self::NoLeader,
        Self::CrashLoop,
        Self::Unprotected,
        Self::Alone,
        Self::WrongAddresses,
        Self::NodesUnreachable,
        Self::NodesDead,
        Self::Waiting,
    ];

    /// The name used in JSON and metrics.
    pub(crate) fn as_str(self) -> &'static str {
        match self {
            Self::Protected => "protected",
            Self::Following => "following",
            Self::StandingIn => "standing_in",
            Self::NoLeader => "no_leader",
            Self::CrashLoop => "crash_loop",
            Self::Unprotected => "unprotected",
            Self::Alone => "alone",
            Self::WrongAddresses => "wrong_addresses",
            Self::NodesUnreachable => "nodes_unreachable",
            Self::NodesDead => "nodes_dead",
            Self::Waiting => "waiting",
        }
    }

    fn title(self) -> &'static str {
        match self {
            Self::Protected => "protected",
            Self::Following => "following the leader",
            Self::StandingIn => "standing in for the master",
            Self::NoLeader => "no computer leads",
            Self::CrashLoop => "master crash loop",
            Self::Unprotected => "UNPROTECTED",
            Self::Alone => "ALONE",
            Self::WrongAddresses => "NODES AT WRONG ADDRESSES",
            Self::NodesUnreachable => "NODES DO NOT ANSWER",
            Self::NodesDead => "NODES DIED",
            Self::Waiting => "waiting for the first master",
        }
    }
}

/// The condition of the robot at one moment.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Condition {
    /// The worst condition that applies.
    pub(crate) name: ConditionName,
    /// The worst condition that applies apart from the nodes: whether calls are answered and changes recorded.
    pub(crate) apart_from_nodes: ConditionName,
    /// When the condition began, in seconds since 1970 by the wall clock.
    pub(crate) since: f64,
    /// What nodes notice now, in one or more sentences.
    pub(crate) text: String,
    /// What to do. `None` if nothing.
    pub(crate) action: Option<String>,
}

impl Condition {
    /// Whether no operator is needed.
    pub(crate) fn is_good(&self) -> bool {
        self.is_protected() && self.name == self.apart_from_nodes && self.action.is_none()
    }

    /// Whether changes are recorded and calls pass to a master, on this computer or on the leader.
    pub(crate) fn is_protected(&self) -> bool {
        matches!(
            self.apart_from_nodes,
            ConditionName::Protected | ConditionName::Following
        )
    }

    /// The condition in one line, as systemd shows it.
    pub(crate) fn line(&self) -> String {
        let action = self.action.iter().map(|action| format!(" To do: {action}"));
        let text = format!(
            "{}: {}{}",
            self.title(),
            self.text,
            action.collect::<String>()
        );
        // systemd would read a newline as the start of another assignment.
        text.replace('\n', " ")
    }

    pub(crate) fn title(&self) -> &'static str {
        self.name.title()
    }
}

/// The facts that decide the condition, in addition to [`Facts`].
#[derive(Debug)]
pub(crate) struct Situation {
    pub(crate) gate: State,
    /// When calls last began or stopped passing to the master.
    pub(crate) gate_since: Instant,
    /// Why changes are not recorded. `None` if they are recorded.
    pub(crate) unprotected: Option<String>,
    pub(crate) master: String,
    pub(crate) nodes: NodesTrouble,
}

/// Derives the condition from the situation and the facts.
pub(crate) fn condition(now: &Situation, facts: &Facts) -> Condition {
    let (mut text, mut action) = nodes_notice(now, facts);
    let (mut name, mut since) = match now.gate {
        State::Unknown => (ConditionName::Waiting, now.gate_since),
        State::StandingIn | State::Late | State::Injecting | State::Frozen => {
            (ConditionName::StandingIn, now.gate_since)
        }
        State::Elsewhere => (ConditionName::NoLeader, now.gate_since),
        State::Open { .. } => (
            ConditionName::Protected,
            now.gate_since.max(facts.settled_since()),
        ),
    };
    if let Some(cluster) = &facts.cluster {
        match computers::notice(now.gate, cluster) {
            Some(notice) => {
                (name, since) = (notice.name, notice.since);
                (text, action) = (notice.text, notice.action);
            }
            None => {
                let (more, to_do) = computers::leads(cluster);
                text += &more;
                action = action.or(to_do);
            }
        }
    }
    if let Some(since_loop) = facts.crash_loop
        && name < ConditionName::CrashLoop
    {
        (name, since) = (ConditionName::CrashLoop, since_loop);
    }
    if let Some(reason) = &now.unprotected {
        if name < ConditionName::Unprotected {
            (name, since) = (ConditionName::Unprotected, facts.disk.unprotected_since());
        }
        text += &format!(
            " Changes are not recorded, and a crash of rosrescue would lose them: {reason}."
        );
        action.get_or_insert_with(|| {
            "free space on the disk or repair it. Recording then resumes by itself.".to_owned()
        });
    }
    match facts.guarded {
        Guarded::NoLonger(pid) => {
            text += &format!(
                " The guardian, process {pid}, has ended: if rosrescue dies now, nothing restarts it."
            );
            action.get_or_insert_with(|| "restart rosrescue when the robot is at rest.".to_owned());
        }
        Guarded::Stopped(pid) => {
            text += &format!(
                " The guardian, process {pid}, is stopped: if rosrescue dies now, calls wait until it \
                 continues."
            );
            action.get_or_insert_with(|| {
                format!("resume the guardian with `fg`, `bg` or `kill -CONT {pid}`.")
            });
        }
        Guarded::Nobody | Guarded::Systemd | Guarded::Guardian { .. } => {}
    }
    if matches!(name, ConditionName::Protected | ConditionName::Following) {
        text += match facts.bypassing.is_empty() {
            true => " Every change is recorded.",
            false => " Every change through rosrescue is recorded.",
        };
    }
    if !facts.bypassing.is_empty() {
        let (count, verb) = match facts.bypassing.len() {
            1 => ("1 client".to_owned(), "talks"),
            count => (format!("{count} clients"), "talk"),
        };
        let who = shortened(&facts.bypassing);
        text += &format!(" {count} {verb} directly to the master, unprotected: {who}.");
        action.get_or_insert_with(|| "restart it with the ROS_MASTER_URI of rosrescue.".to_owned());
    }
    let (apart_from_nodes, mut since) = (name, clock::wall_time_of(since));
    if let Some((worse, from)) = now.nodes.condition().filter(|(of, _)| *of > name) {
        (name, since) = (worse, from);
        // The nodes come before what is the matter with the master.
        if let Some(rest) = text.strip_prefix("Nodes ") {
            text = format!("Other nodes {rest}");
        }
    }
    let (said, to_do): (Vec<_>, Vec<_>) = now.nodes.sentences().into_iter().unzip();
    let said: Vec<_> = said.into_iter().chain([text]).collect();
    Condition {
        name,
        apart_from_nodes,
        since,
        text: said.join(" "),
        action: to_do.into_iter().next().or(action),
    }
}

fn nodes_notice(now: &Situation, facts: &Facts) -> (String, Option<String>) {
    let master = &now.master;
    let open = now.gate.is_open();
    let starts_it = format!("start the master at {master}, unless something else starts it.");
    match (now.gate, facts.mode) {
        (State::Unknown, Mode::Core) => ("Calls wait for the first master.".to_owned(), None),
        (State::Unknown, Mode::Proxy) => (
            format!("Calls wait, because no master has answered at {master} yet."),
            Some(format!(
                "start the master at {master}, or correct --master."
            )),
        ),
        (State::Elsewhere, _) => ("Calls wait for another computer.".to_owned(), None),
        _ if facts.crash_loop.is_some() => {
            let text = match open {
                true => "Nodes work as usual: the master answers, but it keeps dying",
                false => {
                    "Nodes keep working: rosrescue answers in place of the master, which keeps dying"
                }
            };
            let output = match facts.mode {
                Mode::Core => "find the reason in ….rosmaster-output.log beside the checkpoint",
                Mode::Proxy => "find the reason in the log of the program that starts it",
            };
            let text = format!(
                "{text}, {} times so far. The crash loop ends when a master runs for 10 s.",
                facts.deaths
            );
            (text, Some(format!("{output}.")))
        }
        (State::Open { .. }, _) => ("Nodes work as usual: the master answers.".to_owned(), None),
        (_, Mode::Core) if facts.starts_master => (
            "Nodes keep working: rosrescue answers in place of the master and starts a new one."
                .to_owned(),
            None,
        ),
        (_, Mode::Core) | (State::Late | State::Injecting | State::Frozen, _) => (
            "Nodes keep working: rosrescue answers in place of the master, which does not answer in time."
                .to_owned(),
            None,
        ),
        (_, Mode::Proxy) => (
            format!(
                "Nodes keep working: rosrescue answers in place of the master at {master}, which is down."
            ),
            Some(starts_it),
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::status::summary::{IllNode, LostAddress, Misaddressed};

    const OPEN: State = State::Open { incarnation: 1 };

    fn condition_for(gate: State, unprotected: Option<&str>, facts: &Facts) -> Condition {
        let situation = Situation {
            gate,
            gate_since: facts.started,
            unprotected: unprotected.map(str::to_owned),
            nodes: NodesTrouble::default(),
            master: "http://robot:11312/".to_owned(),
        };
        condition(&situation, facts)
    }

    #[test]
    fn the_worst_condition_gives_the_name_and_all_are_described() {
        let mut facts = Facts::new(Mode::Proxy);
        let good = condition_for(OPEN, None, &facts);
        assert!(good.is_good(), "{good:?}");
        assert_eq!(
            good.line(),
            "protected: Nodes work as usual: the master answers. Every change is recorded."
        );
        assert_eq!(
            condition_for(State::Unknown, None, &facts).name,
            ConditionName::Waiting
        );
        let away = condition_for(State::StandingIn, None, &facts);
        assert_eq!(away.name, ConditionName::StandingIn);
        assert!(away.text.starts_with("Nodes keep working"), "{away:?}");
        assert!(away.action.unwrap().contains("http://robot:11312/"));

        facts.crash_loop = Some(Instant::now());
        facts.deaths = 7;
        assert_eq!(
            condition_for(State::StandingIn, None, &facts).name,
            ConditionName::CrashLoop
        );
        let between = condition_for(OPEN, None, &facts);
        assert_eq!(between.name, ConditionName::CrashLoop);
        assert!(
            between.text.starts_with("Nodes work as usual"),
            "{between:?}"
        );
        assert!(between.text.contains("7 times"), "{between:?}");

        let line = condition_for(OPEN, Some("the disk\nis full"), &facts).line();
        assert!(
            line.starts_with("UNPROTECTED: Nodes work as usual"),
            "{line}"
        );
        assert!(line.contains("the disk is full") && line.contains("7 times"));
    }

    #[test]
    fn an_unguarded_rosrescue_is_protected_and_asks_for_something() {
        let mut facts = Facts::new(Mode::Core);
        for guarded in [Guarded::NoLonger(7), Guarded::Stopped(7)] {
            facts.guarded = guarded;
            let condition = condition_for(OPEN, None, &facts);
            assert_eq!(condition.name, ConditionName::Protected);
            assert!(!condition.is_good() && !guarded.is_guarded());
            assert!(condition.text.contains("process 7"), "{condition:?}");
        }
    }

    #[test]
    fn changes_that_bypass_rosrescue_are_not_protected() {
        let mut facts = Facts::new(Mode::Proxy);
        facts.bypassing = vec!["rosout (process 7)".to_owned()];
        let condition = condition_for(OPEN, None, &facts);
        assert_eq!(condition.name, ConditionName::Protected);
        assert!(!condition.is_good());
        let said = "1 client talks directly to the master, unprotected: rosout (process 7).";
        assert!(condition.text.contains(said), "{condition:?}");
        assert!(!condition.text.contains("Every change is recorded"));
        assert!(condition.action.unwrap().contains("ROS_MASTER_URI"));
    }

    fn with_nodes(
        nodes: NodesTrouble,
        gate: State,
        unprotected: Option<&str>,
        facts: &Facts,
    ) -> Condition {
        let situation = Situation {
            gate,
            gate_since: facts.started,
            unprotected: unprotected.map(str::to_owned),
            nodes,
            master: "http://robot:11312/".to_owned(),
        };
        condition(&situation, facts)
    }

    fn ill(node: &str, since: f64) -> IllNode {
        IllNode {
            node: node.to_owned(),
            since,
        }
    }

    #[test]
    fn dead_nodes_come_before_everything_and_hide_nothing() {
        let facts = Facts::new(Mode::Core);
        let trouble = |dead: &[&str], unregistered: &[&str], unreachable: &[&str]| NodesTrouble {
            dead: dead.iter().map(|name| ill(name, 1e9)).collect(),
            unregistered: unregistered.iter().map(|name| ill(name, 2e9)).collect(),
            unreachable: unreachable.iter().map(|name| ill(name, 5.0)).collect(),
            ..NodesTrouble::default()
        };
        let all = with_nodes(
            trouble(&["/base", "/arm"], &["/lidar"], &["/gps"]),
            State::StandingIn,
            Some("the disk is full"),
            &facts,
        );
        assert_eq!(all.name, ConditionName::NodesDead);
        assert_eq!(all.apart_from_nodes, ConditionName::Unprotected);
        assert!(!all.is_good() && !all.is_protected());
        assert!(all.since < 1e9 + 1.0, "{all:?}");
        let line = all.line();
        assert!(
            line.starts_with(
                "NODES DIED: 2 nodes died without unregistering: /base, /arm since 2001-"
            ),
            "{line}"
        );
        for part in [
            "1 node died, now unregistered: /lidar",
            "1 node does not answer: /gps",
            "Other nodes keep working",
            "the disk is full",
            "To do: restart these nodes",
        ] {
            assert!(line.contains(part), "{part}: {line}");
        }
        let reaped = with_nodes(trouble(&[], &["/lidar"], &[]), OPEN, None, &facts);
        assert_eq!(reaped.name, ConditionName::NodesDead);
        assert!(reaped.is_protected() && !reaped.is_good());
        let silent = with_nodes(trouble(&[], &[], &["/gps"]), OPEN, None, &facts);
        assert_eq!(silent.name, ConditionName::NodesUnreachable);
        assert!(with_nodes(trouble(&[], &[], &[]), OPEN, None, &facts).is_good());
        // Before there is a master, that is what matters.
        let waiting = with_nodes(trouble(&["/base"], &[], &[]), State::Unknown, None, &facts);
        assert_eq!(waiting.name, ConditionName::Waiting);
    }

    #[test]
    fn nodes_that_no_other_computer_can_reach_are_named_with_the_command_that_helps() {
        let facts = Facts::new(Mode::Core);
        let node = |node: &str| Misaddressed {
            node: node.to_owned(),
            api: "http://localhost:4001/".to_owned(),
            from: [10, 0, 0, 9].into(),
            since: 7.0,
        };
        let nodes = NodesTrouble {
            misaddressed: vec![node("/joy"), node("/teleop")],
            ..NodesTrouble::default()
        };
        let condition = with_nodes(nodes, OPEN, None, &facts);
        assert!(!condition.is_good(), "{condition:?}");
        for part in [
            "nodes of 10.0.0.9",
            "/joy as http://localhost:4001/, /teleop",
        ] {
            assert!(condition.text.contains(part), "{condition:?}");
        }
        assert!(condition.action.unwrap().contains("export ROS_IP=10.0.0.9"));
    }

    #[test]
    fn a_lost_address_explains_why_a_node_does_not_answer() {
        let facts = Facts::new(Mode::Core);
        let silent = |names: &[&str]| NodesTrouble {
            unreachable: names.iter().map(|name| ill(name, 5.0)).collect(),
            lost_addresses: vec![LostAddress {
                address: [10, 0, 0, 9].into(),
                nodes: vec!["/here".to_owned()],
                since: 4.0,
            }],
            ..NodesTrouble::default()
        };
        let explained = with_nodes(silent(&["/here"]), OPEN, None, &facts);
        assert_eq!(explained.name, ConditionName::WrongAddresses);
        assert!(!explained.text.contains("not answer"), "{explained:?}");
        assert!(explained.action.unwrap().contains("10.0.0.9"));
        let other = with_nodes(silent(&["/here", "/gps"]), OPEN, None, &facts);
        assert_eq!(other.name, ConditionName::NodesUnreachable);
        assert!(
            other.text.contains("1 node does not answer: /gps"),
            "{other:?}"
        );
    }

    #[test]
    fn it_is_good_since_the_last_trouble() {
        let minute = std::time::Duration::from_secs(60);
        let mut facts = Facts::new(Mode::Core);
        facts.started = facts.started.checked_sub(minute).unwrap();
        facts.disk.since = facts.started;
        let before = condition_for(OPEN, None, &facts).since;
        facts.calm_since = Some(facts.started + minute / 2);
        assert!(condition_for(OPEN, None, &facts).since > before + 29.0);
    }
}
