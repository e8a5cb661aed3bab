//! The metrics, in Prometheus' text format.
//!
//! The format is written by hand, because every value is already in a [`Status`]; a metrics library
//! would keep a second copy of each.

use std::fmt::{Display, Write};

use rescue_core::{cluster::machine::Role, health::Health};

use super::{
    computers::Computers,
    condition::ConditionName,
    stats::Stats,
    summary::{NodesStatus, Status},
};
use crate::printable;

/// Number of nodes that have a line of their own.
const ILL_MOST: usize = 100;
/// The histogram of the duration of calls.
const TIMES: &str = "call_duration_seconds";

/// A metric of this process: name, help and value.
pub(crate) type ProcessMetric = (&'static str, &'static str, f64);

/// The text that `/metrics` answers with.
pub(crate) fn metrics(stats: &Stats, status: &Status, process: &[ProcessMetric]) -> String {
    let mut text = String::new();
    for (name, help, value) in stats.list() {
        add(&mut text, &format!("{name}_total"), help, value);
    }
    let flag = u8::from;
    let journal = &status.journal;
    #[rustfmt::skip]
    let values: [(&str, &str, Option<f64>); 32] = [
        ("calls_pass", "whether calls pass to the master", Some(flag(status.open).into())),
        ("standing_in", "whether the mirror answers, because the master is away", Some(flag(status.standing_in_since.is_some()).into())),
        ("protected", "whether the state is recorded", Some(flag(status.unprotected.is_none()).into())),
        ("crash_loop", "whether the master dies again and again", Some(flag(status.crash_loop).into())),
        ("guarded", "whether a guardian or systemd restarts rosrescue if it dies", Some(flag(status.guarded).into())),
        ("action_needed", "whether an operator must act: /status.json says what to do", Some(flag(status.condition.action.is_some()).into())),
        ("master_deaths_total", "masters that have died", Some(status.deaths as f64)),
        ("worker_restarts_total", "restarts of rosrescue itself after it died, in this session", Some(status.worker_restarts as f64)),
        ("recoveries_total", "masters examined, the first one included", Some(status.recoveries as f64)),
        ("rescues_total", "recoveries after a death or a restart", Some(status.rescues as f64)),
        ("late_answers_total", "times that the same master was late and rosrescue answered in its place", Some(status.late_answers.times as f64)),
        ("late_answers_seconds_total", "how long rosrescue answered because the master was late", Some(status.late_answers.seconds)),
        ("pending_writes", "writes answered by the mirror that the master has not run yet", Some(status.pending_writes as f64)),
        ("nodes", "nodes registered", Some(status.state.nodes as f64)),
        ("publishers", "publishers, counted once for each topic", Some(status.state.publishers as f64)),
        ("subscribers", "subscribers, counted once for each topic", Some(status.state.subscribers as f64)),
        ("services", "services registered", Some(status.state.services as f64)),
        ("params", "parameters set", Some(status.state.params as f64)),
        ("unreachable_nodes", "nodes that do not answer and are not known to be dead", Some(status.nodes.unreachable.len() as f64)),
        ("alive_nodes", "registered nodes that have a listening process or answered lately", Some(status.nodes.alive_nodes as f64)),
        ("dead_nodes", "registered nodes whose process has ended or whose port refuses connections", Some(status.nodes.dead_nodes.len() as f64)),
        ("unchecked_nodes", "registered nodes without a check in the last two minutes", Some(status.nodes.unchecked_nodes.len() as f64)),
        ("feuds", "node names that two programs take from each other", Some(status.nodes.feuds.len() as f64)),
        ("lost_addresses", "addresses that this computer has lost and at which nodes are registered", Some(status.nodes.lost_addresses.len() as f64)),
        ("unregistered_nodes", "nodes that died, that rosrescue unregistered in the last ten minutes, and that have not come back", Some(status.nodes.unregistered_nodes.len() as f64)),
        ("misaddressed_nodes", "nodes of other computers that are registered under an address such as localhost", Some(status.nodes.misaddressed_nodes.len() as f64)),
        ("bypassing", "processes and computers that bypass rosrescue and talk to the master directly", Some(status.bypassing.len() as f64)),
        ("clients", "connections of clients, a thousand at most", Some(status.clients.len() as f64)),
        ("journal_bytes", "size of the checkpoint's journal", Some(journal.bytes as f64)),
        ("snapshot_bytes", "size of the checkpoint before its journal", Some(journal.snapshot_bytes as f64)),
        ("disk_free_bytes", "bytes free on the checkpoint's disk", journal.disk_free_bytes.map(|bytes| bytes as f64)),
        ("last_recovery_seconds", "how long calls did not pass to the master in the last recovery", status.last_recovery.as_ref().map(|report| report.phases.total_ms / 1e3)),
    ];
    for (name, help, value) in values {
        if let Some(value) = value {
            add(&mut text, name, help, value);
        }
    }
    let names = ConditionName::ALL.map(|name| (name.as_str(), status.condition.name == name));
    let help = "1 for the present condition, as in /status.json, and 0 for the others";
    add_one_of(&mut text, "condition", help, "name", &names);
    add_ill_nodes(&mut text, &status.nodes);
    if let Some(cluster) = &status.cluster {
        add_cluster(&mut text, cluster);
    }
    let help = "duration of calls, from the decoded request to the answer, by class of method";
    head(&mut text, TIMES, help, "histogram");
    stats.times.write(&mut text, &format!("rosrescue_{TIMES}"));
    head(
        &mut text,
        "build_info",
        "1, with the version of rosrescue",
        "gauge",
    );
    let version = escaped(env!("ROSRESCUE_VERSION"));
    let _ = writeln!(text, "rosrescue_build_info{{version=\"{version}\"}} 1");
    for (name, help, value) in process {
        add_named(&mut text, name, help, value);
    }
    text
}

