//! `rosrescue top`: shows calls, callers, nodes and rescues, once a second.

use std::{
    collections::{BTreeMap, HashMap},
    fmt,
    time::Duration,
};

use ros1_master::master::Counts;
use serde::Serialize;
use tokio::{
    signal::unix::{SignalKind, signal},
    time::{Instant, MissedTickBehavior, interval},
};

use super::{
    CommandFailure, Exit,
    end_signals::EndSignals,
    note, print_line,
    running::Running,
    terminal::{self, Terminal},
};
use crate::{
    cli::TopArgs,
    clock,
    printable::{Lines, Page, Printable, display_lines, line},
    status::{
        computers::Computers,
        condition::Condition,
        report::{LateAnswers, Report},
        summary::{Caller, NodesStatus, Status},
    },
};

const SECOND: Duration = Duration::from_secs(1);
/// Number of rescues shown.
const RESCUES: usize = 5;

/// Calls of one caller in the last second and since the start.
#[derive(Debug, Serialize)]
struct Row {
    caller: String,
    calls_per_second: f64,
    calls: u64,
    mean_ms: Option<f64>,
    longest_ms: Option<f64>,
    longest_at: Option<f64>,
}

/// One picture of `rosrescue top`.
#[derive(Debug, Serialize)]
struct Top {
    /// Seconds since 1970, from the clock of rosrescue's computer.
    at: f64,
    uri: String,
    condition: Condition,
    calls_per_second: f64,
    calls: u64,
    calls_without_master: u64,
    calls_unanswered: u64,
    state: Counts,
    #[serde(flatten)]
    nodes: NodesStatus,
    cluster: Option<Computers>,
    /// Callers, busiest first, then slowest first.
    callers: Vec<Row>,
    rescues: u64,
    last_rescues: Vec<Report>,
    late_answers: LateAnswers,
    /// Columns and rows of the terminal.
    #[serde(skip)]
    size: (usize, usize),
}

/// Numbers of calls so far. Two samples give the calls per second.
struct Sample {
    at: Instant,
    calls: u64,
    by_peer: HashMap<String, u64>,
}

impl Sample {
    fn new(status: &Status, at: Instant) -> Self {
        let clients = status.clients.iter();
        Self {
            at,
            calls: status.counter("calls"),
            by_peer: clients.map(|of| (of.peer.clone(), of.calls)).collect(),
        }
    }
}

/// Builds the picture of `status`, which was read at `now`, for a terminal with `size` columns and rows.
fn top(status: Status, before: Option<&Sample>, now: Instant, size: (usize, usize)) -> Top {
    let calls = status.counter("calls");
    let seconds = before.map(|before| now.duration_since(before.at).as_secs_f64().max(0.1));
    let rate = |calls: u64| seconds.map_or(0.0, |seconds| calls as f64 / seconds);
    let calls_per_second = match before {
        Some(before) => rate(calls.saturating_sub(before.calls)),
        None => status.calls_per_second,
    };
    let mut rates: BTreeMap<String, (f64, u64)> = BTreeMap::new();
    for client in &status.clients {
        let earlier = before.and_then(|before| before.by_peer.get(&client.peer));
        let new = client.calls.saturating_sub(earlier.copied().unwrap_or(0));
        let name = match client.caller_id.is_empty() {
            true => client.peer.rsplit_once(':').map_or("", |(host, _)| host),
            false => &client.caller_id,
        };
        let (sum, all) = rates.entry(name.to_owned()).or_default();
        *sum += rate(new);
        *all += client.calls;
    }
    let mut times: HashMap<&str, &Caller> = HashMap::new();
    for caller in &status.slowest_callers {
        times.insert(&caller.caller, caller);
        rates.entry(caller.caller.clone()).or_default();
    }
    let mut callers: Vec<_> = rates
        .into_iter()
        .map(|(caller, (calls_per_second, calls))| {
            let times = times.get(&*caller);
            Row {
                calls_per_second,
                calls: times.map_or(calls, |times| times.calls.max(calls)),
                mean_ms: times.map(|times| times.mean_ms),
                longest_ms: times.map(|times| times.longest_ms),
                longest_at: times.map(|times| times.longest_at),
                caller,
            }
        })
        .filter(|row| row.calls > 0)
        .collect();
    callers.sort_by(|a, b| {
        let key = |row: &Row| (row.calls_per_second, row.longest_ms.unwrap_or(0.0));
        key(b)
            .partial_cmp(&key(a))
            .unwrap_or(std::cmp::Ordering::Equal)
    });
    Top {
        at: status.started + status.uptime,
        calls_per_second,
        calls,
        calls_without_master: status.counter("calls_without_master"),
        calls_unanswered: status.counter("calls_unanswered"),
        uri: status.uri,
        condition: status.condition,
        state: status.state,
        nodes: status.nodes,
        cluster: status.cluster,
        callers,
        rescues: status.rescues,
        last_rescues: status.last_rescues,
        late_answers: status.late_answers,
        size,
    }
}

