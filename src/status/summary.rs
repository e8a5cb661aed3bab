//! The complete status at one moment, for `/status.json` and `rosrescue status`.

use std::{collections::BTreeMap, fmt, net::IpAddr};

use rescue_core::health::{Feud, Health};
use ros1_master::master::Counts;
use serde::{Deserialize, Serialize};

use super::{
    Mode,
    computers::Computers,
    condition::Condition,
    report::{LateAnswers, Report},
};
use crate::{
    clock,
    printable::{Lines, Page, display_lines, line},
};

/// Version of the format. It changes when a field is removed or changes its meaning, not when a
/// field is added.
pub(crate) const SCHEMA: u32 = 1;

/// A client's connection.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct ClientStatus {
    pub(crate) peer: String,
    /// Caller id of the last call, shortened if it is long.
    pub(crate) caller_id: String,
    /// Number of calls on this connection.
    pub(crate) calls: u64,
}

/// Statistics of all calls by one caller since this process started.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Caller {
    /// The caller id, or the client's address if it sends none.
    pub(crate) caller: String,
    pub(crate) calls: u64,
    /// Mean time until the answer was ready, in milliseconds.
    pub(crate) mean_ms: f64,
    pub(crate) longest_ms: f64,
    /// When the longest call ended, in seconds since 1970.
    pub(crate) longest_at: f64,
}

/// Sizes and times of the checkpoint's journal.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct JournalStatus {
    /// Number of records since the checkpoint was last rewritten as a whole.
    pub(crate) records: u64,
    pub(crate) bytes: u64,
    /// Size of the checkpoint file before the journal begins.
    pub(crate) snapshot_bytes: u64,
    /// When the checkpoint was last rewritten as a whole, in seconds since 1970.
    pub(crate) last_compaction: Option<f64>,
    /// Free bytes on the checkpoint's disk.
    pub(crate) disk_free_bytes: Option<u64>,
}

/// Which nodes are alive, and what is wrong with others.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct NodesStatus {
    /// Nodes that do not answer but are not known to be dead.
    pub(crate) unreachable: Vec<String>,
    /// Registered nodes whose process has ended, or whose port refuses connections.
    pub(crate) dead_nodes: Vec<String>,
    /// Nodes that have died, that rosrescue has unregistered in the last ten minutes, and that have not come back.
    pub(crate) unregistered_nodes: Vec<IllNode>,
    /// Registered nodes that have not been checked, or not in the last two minutes.
    pub(crate) unchecked_nodes: Vec<String>,
    /// Number of registered nodes that are alive, by the kernel's socket table or an answer.
    pub(crate) alive_nodes: usize,
    /// All registered nodes that are not known to be alive, by name.
    pub(crate) node_health: BTreeMap<String, NodeHealth>,
    /// Names that two programs take from each other.
    pub(crate) feuds: Vec<Feud>,
    /// Addresses that this computer has lost, and at which nodes are registered.
    pub(crate) lost_addresses: Vec<LostAddress>,
    /// Nodes of other computers that no computer but their own can reach, because they have registered under an address
    /// such as `localhost`.
    pub(crate) misaddressed_nodes: Vec<Misaddressed>,
}

/// A node that has registered from another computer under an address that means each computer itself, such as `localhost`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Misaddressed {
    pub(crate) node: String,
    pub(crate) api: String,
    /// The address of the computer from which the node has registered.
    pub(crate) from: IpAddr,
    /// When rosrescue noticed it, in seconds since 1970.
    pub(crate) since: f64,
}

/// An address that this computer has lost.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct LostAddress {
    pub(crate) address: IpAddr,
    /// When rosrescue noticed it, in seconds since 1970.
    pub(crate) since: f64,
    /// The nodes that are registered there.
    pub(crate) nodes: Vec<String>,
}

/// A node that is dead or does not answer.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct IllNode {
    pub(crate) node: String,
    /// Since when, in seconds since 1970.
    pub(crate) since: f64,
}

impl fmt::Display for IllNode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} since {}", self.node, clock::wall_text(self.since))
    }
}

/// The health of a node that is not known to be alive.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct NodeHealth {
    pub(crate) health: Health,
    /// Since when the health has been the same, in seconds since 1970.
    pub(crate) since: f64,
}

impl NodesStatus {
    /// The names of `names`, each with the time since when its health has been the same.
    fn with_times(&self, names: &[String]) -> String {
        let with_time = |name: &String| match self.node_health.get(name) {
            Some(of) => format!("{name} since {}", clock::wall_text(of.since)),
            None => name.clone(),
        };
        shortened(&names.iter().map(with_time).collect::<Vec<_>>())
    }