/// The text of [`metrics`] as OpenMetrics: the name of a counter's family is without `_total`, and the text has an end.
pub(crate) fn openmetrics(text: &str) -> String {
    let mut open = String::with_capacity(text.len() + 6);
    for line in text.lines() {
        let mut words = line.splitn(4, ' ');
        match (words.next(), words.next(), words.next(), words.next()) {
            (Some("#"), Some(word), Some(name), Some(rest)) => {
                let name = name.strip_suffix("_total").unwrap_or(name);
                let _ = writeln!(open, "# {word} {name} {rest}");
            }
            _ => {
                let _ = writeln!(open, "{line}");
            }
        }
    }
    open + "# EOF\n"
}

/// Adds a line for each node that is dead or unreachable.
fn add_ill_nodes(text: &mut String, nodes: &NodesStatus) {
    const NAME: &str = "node_since_seconds";
    let help = "since when a node has been dead or unreachable, in seconds since 1970, a hundred nodes at most";
    head(text, NAME, help, "gauge");
    let ill = nodes.node_health.iter().filter_map(|(node, of)| {
        let health = match of.health {
            Health::Dead => "dead",
            Health::Unreachable => "unreachable",
            Health::Alive | Health::Unchecked => return None,
        };
        Some((node, health, of.since))
    });
    for (node, health, since) in ill.take(ILL_MOST) {
        let _ = writeln!(
            text,
            "rosrescue_{NAME}{{node=\"{}\",health=\"{health}\"}} {since}",
            escaped(node)
        );
    }
}

fn add_cluster(text: &mut String, of: &Computers) {
    let away = of.computers.iter().filter(|computer| computer.away).count();
    let term = of.leader.as_ref().map_or(0, |leader| leader.term);
    let last = of.last_takeover.as_ref();
    #[rustfmt::skip]
    let values: [(&str, &str, Option<f64>); 11] = [
        ("cluster_leader", "whether any computer leads, as far as this one knows", Some(u8::from(of.leads().is_some()).into())),
        ("cluster_term", "number of the leader's term, which grows with each leader", Some(term as f64)),
        ("cluster_behind_records", "records of the journal that this computer's mirror lacks", Some(of.behind as f64)),
        ("cluster_uncommitted_records", "writes made here that etcd does not have yet", Some(of.uncommitted as f64)),
        ("cluster_etcd_up", "whether etcd answers", Some(u8::from(of.etcd_trouble.is_none()).into())),
        ("cluster_computers", "computers that this one has heard from since its rosrescue started, itself included", Some(of.computers.len() as f64)),
        ("cluster_computers_away", "computers that have not been heard from for 15 s", Some(away as f64)),
        ("cluster_takeovers_total", "takeovers by this computer", Some(of.takeovers as f64)),
        ("cluster_last_takeover_seconds", "duration of the last takeover, from the last sign of the previous leader to the first write answered here", last.map(|last| last.seconds)),
        ("cluster_lost_writes_total", "changes made while cut off that were lost, because others had changed the same data", Some(of.lost_writes as f64)),
        ("cluster_times_cut_off_total", "how often this computer was cut off since its rosrescue started", Some(of.times_cut_off as f64)),
    ];
    for (name, help, value) in values {
        if let Some(value) = value {
            add(text, name, help, value);
        }
    }
    let roles = [
        Role::Joining,
        Role::Following,
        Role::CatchingUp,
        Role::Leading,
        Role::Alone,
    ];
    let roles = roles.map(|role| (role_name(role), of.role == role));
    add_one_of(
        text,
        "cluster_role",
        "1 for the role of this computer, 0 for the others",
        "role",
        &roles,
    );
}