impl Lines for Top {
    fn lines(&self, f: &mut Page) -> fmt::Result {
        let (width, height) = self.size;
        let wrap = |head: &mut Page, text: &str| {
            let mut lines = wrapped(text, width).into_iter();
            lines.try_for_each(|part| line!(head, "{part}"))
        };
        let mut head = Page::default();
        let Condition {
            since,
            text,
            action,
            ..
        } = &self.condition;
        line!(
            head,
            "rosrescue top   {}   {}",
            clock::wall_text(self.at),
            self.uri
        )?;
        line!(
            head,
            "{}, for {}",
            self.condition.title(),
            clock::span(self.at - since)
        )?;
        wrap(&mut head, text)?;
        if let Some(action) = action {
            wrap(&mut head, &format!("To do: {action}"))?;
        }
        line!(
            head,
            "{:.1} calls per second, {} in all; {} answered by rosrescue, {} timed out",
            self.calls_per_second,
            self.calls,
            self.calls_without_master,
            self.calls_unanswered
        )?;
        let Counts {
            nodes,
            publishers,
            subscribers,
            services,
            params,
            ..
        } = self.state;
        line!(
            head,
            "nodes {nodes}, publishers {publishers}, subscribers {subscribers}, services {services}, \
             parameters {params}"
        )?;
        wrap(&mut head, &format!("nodes: {}", self.nodes.line()))?;
        if let Some(cluster) = &self.cluster {
            line!(head, "computers: {}", cluster.line())?;
        }
        let mut foot = Page::default();
        line!(foot)?;
        line!(foot, "rescues so far: {}", self.rescues)?;
        if self.late_answers.times > 0 {
            line!(foot, "late: {}", self.late_answers)?;
        }
        for report in self.last_rescues.iter().rev().take(RESCUES) {
            line!(foot, "{}", report.line())?;
        }
        // One empty line and the table's heading.
        let taken = head.count() + foot.count() + 2;
        f.append(&head);
        line!(f)?;
        write!(f, "{:<32}", "CALLER")?;
        line!(
            f,
            "{:>9}{:>9}{:>9}{:>11}",
            "CALLS/S",
            "CALLS",
            "MEAN ms",
            "LONGEST ms"
        )?;
        for row in self.callers.iter().take(height.saturating_sub(taken)) {
            let ms = |ms: Option<f64>| ms.map_or_else(String::new, |ms| format!("{ms:.1}"));
            let caller: String = row.caller.chars().take(31).collect();
            write!(
                f,
                "{caller:<32}{:>9.1}{:>9}",
                row.calls_per_second, row.calls
            )?;
            write!(f, "{:>9}{:>11}", ms(row.mean_ms), ms(row.longest_ms))?;
            let at = row.longest_at.map(clock::wall_text).unwrap_or_default();
            // The time of day.
            line!(f, " {}", at.get(11..19).unwrap_or(""))?;
        }
        f.append(&foot);
        Ok(())
    }
}

