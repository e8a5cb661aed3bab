//! `rosrescue log`: shows what changed, when, and who did it.

use std::{
    collections::VecDeque, io, num::NonZero, path::Path, thread::ScopedJoinHandle, time::Duration,
};

use checkpoint_store::change_log::{LogFile, files as log_files};
use rescue_core::checkpoint::{
    change_log::{LogEntry, LogReader},
    compare::{Difference, What},
    format,
    putback::is_in,
};
use serde::Serialize;

use super::{CommandFailure, Exit, files, note, print_line};
use crate::{
    cli::LogArgs, clock, printable::Printable, recovery::report_file, status::report::Report,
};

/// Pause between two looks at the checkpoint with `--follow`.
const LOOK: Duration = Duration::from_millis(500);
/// Number of files that `--follow` reads again: the last part of the log, the previous generation and the checkpoint.
const LIVE_FILES: usize = 3;
/// Maximum number of files that are read before those without a wanted entry are dropped.
const FILES_AT_ONCE: usize = 32;

pub(super) async fn run(args: &LogArgs) -> Result<Exit, CommandFailure> {
    let path = files::present(&args.checkpoint).await;
    let wanted = Wanted::new(args);
    let mut reader = LogReader::new(args.hide.hide_values.clone());
    let mut rescues = rescues(&path, &wanted);
    let mut found = false;
    let mut last = 0;
    let mut show_all = |entries: Vec<LogEntry>| {
        found |= !entries.is_empty();
        for mut entry in entries {
            // A rescue has the number of the record before it.
            match entry.seq {
                0 => entry.seq = last,
                seq => last = seq,
            }
            if !show(&entry, args.json)? {
                return Ok::<_, CommandFailure>(false);
            }
        }
        Ok(true)
    };
    if args.lines == 0 && wanted.is_everything() {
        // A month has millions of changes, so they are shown while the rest is read.
        for files in list(&path)?.chunks(LIVE_FILES) {
            let entries = read_thin(&thinned(files, &wanted), &wanted, &mut reader);
            if !show_all(with_rescues(entries, &mut rescues))? {
                return Ok(Exit::Good);
            }
        }
    } else {
        let lines = match args.lines {
            0 => usize::MAX,
            lines => lines,
        };
        let entries = newest(&path, &wanted, lines, &mut reader)?;
        let mut entries = with_rescues(entries, &mut rescues);
        entries.extend(rescues.drain(..));
        entries.drain(..entries.len().saturating_sub(lines));
        if !show_all(entries)? {
            return Ok(Exit::Good);
        }
    }
    if !show_all(rescues.into())? {
        return Ok(Exit::Good);
    }
    if !args.follow {
        if found {
            return Ok(Exit::Good);
        }
        note(&nothing_found(&path, &wanted));
        return Ok(Exit::Bad);
    }
    loop {
        tokio::time::sleep(LOOK).await;
        let files = list(&path)?;
        let live = files.iter().skip(files.len().saturating_sub(LIVE_FILES));
        // A file may be replaced while it is read. The next look finds what is missing.
        live.filter_map(|file| file.read().ok())
            .for_each(|text| drop(reader.read(&text)));
        let new = reader.take_entries().into_iter();
        for entry in new.filter(|entry| wanted.selects(entry)) {
            if !show(&entry, args.json)? {
                return Ok(Exit::Good);
            }
        }
    }
}

/// Why the log shows nothing.
fn nothing_found(path: &Path, wanted: &Wanted<'_>) -> String {
    let path = path.display();
    match wanted.is_everything() {
        true => format!("there is no change in the log beside {path}"),
        false => format!(
            "no change in the log beside {path} matches. Names are full names, as in /arm/gain"
        ),
    }
}

fn list(path: &Path) -> Result<Vec<LogFile>, CommandFailure> {
    log_files(path).map_err(|error| {
        let path = path.display();
        CommandFailure::Usage(format!("cannot read the folder of `{path}`: {error}"))
    })
}

