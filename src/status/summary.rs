//! The status at one moment, as `/status.json` has it and `rosrescue status` reads it.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::{Mode, computers::Computers, condition::Condition, report::Report};
use crate::{clock, master::Counts};

/// The version of the format. It changes when a field goes away or gets another meaning; new fields do not
/// change it.
pub(crate) const SCHEMA: u32 = 1;

/// A connection of a client.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Client {
    pub(crate) peer: String,
    /// The caller id of its last call, cut if it is long.
    pub(crate) caller_id: String,
    /// Calls on this connection.
    pub(crate) calls: u64,
}

/// All calls of one caller since the start.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Caller {
    /// Its caller id, or the address of a client that says none.
    pub(crate) caller: String,
    pub(crate) calls: u64,
    /// Until the answer was ready, in milliseconds.
    pub(crate) mean_ms: f64,
    pub(crate) longest_ms: f64,
    /// When the longest call ended: seconds since 1970.
    pub(crate) longest_at: f64,
}

/// The checkpoint's journal.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Journal {
    /// Since the checkpoint was last written as a whole.
    pub(crate) records: u64,
    pub(crate) bytes: u64,
    /// The part of the file before the journal.
    pub(crate) snapshot_bytes: u64,
    /// When the checkpoint was last written as a whole: seconds since 1970.
    pub(crate) last_compaction: Option<f64>,
    /// What is free on its disk.
    pub(crate) disk_free_bytes: Option<u64>,
}

/// The status at one moment. All times of day are seconds since 1970 by the wall clock.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Status {
    /// [`SCHEMA`].
    pub(crate) schema: u32,
    pub(crate) version: String,
    pub(crate) mode: Mode,
    /// The process that serves nodes.
    pub(crate) pid: u32,
    /// When it was started.
    pub(crate) started: f64,
    /// The same, in seconds until now.
    pub(crate) uptime: f64,
    /// What nodes use as `ROS_MASTER_URI`.
    pub(crate) uri: String,
    pub(crate) condition: Condition,
    /// The real master's address.
    pub(crate) master: String,
    /// Its process id, or the last one's; none if there was none.
    pub(crate) master_pid: Option<i32>,
    /// What the last one spoke: HTTP and Python.
    #[serde(default)]
    pub(crate) master_speaks: Option<String>,
    /// What talks to the master of `proxy` past rosrescue: processes, users and other computers.
    #[serde(default)]
    pub(crate) bypassing: Vec<String>,
    /// Whether the master of `proxy` is on this computer and takes connections from others.
    #[serde(default)]
    pub(crate) master_is_open: bool,
    /// Whether calls pass to the master.
    pub(crate) open: bool,
    /// Whether calls are answered, by the master or the mirror.
    pub(crate) ready: bool,
    /// Whether calls go to another computer, which has the master.
    #[serde(default)]
    pub(crate) elsewhere: bool,
    /// Since when the mirror stands in; none while calls pass.
    pub(crate) standing_in_since: Option<f64>,
    /// Writes that the mirror has answered and the master has not run yet.
    pub(crate) pending_writes: usize,
    /// Whether the master keeps dying.
    pub(crate) crash_loop: bool,
    /// Masters that have died in this session.
    pub(crate) deaths: u64,
    /// Times that rosrescue itself has died and was started again, in this session.
    #[serde(default)]
    pub(crate) worker_restarts: u64,
    pub(crate) checkpoint: String,
    /// Why the state is not recorded; none if it is.
    pub(crate) unprotected: Option<String>,
    pub(crate) journal: Journal,
    /// Whether the guardian or systemd keeps the port and restarts rosrescue when it dies.
    pub(crate) guarded: bool,
    pub(crate) guarded_by: String,
    /// Contents of the mirror.
    pub(crate) state: Counts,
    /// Nodes that do not answer and are not known to be dead.
    pub(crate) unreachable: Vec<String>,
    /// Registered nodes whose port refuses connections.
    #[serde(default)]
    pub(crate) dead_nodes: Vec<String>,
    /// Registered nodes that were not asked yet, or not lately.
    #[serde(default)]
    pub(crate) unchecked_nodes: Vec<String>,
    /// How many registered nodes live, by the kernel's table of sockets or an answer.
    #[serde(default)]
    pub(crate) alive_nodes: usize,
    /// Masters examined since the start, the first one included.
    pub(crate) recoveries: u64,
    /// The report of the last one.
    pub(crate) last_recovery: Option<Report>,
    /// Rescues in this session, and the reports of the last 20, the oldest first.
    pub(crate) rescues: u64,
    pub(crate) last_rescues: Vec<Report>,
    /// Between the last two times when somebody asked, at least a second apart.
    pub(crate) calls_per_second: f64,
    /// The callers whose longest call took longest, at most 20.
    pub(crate) slowest_callers: Vec<Caller>,
    /// Connections of clients, at most a thousand.
    pub(crate) clients: Vec<Client>,
    /// Counters since the start.
    pub(crate) counters: serde_json::Map<String, serde_json::Value>,
    /// The computers of the robot; none if it is this one alone.
    #[serde(default)]
    pub(crate) cluster: Option<Computers>,
}