display_lines!(Top);

/// `text` in lines of at most `width` characters, broken at spaces. A longer word has a line of its own.
fn wrapped(text: &str, width: usize) -> Vec<String> {
    let mut lines = Vec::<String>::new();
    for word in text.split(' ') {
        match lines.last_mut() {
            Some(line) if line.chars().count() + 1 + word.chars().count() <= width => {
                *line += &format!(" {word}");
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines
}

pub(super) async fn run(args: &TopArgs) -> Result<Exit, CommandFailure> {
    let running = Running::find(&args.target)?;
    // The first status is read before the terminal is taken over, so that an error is printed normally.
    let mut status = running.status().await;
    if let Err(failure) = status {
        return Err(failure);
    }
    let mut ends = EndSignals::new()?;
    let mut resized = signal(SignalKind::window_change())
        .map_err(|error| CommandFailure::Failed(format!("no signals: {error}")))?;
    let terminal = match args.json {
        true => None,
        false => Terminal::enter(),
    };
    let mut keys = terminal.is_some().then(terminal::keys);
    let mut seconds = interval(SECOND);
    seconds.set_missed_tick_behavior(MissedTickBehavior::Delay);
    seconds.tick().await;
    let mut before: Option<Sample> = None;
    let mut shown = Printable::default();
    let mut rounds = 0;
    loop {
        let now = Instant::now();
        let failed = match status {
            Ok(status) => {
                let sample = Sample::new(&status, now);
                let size = match terminal {
                    Some(_) => terminal::size(),
                    None => (usize::MAX, usize::MAX),
                };
                let top = top(status, before.as_ref(), now, size);
                before = Some(sample);
                shown = match args.json {
                    true => super::json(&top, false)?,
                    false => Printable::lines(&top),
                };
                None
            }
            // rosrescue may be restarting.
            Err(failure) => Some(failure),
        };
        match (&terminal, &failed) {
            (Some(terminal), _) => draw(terminal, failed.as_ref(), &shown),
            (None, None) if !print_line(&shown)? => return Ok(Exit::Good),
            (None, None) => {}
            (None, Some(failure)) => note(&failure.to_string()),
        }
        rounds += 1;
        if args.count.is_some_and(|count| rounds >= count) {
            return failed.map_or(Ok(Exit::Good), Err);
        }
        let next = async {
            seconds.tick().await;
            running.status().await
        };
        tokio::pin!(next);
        status = loop {
            tokio::select! {
                status = &mut next => break status,
                () = ends.received() => return Ok(Exit::Good),
                _ = resized.recv() => if let Some(terminal) = &terminal {
                    draw(terminal, failed.as_ref(), &shown);
                },
                key = async { keys.as_mut()?.recv().await }, if keys.is_some() => match key {
                    Some(b'q' | b'Q' | 3 | 4) => return Ok(Exit::Good),
                    Some(_) => {}
                    None => keys = None,
                },
            }
        };
    }
}

/// Shows `shown`, and above it why the last look has failed, if it has.
fn draw(terminal: &Terminal, failed: Option<&CommandFailure>, shown: &Printable) {
    match failed {
        None => terminal.draw(shown),
        Some(failure) => {
            let lines = wrapped(&failure.to_string(), terminal::size().0);
            terminal.draw_under(&lines, shown);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_advice_is_wrapped() {
        let text = "To do: restart the nodes /a, /b and /camera.";
        let lines = ["To do: restart the", "nodes /a, /b and", "/camera."];
        assert_eq!(wrapped(text, 18), lines);
        assert_eq!(wrapped(text, usize::MAX), [text]);
        assert_eq!(wrapped("http://nobody.invalid:11311/ a", 5).len(), 2);
    }
}