/// Which entries to show.
struct Wanted<'a> {
    args: &'a LogArgs,
    /// In milliseconds since 1970.
    since: u64,
    until: u64,
    /// Whether entries about anything are wanted.
    all: bool,
    /// One of these is in each record about a wanted name.
    words: Vec<String>,
}

impl<'a> Wanted<'a> {
    fn new(args: &'a LogArgs) -> Self {
        let now = clock::wall_millis();
        let subjects = [&args.param, &args.topic, &args.service, &args.node];
        Self {
            args,
            since: args.since.map_or(0, |since| since.millis(now)),
            until: args.until.map_or(u64::MAX, |until| until.millis(now)),
            all: subjects.iter().all(|names| names.is_empty()),
            words: words_of(args),
        }
    }

    fn is_everything(&self) -> bool {
        self.all && self.since == 0 && self.until == u64::MAX
    }

    fn selects_time(&self, at: u64) -> bool {
        (self.since..=self.until).contains(&at)
    }

    fn selects(&self, entry: &LogEntry) -> bool {
        if !self.selects_time(entry.at) {
            return false;
        }
        let Some(change) = &entry.change else {
            return self.all;
        };
        let Difference {
            what, name, node, ..
        } = change;
        let args = self.args;
        let has = |names: &[String], name: &str| names.iter().any(|it| full(it) == name);
        let subjects = args.param.len() + args.topic.len() + args.service.len();
        let is_subject = match what {
            What::Parameter => args
                .param
                .iter()
                .any(|it| is_in(name, it) || is_in(it, name)),
            What::ParamSubscriber => args.param.iter().any(|it| is_in(name, it)),
            What::Publisher | What::Subscriber | What::TopicType => has(&args.topic, name),
            What::Service => has(&args.service, name),
            What::Node => false,
        };
        let is_node = |node: &Option<String>| node.as_ref().is_some_and(|it| has(&args.node, it));
        let is_by = is_node(&entry.caller)
            || is_node(node)
            || (*what == What::Node && has(&args.node, name));
        (subjects == 0 || is_subject) && (args.node.is_empty() || is_by)
    }

    /// Whether `file`, followed by one with `next` records that may be wanted, has nothing wanted. The file before a
    /// wanted one shows what changed between the two.
    fn skips(&self, file: &Thin, next: usize) -> bool {
        self.all && file.count == 0 && next == 0
    }

    /// Leaves out the records that change only unwanted parameters, because to read the YAML of a record takes long.
    /// Counts the records that may be wanted.
    fn thin(&self, text: &[u8]) -> Result<Thin, String> {
        let mut count = 0;
        let framed = format::scan(text).map_err(|error| error.to_string())?;
        let thinned = framed.thinned(|line| {
            let body = std::str::from_utf8(line.body()).unwrap_or_default();
            let is_named = self.all || self.words.iter().any(|word| body.contains(word));
            count += usize::from(is_named && self.selects_time(line.time()));
            is_named || !line.is_about_param()
        });
        let text = thinned.map_err(|error| error.to_string())?;
        Ok(Thin { text, count })
    }
}

/// The text of a file of the log without the records that surely are not wanted. Reading only the rest is faster.
#[derive(Default)]
struct Thin {
    text: Vec<u8>,
    /// Number of records that may be wanted.
    count: usize,
}

/// Texts of which each record has one that concerns a wanted name: the last part of the name, or a namespace above it.
fn words_of(args: &LogArgs) -> Vec<String> {
    let mut words = Vec::new();
    for name in [&args.topic, &args.service, &args.node, &args.param]
        .into_iter()
        .flatten()
    {
        let last = name.trim_end_matches('/').rsplit('/').next();
        words.push(last.unwrap_or_default().to_owned());
    }
    for name in &args.param {
        let above = name.trim_matches('/').rsplit('/').skip(1);
        words.extend(above.flat_map(|part| [format!("{part}\""), format!("{part}/\"")]));
    }
    if !args.param.is_empty() {
        words.extend(["\"/\"", "\"~\"", "\"\""].map(str::to_owned));
    }
    words
}

