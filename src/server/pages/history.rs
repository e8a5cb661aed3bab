//! When nodes died and restarted, for the marks on the page's time line. It comes from the log of changes.

use std::{collections::BTreeSet, fs, path::Path, sync::Arc};

use checkpoint_store::change_log::files;
use hyper::StatusCode;
use rescue_core::{
    checkpoint::{
        change_log::{LogEntry, LogReader},
        compare::What,
        format,
    },
    replay::Token,
};
use serde::Serialize;

use super::{Asked, in_background, json, past::busy, text};
use crate::{
    cli::When,
    clock,
    server::{Server, replies::HttpReply},
};

/// Maximum size of the files that are read, in bytes without those records that only change parameters.
const READ: usize = 32 << 20;
/// Maximum number of events in one answer.
const EVENTS: usize = 1000;

/// The content of `/history.json`.
#[derive(Debug, Serialize)]
struct History {
    schema: u32,
    /// No event since this time is missing, in seconds since 1970.
    since: f64,
    /// Oldest first.
    nodes: Vec<NodeEvent>,
}

#[derive(Debug, PartialEq, Serialize)]
struct NodeEvent {
    /// In seconds since 1970.
    at: f64,
    node: String,
    what: Happened,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
enum Happened {
    /// rosrescue unregistered the dead node.
    Died,
    /// The node registered again, after it had left or died, or from another address.
    Restarted,
}

/// Answers with the events since the time `since`.
pub(super) async fn history(server: &Arc<Server>, asked: Asked) -> HttpReply {
    let since = match asked.since.as_deref().unwrap_or("-1h").parse::<When>() {
        Ok(since) => since.millis(clock::wall_millis()),
        Err(why) => return text(StatusCode::BAD_REQUEST, why + "\n"),
    };
    let Ok(turn) = server.pages.state.reading_past.clone().try_lock_owned() else {
        return busy();
    };
    let server = server.clone();
    let work = move || {
        let _turn = turn;
        let reader = LogReader::new(server.pages.hide.clone());
        match read(Path::new(&server.pages.checkpoint), since, reader) {
            Ok(history) => json(serde_json::to_string(&history)),
            Err(error) => text(StatusCode::NOT_FOUND, format!("{error}\n")),
        }
    };
    in_background(work).await
}

/// Reads the events since `since`, in milliseconds since 1970.
fn read(path: &Path, since: u64, mut reader: LogReader) -> std::io::Result<History> {
    let path = fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
    let (mut texts, mut size, mut begin) = (Vec::new(), 0, u64::MAX);
    // From new to old, until one begins early enough.
    for file in files(&path)?.into_iter().rev() {
        // The previous generation may be missing.
        let Ok(bytes) = file.read() else { continue };
        let Ok(framed) = format::scan(&bytes) else {
            continue;
        };
        let Ok(thin) = framed.thinned(|line| !line.is_about_param()) else {
            continue;
        };
        size += thin.len();
        if size > READ && !texts.is_empty() {
            break;
        }
        begin = framed.taken_at();
        texts.push(thin);
        if begin <= since {
            break;
        }
    }
    for text in texts.iter().rev() {
        // A damaged file leaves a gap.
        let _ = reader.read(text);
    }
    let mut nodes = events(&reader.take_entries());
    nodes.retain(|event| event.at >= since as f64 / 1e3);
    let left_out = nodes.len().saturating_sub(EVENTS);
    let nodes: Vec<_> = nodes.split_off(left_out);
    let since = match nodes.first() {
        Some(first) if left_out > 0 => first.at,
        _ => since.max(begin) as f64 / 1e3,
    };
    Ok(History {
        schema: super::SCHEMA,
        since,
        nodes,
    })
}

/// The events in `entries`, which are the complete log of a time, oldest first.
fn events(entries: &[LogEntry]) -> Vec<NodeEvent> {
    // Nodes that were registered before.
    let mut gone = BTreeSet::new();
    let mut events = Vec::new();
    for entry in entries {
        let Some(change) = &entry.change else {
            continue;
        };
        if change.what != What::Node || Token::is_ours(&change.name) {
            continue;
        }
        let happened = match (&change.a, &change.b) {
            (Some(_), Some(_)) => Some(Happened::Restarted),
            (None, Some(_)) => gone.contains(&change.name).then_some(Happened::Restarted),
            (Some(_), None) => {
                gone.insert(change.name.clone());
                (entry.from.as_deref() == Some("rosrescue")).then_some(Happened::Died)
            }
            (None, None) => None,
        };
        events.extend(happened.map(|what| NodeEvent {
            at: entry.at as f64 / 1e3,
            node: change.name.clone(),
            what,
        }));
    }
    events
}

#[cfg(test)]
mod tests {
    use super::*;
    use rescue_core::checkpoint::compare::Difference;

    fn entry(at: u64, from: &str, [a, b]: [Option<&str>; 2]) -> LogEntry {
        LogEntry {
            seq: at,
            at: 1000 * at,
            caller: Some("/a".to_owned()),
            from: Some(from.to_owned()),
            change: Some(Difference {
                what: What::Node,
                name: "/a".to_owned(),
                node: None,
                a: a.map(str::to_owned),
                b: b.map(str::to_owned),
                registrations: Vec::new(),
            }),
            event: None,
        }
    }

    #[test]
    fn a_node_that_comes_back_has_restarted_and_one_that_leaves_has_not_died() {
        let log = [
            entry(1, "10.0.0.1", [None, Some("http://h:1/")]),
            entry(2, "10.0.0.1", [Some("http://h:1/"), None]),
            entry(3, "10.0.0.1", [None, Some("http://h:2/")]),
            entry(4, "10.0.0.1", [Some("http://h:2/"), Some("http://h:3/")]),
            entry(5, "rosrescue", [Some("http://h:3/"), None]),
        ];
        let found = events(&log);
        let found = found.iter().map(|event| (event.at, event.what));
        let expected = [
            (3.0, Happened::Restarted),
            (4.0, Happened::Restarted),
            (5.0, Happened::Died),
        ];
        assert!(found.eq(expected));
    }
}