    /// How many nodes are alive, and which are not.
    pub(crate) fn line(&self) -> String {
        let lists = [
            (&self.dead_nodes, "dead but registered"),
            (&self.unreachable, "not answering"),
            (&self.unchecked_nodes, "not checked"),
        ];
        let ill = lists.into_iter().filter(|(names, _)| !names.is_empty());
        let ill = ill
            .map(|(names, what)| format!("; {} {what}: {}", names.len(), self.with_times(names)));
        format!("{} alive{}", self.alive_nodes, ill.collect::<String>())
    }
}

/// The status at one moment. Times of day are seconds since 1970 by the wall clock.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Status {
    /// Version of the format: [`SCHEMA`].
    pub(crate) schema: u32,
    pub(crate) version: String,
    pub(crate) mode: Mode,
    /// Id of the process that serves nodes.
    pub(crate) pid: u32,
    /// When this process started.
    pub(crate) started: f64,
    /// Seconds since this process started.
    pub(crate) uptime: f64,
    /// Address that nodes use as `ROS_MASTER_URI`.
    pub(crate) uri: String,
    pub(crate) condition: Condition,
    /// Address of the real master.
    pub(crate) master: String,
    /// Process id of the present or last master. `None` if there was none.
    pub(crate) master_pid: Option<i32>,
    /// HTTP version and Python version of the present or last master.
    pub(crate) master_speaks: Option<String>,
    /// Processes, users and computers that bypass rosrescue and talk directly to the master of
    /// `proxy`.
    pub(crate) bypassing: Vec<String>,
    /// Whether the master of `proxy` runs on this computer and accepts connections from other
    /// computers.
    pub(crate) master_is_open: bool,
    /// Whether calls pass to the master.
    pub(crate) open: bool,
    /// Whether calls are answered: by the master, the mirror or another computer.
    pub(crate) ready: bool,
    /// Whether another computer has the master and calls go there.
    pub(crate) elsewhere: bool,
    /// Since when the mirror has answered in the master's place. `None` if calls pass to a master.
    pub(crate) standing_in_since: Option<f64>,
    /// Number of writes that the mirror answered and the master has not run yet.
    pub(crate) pending_writes: usize,
    /// Whether the master keeps dying.
    pub(crate) crash_loop: bool,
    /// Number of masters that have died in this session.
    pub(crate) deaths: u64,
    /// Number of times rosrescue itself died and was restarted in this session.
    pub(crate) worker_restarts: u64,
    pub(crate) checkpoint: String,
    /// Why the state is not recorded. `None` if it is recorded.
    pub(crate) unprotected: Option<String>,
    pub(crate) journal: JournalStatus,
    /// Whether the guardian or systemd keeps the port and restarts rosrescue when it dies.
    pub(crate) guarded: bool,
    pub(crate) guarded_by: String,
    /// Number of items of each kind in the mirror.
    pub(crate) state: Counts,
    #[serde(flatten)]
    pub(crate) nodes: NodesStatus,
    /// Number of masters examined since this process started, including the first.
    pub(crate) recoveries: u64,
    /// Report of the last recovery.
    pub(crate) last_recovery: Option<Report>,
    /// Number of rescues in this session. `last_rescues` has the reports of the last 20, oldest first.
    pub(crate) rescues: u64,
    pub(crate) last_rescues: Vec<Report>,
    /// Outages in which nothing died, since this process started.
    pub(crate) late_answers: LateAnswers,
    /// Calls per second between the last two requests for the status that were at least a second
    /// apart.
    pub(crate) calls_per_second: f64,
    /// The callers with the longest calls, at most 20.
    pub(crate) slowest_callers: Vec<Caller>,
    /// Connections of clients, at most 1,000.
    pub(crate) clients: Vec<ClientStatus>,
    /// Counters since this process started.
    pub(crate) counters: serde_json::Map<String, serde_json::Value>,
    /// The robot's computers. `None` without `--cluster`.
    pub(crate) cluster: Option<Computers>,
}

impl Status {
    /// A counter's value; 0 if the running rosrescue has no such counter.
    pub(crate) fn counter(&self, name: &str) -> u64 {
        let value = self.counters.get(name);
        value.and_then(serde_json::Value::as_u64).unwrap_or(0)
    }

