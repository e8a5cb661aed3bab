//! The condition of one computer in a robot that has several.

use std::time::{Duration, Instant};

use rescue_core::cluster::machine::Role;

use super::ConditionName;
use crate::{
    gate::State,
    status::cluster_facts::{ClusterFacts, LeaderFacts, MemberFacts},
};

/// Time after which a missing leader is worth attention. A new leader normally takes over within `--cluster-ttl` plus
/// 300 ms, and a starting computer finds the leader within a second.
const PATIENCE: Duration = Duration::from_secs(10);

/// A condition caused by the other computers.
pub(super) struct ClusterCondition {
    pub(super) name: ConditionName,
    pub(super) since: Instant,
    pub(super) text: String,
    pub(super) action: Option<String>,
}

/// The condition caused by the other computers. `None` on the leader, whose condition is that of a single computer.
pub(super) fn notice(gate: State, of: &ClusterFacts) -> Option<ClusterCondition> {
    let leader = of.leader.as_ref();
    let notice = match (of.role, leader, of.leaderless) {
        (Role::Leading, ..) => return None,
        (Role::Alone, ..) => alone(gate, of),
        (Role::Following, Some(leader), None) => following(of, leader),
        (Role::CatchingUp, ..) => ClusterCondition {
            name: ConditionName::NoLeader,
            since: of.leaderless.unwrap_or(of.since),
            text: "Nodes keep working: this computer is taking over, and reads the rest of the journal from etcd. \
                   It answers reads; writes wait."
                .to_owned(),
            action: None,
        },
        (Role::Following, ..) => no_leader(of),
        (Role::Joining, ..) => ClusterCondition {
            name: ConditionName::NoLeader,
            since: of.since,
            text: format!(
                "Calls wait: this computer does not know the others yet{}.",
                etcd(of)
            ),
            action: check_etcd(of, of.since),
        },
    };
    Some(notice)
}

fn following(of: &ClusterFacts, leader: &LeaderFacts) -> ClusterCondition {
    let LeaderFacts { name, uri, .. } = leader;
    let trouble = match of.etcd {
        Some(_) => format!(" This computer cannot take over now{}.", etcd(of)),
        None => String::new(),
    };
    ClusterCondition {
        name: ConditionName::Following,
        since: of.since.max(leader.since),
        text: format!("Nodes work as usual: the leader, {name} at {uri}, answers.{trouble}"),
        action: None,
    }
}

fn no_leader(of: &ClusterFacts) -> ClusterCondition {
    let last = of.leader.as_ref();
    let last = last.map(|leader| format!(" The last leader was {}.", leader.name));
    let since = of.leaderless.unwrap_or(of.since);
    ClusterCondition {
        name: ConditionName::NoLeader,
        since,
        text: format!(
            "Nodes keep working: reads are answered, writes wait for the next leader{}.{}",
            etcd(of),
            last.unwrap_or_default()
        ),
        action: check_etcd(of, since),
    }
}

fn alone(gate: State, of: &ClusterFacts) -> ClusterCondition {
    let kept = match of.uncommitted {
        0 => "none so far".to_owned(),
        1 => "1 so far".to_owned(),
        changes => format!("{changes} so far"),
    };
    let why = match (&of.etcd, &of.leader) {
        (None, Some(leader)) if leader.name != of.name => {
            format!(" (the leader, {}, does not answer)", leader.name)
        }
        _ => etcd(of),
    };
    let notice = match gate {
        State::Elsewhere | State::Unknown => {
            "Reads are answered; writes wait, and fail after --hold (--alone refuse)".to_owned()
        }
        _ => format!(
            "The nodes of this computer keep working. Their changes ({kept}) go to the leader later, except \
             where others change the same data"
        ),
    };
    ClusterCondition {
        name: ConditionName::Alone,
        since: of.since,
        text: format!("{notice}. This computer is cut off from the others{why}."),
        action: Some(
            match (&of.etcd, &of.leader) {
                // etcd has not answered since this process started.
                (Some(_), None) => {
                    "make sure that a majority of etcd runs, and that --cluster has its addresses and client port. \
                     `rosrescue check --cluster URLS` tries each."
                }
                _ => {
                    "restore the network between the computers and a majority of etcd. The rest follows by itself."
                }
            }
            .to_owned(),
        ),
    }
}

/// What the leader's status says about the other computers: sentences, and what the operator should do, if anything.
pub(super) fn leads(of: &ClusterFacts) -> (String, Option<String>) {
    let others = of.members.iter().filter(|member| member.name != of.name);
    let (away, here): (Vec<_>, Vec<_>) = others.partition(|member| member.is_away());
    let names = |members: &[&MemberFacts]| {
        let names: Vec<_> = members.iter().map(|member| &*member.name).collect();
        names.join(", ")
    };
    let mut text = " This computer leads".to_owned();
    if !here.is_empty() {
        text += &format!("; these could take over: {}", names(&here));
    }
    text.push('.');
    let mut action = None;
    if here.is_empty() {
        text += " No other computer could take over";
        if !away.is_empty() {
            text += &format!(": no contact with {}", names(&away));
            action = Some(format!("bring back {}.", names(&away)));
        }
        text.push('.');
    }
    if of.etcd.is_some() {
        text += &format!(" Writes may be delayed{}.", etcd(of));
    }
    (text, action)
}