fn add(text: &mut String, name: &str, help: &str, value: impl Display) {
    add_named(text, &format!("rosrescue_{name}"), help, value);
}

fn add_named(text: &mut String, name: &str, help: &str, value: impl Display) {
    let kind = match name.ends_with("_total") {
        true => "counter",
        false => "gauge",
    };
    let _ = writeln!(
        text,
        "# HELP {name} {help}\n# TYPE {name} {kind}\n{name} {value}"
    );
}

/// A label's value in Prometheus' text format. Characters that must not be printed, and the backslash, are shown by
/// their numbers, such as `\u{a}`. So different names have different labels, and monitors and terminals are safe from them.
fn escaped(value: &str) -> String {
    let mut text = String::with_capacity(value.len());
    for c in value.chars() {
        match c {
            '"' => text.push_str("\\\""),
            // Prometheus reads two backslashes as one.
            c if c == '\\' || printable::is_unsafe(c) => {
                let _ = write!(text, "\\{}", c.escape_unicode());
            }
            c => text.push(c),
        }
    }
    text
}

/// The role's name in JSON and in metrics.
fn role_name(role: Role) -> &'static str {
    match role {
        Role::Joining => "joining",
        Role::Following => "following",
        Role::CatchingUp => "catching_up",
        Role::Leading => "leading",
        Role::Alone => "alone",
    }
}

/// Adds a gauge with one line per name: 1 for the name that applies, 0 for the others.
fn add_one_of(text: &mut String, name: &str, help: &str, label: &str, names: &[(&str, bool)]) {
    head(text, name, help, "gauge");
    for (is, so) in names {
        let value = u8::from(*so);
        // Writing to a string does not fail.
        let _ = writeln!(text, "rosrescue_{name}{{{label}=\"{is}\"}} {value}");
    }
}

fn head(text: &mut String, name: &str, help: &str, kind: &str) {
    let _ = write!(
        text,
        "# HELP rosrescue_{name} {help}\n# TYPE rosrescue_{name} {kind}\n"
    );
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::status::cluster_facts::ClusterFacts;

    #[test]
    fn no_name_forges_a_line_or_hides_in_a_label() {
        assert_eq!(escaped("/camera_\u{e9}"), "/camera_\u{e9}");
        assert_eq!(escaped("/a\" 1\n/b"), r#"/a\" 1\\u{a}/b"#);
        assert_eq!(escaped("/a\u{202e}b"), r"/a\\u{202e}b");
        // What looks like the number of a character is none.
        assert_eq!(escaped(r"\u{a}"), r"\\u{5c}u{a}");
    }

    #[test]
    fn openmetrics_names_the_family_of_a_counter_and_ends() {
        let mut text = String::new();
        add(&mut text, "calls_total", "calls", 2);
        add(&mut text, "nodes", "nodes of all", 3);
        assert_eq!(
            openmetrics(&text),
            "# HELP rosrescue_calls calls\n# TYPE rosrescue_calls counter\nrosrescue_calls_total 2\n\
             # HELP rosrescue_nodes nodes of all\n# TYPE rosrescue_nodes gauge\nrosrescue_nodes 3\n# EOF\n"
        );
    }

    #[test]
    fn a_cluster_has_its_own() {
        let mut facts = ClusterFacts::of_three();
        let of = |facts: &ClusterFacts| {
            let mut text = String::new();
            add_cluster(&mut text, &Computers::from(facts));
            text
        };
        let text = of(&facts);
        for line in [
            "# TYPE rosrescue_cluster_takeovers_total counter",
            "rosrescue_cluster_leader 1",
            "rosrescue_cluster_term 7",
            "rosrescue_cluster_behind_records 2",
            "rosrescue_cluster_etcd_up 1",
            "rosrescue_cluster_computers 3",
            "rosrescue_cluster_computers_away 1",
            "rosrescue_cluster_role{role=\"following\"} 1",
            "rosrescue_cluster_role{role=\"leading\"} 0",
        ] {
            assert!(text.lines().any(|found| found == line), "{line}\n{text}");
        }
        assert!(!text.contains("last_takeover"), "there was none");
        facts.leaderless = Some(facts.since);
        facts.etcd = Some((facts.since, String::new()));
        let text = of(&facts);
        assert!(text.contains("rosrescue_cluster_leader 0\n"), "{text}");
        assert!(text.contains("rosrescue_cluster_etcd_up 0\n"), "{text}");
    }
}