    fn master_line(&self, f: &mut Page) -> fmt::Result {
        write!(f, "master      {}", self.master)?;
        match self.master_pid {
            Some(pid) if self.open => write!(f, ", process {pid}")?,
            Some(pid) => write!(f, ", not serving; the last one was process {pid}")?,
            None => {}
        }
        if let Some(speaks) = &self.master_speaks {
            write!(f, ", {speaks}")?;
        }
        if self.master_is_open {
            write!(f, ", open to other computers")?;
        }
        line!(f, "{}", died(self.deaths))
    }
}

/// Writes the status in ten lines, plus one for each problem.
impl Lines for Status {
    fn lines(&self, f: &mut Page) -> fmt::Result {
        let Condition {
            since,
            text,
            action,
            ..
        } = &self.condition;
        let until = self.started + self.uptime;
        line!(
            f,
            "{}, since {} ({})",
            self.condition.title(),
            clock::wall_text(*since),
            clock::span(until - since)
        )?;
        line!(f, "            {text}")?;
        if let Some(action) = action {
            line!(f, "to do       {action}")?;
        }
        let mode = match self.mode {
            Mode::Core => "core",
            Mode::Proxy => "proxy",
        };
        line!(
            f,
            "rosrescue   {} {mode}, process {}, up {}{}, guarded by {}",
            self.version,
            self.pid,
            clock::span(self.uptime),
            died(self.worker_restarts),
            self.guarded_by
        )?;
        line!(f, "address     {}", self.uri)?;
        if self.elsewhere {
            line!(f, "master      none on this computer")?;
        } else {
            self.master_line(f)?;
        }
        if let Some(cluster) = &self.cluster {
            cluster.lines(until, f)?;
        }
        line!(f, "state       {}", self.state)?;
        line!(f, "nodes       {}", self.nodes.line())?;
        line!(
            f,
            "calls       {}, {:.1} per second; {} answered by rosrescue, {} timed out",
            self.counter("calls"),
            self.calls_per_second,
            self.counter("calls_without_master"),
            self.counter("calls_unanswered")
        )?;
        let journal = &self.journal;
        line!(
            f,
            "checkpoint  {}, {}, {} free",
            self.checkpoint,
            size(journal.bytes + journal.snapshot_bytes),
            journal
                .disk_free_bytes
                .map_or_else(|| "unknown".to_owned(), size)
        )?;
        if self.pending_writes > 0 {
            line!(
                f,
                "pending     {} for the next master",
                counted(self.pending_writes, "change")
            )?;
        }
        if self.late_answers.times > 0 {
            line!(f, "late        {}", self.late_answers)?;
        }
        match self.last_rescues.last() {
            Some(report) => {
                line!(f, "rescues     {}, the last:", self.rescues)?;
                report.lines(f)
            }
            None => line!(f, "rescues     none needed so far"),
        }
    }
}

display_lines!(Status);

/// How often something has died, as a phrase.
fn died(times: u64) -> String {
    match times {
        0 => String::new(),
        1 => ", died once".to_owned(),
        times => format!(", died {times} times"),
    }
}

/// A count with its noun, as in `1 message` and `2 messages`.
pub(crate) fn counted(count: usize, thing: &str) -> String {
    let plural = if count == 1 { "" } else { "s" };
    format!("{count} {thing}{plural}")
}

/// Lists names for people, and shortens long lists.
pub(crate) fn shortened(names: &[String]) -> String {
    const MOST: usize = 10;
    let shown = names
        .iter()
        .take(MOST)
        .cloned()
        .collect::<Vec<_>>()
        .join(", ");
    match names.len().saturating_sub(MOST) {
        0 => shown,
        more => format!("{shown} and {more} more"),
    }
}

/// Formats a number of bytes for people.
pub(crate) fn size(bytes: u64) -> String {
    let mut value = bytes as f64;
    for unit in ["B", "kB", "MB", "GB"] {
        if value < 1000.0 {
            let digits = usize::from(unit != "B" && value < 10.0);
            return format!("{value:.digits$} {unit}");
        }
        value /= 1000.0;
    }
    format!("{value:.1} TB")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_is_singular() {
        assert_eq!(counted(1, "change"), "1 change");
        assert_eq!(counted(2, "change"), "2 changes");
    }

    #[test]
    fn sizes() {
        for (bytes, text) in [
            (0, "0 B"),
            (999, "999 B"),
            (1_234, "1.2 kB"),
            (12_345, "12 kB"),
            (64_000_000_000, "64 GB"),
            (2_000_000_000_000, "2.0 TB"),
        ] {
            assert_eq!(size(bytes), text);
        }
    }
}