impl Status {
    /// A counter's value; 0 if an older rosrescue does not know it.
    pub(crate) fn counter(&self, name: &str) -> u64 {
        let value = self.counters.get(name);
        value.and_then(serde_json::Value::as_u64).unwrap_or(0)
    }

    fn nodes_line(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let lists = [
            (&self.dead_nodes, "dead but registered"),
            (&self.unreachable, "not answering"),
            (&self.unchecked_nodes, "not checked"),
        ];
        write!(f, "nodes       {} alive", self.alive_nodes)?;
        for (names, what) in lists.into_iter().filter(|(names, _)| !names.is_empty()) {
            write!(f, "; {} {what}: {}", names.len(), some(names))?;
        }
        writeln!(f)
    }

    fn master_line(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "master      {}", self.master)?;
        if let Some(pid) = self.master_pid {
            write!(f, ", process {pid}")?;
        }
        if let Some(speaks) = &self.master_speaks {
            write!(f, ", {speaks}")?;
        }
        if self.master_is_open {
            write!(f, ", open to other computers")?;
        }
        writeln!(f, "{}", died(self.deaths))
    }
}

/// Ten lines for a tired person, and what is wrong in more.
impl fmt::Display for Status {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Condition {
            since,
            text,
            action,
            ..
        } = &self.condition;
        let until = self.started + self.uptime;
        writeln!(
            f,
            "{}, since {} ({})",
            self.condition.title(),
            clock::wall_text(*since),
            clock::span(until - since)
        )?;
        writeln!(f, "            {text}")?;
        if let Some(action) = action {
            writeln!(f, "to do       {action}")?;
        }
        let mode = match self.mode {
            Mode::Core => "core",
            Mode::Proxy => "proxy",
        };
        writeln!(
            f,
            "rosrescue   {} {mode}, process {}, up {}{}, guarded by {}",
            self.version,
            self.pid,
            clock::span(self.uptime),
            died(self.worker_restarts),
            self.guarded_by
        )?;
        writeln!(f, "address     {}", self.uri)?;
        if self.elsewhere {
            writeln!(f, "master      none on this computer")?;
        } else {
            self.master_line(f)?;
        }
        if let Some(cluster) = &self.cluster {
            cluster.lines(until, f)?;
        }
        writeln!(f, "state       {}", self.state)?;
        self.nodes_line(f)?;
        writeln!(
            f,
            "calls       {}, {:.1} per second; {} answered by rosrescue, {} timed out",
            self.counter("calls"),
            self.calls_per_second,
            self.counter("calls_without_master"),
            self.counter("calls_unanswered")
        )?;
        let journal = &self.journal;
        writeln!(
            f,
            "checkpoint  {}, {}, {} free",
            self.checkpoint,
            size(journal.bytes + journal.snapshot_bytes),
            journal
                .disk_free_bytes
                .map_or_else(|| "unknown".to_owned(), size)
        )?;
        if self.pending_writes > 0 {
            writeln!(
                f,
                "pending     {} changes for the next master",
                self.pending_writes
            )?;
        }
        match self.last_rescues.last() {
            Some(report) => write!(f, "rescues     {}, the last:\n{report}", self.rescues),
            None => writeln!(f, "rescues     none needed so far"),
        }
    }
}

/// How often something has died.
fn died(times: u64) -> String {
    match times {
        0 => String::new(),
        1 => ", died once".to_owned(),
        times => format!(", died {times} times"),
    }
}

/// Names for people, not all of very many.
pub(crate) fn some(names: &[String]) -> String {
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

/// Bytes for people.
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