/// The name with a slash at its start.
fn full(name: &str) -> String {
    format!("/{}", name.trim_start_matches('/'))
}

/// Reads at least the newest `lines` wanted entries, if there are so many. Afterwards `reader` is at the end of the
/// history.
fn newest(
    path: &Path,
    wanted: &Wanted<'_>,
    lines: usize,
    reader: &mut LogReader,
) -> Result<Vec<LogEntry>, CommandFailure> {
    let files = list(path)?;
    let mut thin: VecDeque<Thin> = VecDeque::new();
    let mut most = lines;
    loop {
        let first = files.len() - thin.len();
        let counted: usize = thin.iter().map(|file| file.count).sum();
        if first > 0 && (counted < most || thin.len() < LIVE_FILES) {
            // Each time as many files as before, so that a short answer is quick.
            let from = first.saturating_sub(thin.len().clamp(LIVE_FILES, FILES_AT_ONCE));
            let more = files.get(from..first).unwrap_or_default();
            for mut file in thinned(more, wanted).into_iter().rev() {
                let next = thin.front().map_or(0, |next| next.count);
                if thin.len() >= LIVE_FILES && wanted.skips(&file, next) {
                    file.text = Vec::new();
                }
                thin.push_front(file);
            }
            continue;
        }
        let mut this = reader.clone();
        let found = read_thin(thin.make_contiguous(), wanted, &mut this);
        if first == 0 || found.len() >= lines {
            *reader = this;
            return Ok(found);
        }
        // Not every record changes something.
        most = most.saturating_mul(4);
    }
}

/// Reads the wanted entries of consecutive files, oldest first.
fn read_thin(files: &[Thin], wanted: &Wanted<'_>, reader: &mut LogReader) -> Vec<LogEntry> {
    let mut found = Vec::new();
    for (index, file) in files.iter().enumerate() {
        let next = files.get(index + 1).map_or(0, |next| next.count);
        if index + LIVE_FILES < files.len() && wanted.skips(file, next) {
            reader.forget();
        } else if !file.text.is_empty() {
            // It was reported when it was read.
            let _ = reader.read(&file.text);
        }
        found.extend(
            reader
                .take_entries()
                .into_iter()
                .filter(|entry| wanted.selects(entry)),
        );
    }
    found
}

/// Reads `files`, several at a time.
fn thinned(files: &[LogFile], wanted: &Wanted<'_>) -> Vec<Thin> {
    let threads = std::thread::available_parallelism().map_or(1, NonZero::get);
    let share = files.len().div_ceil(threads).max(1);
    std::thread::scope(|scope| {
        let parts = files.chunks(share).map(|files| {
            scope.spawn(move || files.iter().map(|file| thin_of(file, wanted)).collect())
        });
        let parts: Vec<ScopedJoinHandle<'_, Vec<Thin>>> = parts.collect();
        let parts = parts.into_iter().filter_map(|part| part.join().ok());
        parts.flatten().collect()
    })
}

fn thin_of(file: &LogFile, wanted: &Wanted<'_>) -> Thin {
    let path = file.path.display();
    let text = match file.read() {
        Ok(text) => text,
        Err(error) => {
            if error.kind() != io::ErrorKind::NotFound {
                note(&format!("cannot read `{path}`: {error}"));
            }
            return Thin::default();
        }
    };
    wanted.thin(&text).unwrap_or_else(|why| {
        note(&format!("left out `{path}`: {why}"));
        Thin::default()
    })
}

/// The wanted rescues of which there is a report, oldest first.
fn rescues(path: &Path, wanted: &Wanted<'_>) -> VecDeque<LogEntry> {
    let rescues = report_file::read(path).into_iter().map(|kept| LogEntry {
        seq: 0,
        at: (kept.report.detected_at * 1e3) as u64,
        caller: None,
        from: None,
        change: None,
        event: Some(rescue(&kept.report)),
    });
    rescues.filter(|entry| wanted.selects(entry)).collect()
}