/// Why etcd does not answer, in parentheses for the end of a sentence. Empty if it answers.
fn etcd(of: &ClusterFacts) -> String {
    let why = of.etcd.as_ref().map(|(_, why)| format!(" ({why})"));
    why.unwrap_or_default()
}

fn check_etcd(of: &ClusterFacts, since: Instant) -> Option<String> {
    (of.etcd.is_some() || since.elapsed() > PATIENCE).then(|| {
        "make sure that a majority of etcd runs, and that this computer reaches it at the addresses of --cluster."
            .to_owned()
    })
}

#[cfg(test)]
mod tests {
    use super::super::{Condition, Situation, condition};
    use super::*;
    use crate::status::{Facts, Mode};

    const OPEN: State = State::Open { incarnation: 1 };

    fn condition_of(gate: State, cluster: &ClusterFacts) -> Condition {
        let mut facts = Facts::new(Mode::Core);
        facts.cluster = Some(cluster.clone());
        let situation = Situation {
            nodes: Default::default(),
            gate,
            gate_since: facts.started,
            unprotected: None,
            master: "http://127.0.0.1:5/".to_owned(),
        };
        condition(&situation, &facts)
    }

    fn trouble() -> Option<(Instant, String)> {
        Some((Instant::now(), "etcd has no majority".to_owned()))
    }

    #[test]
    fn one_that_follows_is_well_and_names_the_leader() {
        let mut cluster = ClusterFacts::of_three();
        let well = condition_of(State::Elsewhere, &cluster);
        assert!(well.is_good(), "{well:?}");
        assert_eq!(
            well.line(),
            "following the leader: Nodes work as usual: the leader, pc-1 at http://pc-1:11311/, answers. \
             Every change is recorded."
        );
        cluster.etcd = trouble();
        let line = condition_of(State::Elsewhere, &cluster).line();
        assert!(
            line.contains("cannot take over now (etcd has no majority)"),
            "{line}"
        );
    }

    #[test]
    fn without_a_leader_writes_wait_and_after_a_while_an_operator_is_needed() {
        let mut cluster = ClusterFacts::of_three();
        cluster.leaderless = Some(Instant::now());
        let short = condition_of(State::Elsewhere, &cluster);
        assert_eq!(
            (short.name, &short.action),
            (ConditionName::NoLeader, &None)
        );
        assert!(
            short.text.contains("writes wait") && short.text.contains("pc-1"),
            "{short:?}"
        );
        cluster.leaderless = Instant::now().checked_sub(2 * PATIENCE);
        assert!(condition_of(State::Elsewhere, &cluster).action.is_some());
        cluster.role = Role::CatchingUp;
        assert_eq!(
            condition_of(State::Elsewhere, &cluster).name,
            ConditionName::NoLeader
        );
        cluster.role = Role::Joining;
        for gate in [State::Elsewhere, State::Unknown] {
            assert_eq!(condition_of(gate, &cluster).name, ConditionName::NoLeader);
        }
    }

    #[test]
    fn one_that_is_cut_off_says_so_loudly() {
        let mut cluster = ClusterFacts::of_three();
        cluster.role = Role::Alone;
        cluster.uncommitted = 3;
        let serving = condition_of(OPEN, &cluster);
        assert_eq!(serving.name, ConditionName::Alone);
        assert!(
            serving
                .line()
                .starts_with("ALONE: The nodes of this computer keep working")
        );
        assert!(serving.text.contains("3 so far"), "{serving:?}");
        assert!(
            serving.text.contains("(the leader, pc-1, does not answer)"),
            "{serving:?}"
        );
        assert!(serving.action.is_some());
        cluster.etcd = trouble();
        let refusing = condition_of(State::Elsewhere, &cluster);
        assert_eq!(refusing.name, ConditionName::Alone);
        assert!(refusing.text.contains("--alone refuse"), "{refusing:?}");
        assert!(
            refusing.text.contains("(etcd has no majority)"),
            "{refusing:?}"
        );
        let action = |of: Condition| of.action.unwrap();
        assert!(action(refusing).contains("restore the network"));
        // The `--cluster` option may be wrong, instead of the network.
        cluster.leader = None;
        let never = action(condition_of(OPEN, &cluster));
        assert!(never.contains("rosrescue check --cluster"), "{never}");
    }

    #[test]
    fn one_that_leads_is_as_a_single_one_and_says_who_could_take_over() {
        let mut cluster = ClusterFacts::of_three();
        cluster.role = Role::Leading;
        let well = condition_of(OPEN, &cluster);
        assert!(well.is_good(), "{well:?}");
        assert!(
            well.text.contains("these could take over: pc-1."),
            "{well:?}"
        );
        assert_eq!(
            condition_of(State::StandingIn, &cluster).name,
            ConditionName::StandingIn
        );
        cluster.members.retain(|member| member.name != "pc-1");
        let last = condition_of(OPEN, &cluster);
        assert!(!last.is_good() && last.action.unwrap().contains("pc-3"));
        cluster.members.retain(|member| member.name == "pc-2");
        let first = condition_of(OPEN, &cluster);
        assert!(first.is_good() && first.text.contains("No other computer could take over."));
    }
}