/// Takes each rescue that is earlier than one of `entries`, and puts it before that.
fn with_rescues(entries: Vec<LogEntry>, rescues: &mut VecDeque<LogEntry>) -> Vec<LogEntry> {
    let mut all = Vec::with_capacity(entries.len());
    for entry in entries {
        while rescues.front().is_some_and(|rescue| rescue.at < entry.at) {
            all.extend(rescues.pop_front());
        }
        all.push(entry);
    }
    all
}

fn rescue(report: &Report) -> String {
    let ended = report.ended.as_ref();
    let ended = ended.map_or_else(String::new, |how| format!(" ({how})"));
    let removed = match report.removed.as_slice() {
        [] => String::new(),
        nodes => format!("; unregistered {}", nodes.join(", ")),
    };
    let (number, cause, total) = (report.number, &report.cause, report.phases.total_ms);
    format!("rescue {number} after {total:.0} ms: {cause}{ended}{removed}")
}

/// An entry for programs.
#[derive(Serialize)]
struct Line<'a> {
    time: String,
    text: String,
    #[serde(flatten)]
    entry: &'a LogEntry,
}

/// Prints an entry. Returns false if the reader of the output has closed it.
fn show(entry: &LogEntry, json: bool) -> Result<bool, CommandFailure> {
    let time = match entry.at {
        0 => "at an unknown time       ".to_owned(),
        at => clock::wall_text_millis(at),
    };
    let text = text_of(entry);
    if json {
        return print_line(&super::json(&Line { time, text, entry }, false)?);
    }
    let who = match (&entry.caller, &entry.from) {
        (Some(caller), Some(from)) => format!("{caller} ({from})  "),
        (Some(caller), None) => format!("{caller}  "),
        _ => String::new(),
    };
    print_line(&Printable::line(&format!("{time}  {who}{text}")))
}

fn text_of(entry: &LogEntry) -> String {
    let Some(change) = &entry.change else {
        return entry.event.clone().unwrap_or_default();
    };
    let Difference {
        what,
        name,
        node,
        a,
        b,
        ..
    } = change;
    let by = match node {
        Some(node) if entry.caller.as_ref() != Some(node) => format!("{node} "),
        _ => String::new(),
    };
    let kind = b.as_ref().filter(|kind| !kind.is_empty());
    let kind = kind.map_or_else(String::new, |kind| format!(" ({kind})"));
    match (what, a, b) {
        (What::Parameter, Some(a), Some(b)) => format!("set {name}: {a} -> {b}"),
        (What::Parameter, None, Some(b)) => format!("set {name}: {b}"),
        (What::Parameter, Some(a), None) => format!("deleted {name}: {a}"),
        (What::Node, Some(a), Some(b)) => {
            format!("node {name} at {b} displaced the one at {a}")
        }
        (What::Node, None, Some(b)) => format!("node {name} registered, at {b}"),
        (What::Node, Some(a), None) => format!("node {name} unregistered, was at {a}"),
        (What::Publisher, _, Some(_)) => format!("{by}publishes {name}{kind}"),
        (What::Publisher, ..) => format!("{by}no longer publishes {name}"),
        (What::Subscriber, _, Some(_)) => format!("{by}subscribes {name}{kind}"),
        (What::Subscriber, ..) => format!("{by}no longer subscribes {name}"),
        (What::ParamSubscriber, _, Some(_)) => format!("{by}watches the parameter {name}"),
        (What::ParamSubscriber, ..) => format!("{by}no longer watches the parameter {name}"),
        (What::Service, Some(a), Some(b)) => format!("service {name} of {b}, was of {a}"),
        (What::Service, None, Some(b)) => format!("service {name} of {b}"),
        (What::Service, ..) => format!("no longer provides the service {name}"),
        (What::TopicType, a, b) => {
            let of = |kind: &Option<String>| kind.clone().unwrap_or_else(|| "none".to_owned());
            format!("type of {name}: {} -> {}", of(a), of(b))
        }
        (What::Parameter, None, None) | (What::Node, None, None) => name.clone(),
    }
}
