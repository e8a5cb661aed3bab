//! The log of changes: what has changed in the history of a checkpoint, when and by whom, and the state at any earlier time.
//!
//! The history is a list of checkpoint files, oldest first, whose records may overlap. The order of the records is that
//! of their numbers. Times are labels: where the clock has jumped back, they repeat.

use serde::Serialize;

use crate::{
    checkpoint::{
        compare::{Difference, What, compare, compare_param},
        format::{self, Label, Origin, Record, RecordContent, Session},
        session::{Rebuilt, rebuild},
    },
    hide::Hide,
};
use ros1_master::master::{Master, Request, Write, WriteTarget, names};

/// The state at an earlier time.
#[derive(Debug)]
pub struct Moment {
    /// Number of the last record in the state.
    pub seq: u64,
    /// Wall clock time of that record, or of the snapshot without a later one, in milliseconds since 1970. 0 if it
    /// is unknown.
    pub at: u64,
    /// Number of the last record in the snapshot from which the state was rebuilt.
    pub snapshot_seq: u64,
    /// Methods of the records after that snapshot; `session` for a change of the session.
    pub journal: Vec<String>,
    pub rebuilt: Rebuilt,
    /// Whether no record is missing.
    pub exact: bool,
    /// Whether a later record in the file has the time of the state or an earlier one: the clock was set back.
    pub is_set_back: bool,
}

/// The times in a checkpoint file, in milliseconds since 1970.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Span {
    /// The earliest time of a record. `u64::MAX` if there is no record.
    pub earliest: u64,
    /// The latest time of a record or of the snapshot.
    pub latest: u64,
    /// Number of the last record in the snapshot. All records of the file have higher ones.
    pub snapshot_seq: u64,
}

/// Finds the times in the checkpoint file `text`.
///
/// # Errors
///
/// If the file cannot be used. The text says why.
pub fn span(text: &[u8]) -> Result<Span, String> {
    let framed = format::scan(text).map_err(|error| error.to_string())?;
    let times = framed.lines.iter().map(format::Line::time);
    Ok(Span {
        earliest: times.clone().min().unwrap_or(u64::MAX),
        latest: times.max().unwrap_or(0).max(framed.taken_at()),
        snapshot_seq: framed.header.map_or(0, |header| header.seq),
    })
}

/// Whether a record after number `seq` in the checkpoint file `text` has the `time` or an earlier one. Files of a
/// history can overlap.
pub fn is_set_back_after(text: &[u8], seq: u64, time: u64) -> bool {
    let lines = format::scan(text).map(|framed| framed.lines);
    let mut lines = lines.into_iter().flatten();
    lines.any(|line| line.seq > seq && line.time() <= time)
}

/// Finds the state that the checkpoint file `text` has at `time`, in milliseconds since 1970: before the first record
/// with a later time. `None` if the snapshot is later. The order is that of the records: after the clock was set back,
/// records can follow that have an earlier time than those before them, and are no part of that state.
///
/// # Errors
///
/// If the file cannot be used. The text says why.
pub fn moment(text: &[u8], time: u64) -> Result<Option<Moment>, String> {
    let mut framed = format::scan(text).map_err(|error| error.to_string())?;
    if framed.taken_at() > time {
        return Ok(None);
    }
    let later = framed.lines.iter().position(|line| line.time() > time);
    let end = later.unwrap_or(framed.lines.len());
    let last = end.checked_sub(1).and_then(|last| framed.lines.get(last));
    let at = last.map_or_else(|| framed.taken_at(), format::Line::time);
    let mut after = framed.lines.iter().skip(end);
    let is_set_back = after.any(|line| line.time() <= time);
    framed.lines.truncate(end);
    let checkpoint = framed.checkpoint().map_err(|error| error.to_string())?;
    let snapshot_seq = checkpoint.seq;
    let records = framed.records(snapshot_seq, &mut Vec::new());
    let seq = records.last().map_or(snapshot_seq, |record| record.seq);
    let journal = records.iter().map(|record| match &record.entry {
        RecordContent::Call { call, .. } => call.method().name().to_owned(),
        RecordContent::Session(_) => "session".to_owned(),
    });
    Ok(Some(Moment {
        seq,
        at,
        snapshot_seq,
        journal: journal.collect(),
        exact: records.len() as u64 == seq - snapshot_seq,
        is_set_back,
        rebuilt: rebuild(Some(checkpoint), records),
    }))
}

/// A line of the log.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct LogEntry {
    /// Number of the record, or of the last record before a change that has none.
    pub seq: u64,
    /// Wall clock time in milliseconds since 1970. 0 if it is unknown.
    pub at: u64,
    /// The name under which the call was made. `None` if the change is not a call.
    pub caller: Option<String>,
    /// The address from which the call came, or `rosrescue`. `None` if it is unknown.
    pub from: Option<String>,
    /// What the call changed. `None` for an event.
    pub change: Option<Difference>,
    /// What happened to rosrescue or its master. `None` for a change.
    pub event: Option<String>,
}

/// Reads the files of a history, oldest first, and lists what changed. May read a file again that has grown.
#[derive(Clone, Debug)]
pub struct LogReader {
    hide: Hide,
    state: Option<(Master, Session)>,
    seq: u64,
    entries: Vec<LogEntry>,
}

impl LogReader {
    /// Creates a reader that masks the values of hidden parameters.
    pub fn new(hide: Hide) -> Self {
        Self {
            hide,
            state: None,
            seq: 0,
            entries: Vec::new(),
        }
    }

    /// Forgets the state, so that the next file is not compared with the last one.
    pub fn forget(&mut self) {
        self.state = None;
    }

    /// Takes the entries that were read since the last call.
    pub fn take_entries(&mut self) -> Vec<LogEntry> {
        std::mem::take(&mut self.entries)
    }

    /// Reads the checkpoint file `text`. Records that were read before are left out.
    ///
    /// # Errors
    ///
    /// If the file cannot be used. The text says why. The next file can be read all the same.
    pub fn read(&mut self, text: &[u8]) -> Result<(), String> {
        let framed = format::scan(text).map_err(|error| error.to_string())?;
        let checkpoint = framed.checkpoint().map_err(|error| error.to_string())?;
        let mark = |(_, session): &(Master, Session)| session.mark == checkpoint.session.mark;
        // After the checkpoint was removed, the numbers begin again.
        let known = match self.state.as_ref().is_some_and(mark) {
            true => self.seq,
            false => 0,
        };
        let seq = checkpoint.seq;
        let mut records = framed.records(seq, &mut Vec::new());
        let last = records.last().map_or(seq, |record| record.seq);
        if last < known {
            return Ok(());
        }
        let later = records.split_off(records.partition_point(|record| record.seq <= known));
        self.seq = known.max(seq);
        self.replace(rebuild(Some(checkpoint), records));
        for record in later {
            self.record(record);
        }
        Ok(())
    }

    /// Continues from `rebuilt`, and lists the changes that no record shows.
    fn replace(&mut self, rebuilt: Rebuilt) {
        let (state, session) = (rebuilt.mirror, rebuilt.session.unwrap_or_default());
        if let Some((old, before)) = self.state.take() {
            let at = session.at;
            self.session(at, &before, &session);
            if old != state {
                for change in compare(&old, &state, &self.hide) {
                    self.entries.push(LogEntry {
                        change: Some(change),
                        ..self.entry(at)
                    });
                }
            }
        }
        self.state = Some((state, session));
    }

    fn record(&mut self, Record { seq, entry }: Record) {
        self.seq = seq;
        let Some((mut state, session)) = self.state.take() else {
            return;
        };
        self.state = Some(match entry {
            RecordContent::Call { call, label, .. } => {
                for call in call.calls() {
                    self.call(&mut state, call, label);
                }
                (state, session)
            }
            RecordContent::Session(next) => {
                self.session(next.at, &session, &next);
                (state, *next)
            }
        });
    }

    fn call(&mut self, state: &mut Master, call: &Request, label: Label) {
        if !state.would_change(call) {
            return;
        }
        for change in changes(state, call, &self.hide) {
            self.entries.push(LogEntry {
                caller: call.caller().map(str::to_owned),
                from: match label.origin {
                    Origin::Unknown => None,
                    Origin::Rosrescue => Some("rosrescue".to_owned()),
                    Origin::At(address) => Some(address.to_string()),
                },
                change: Some(change),
                ..self.entry(label.at)
            });
        }
    }

    /// Lists what the next session record says that the last one did not.
    fn session(&mut self, at: u64, before: &Session, after: &Session) {
        let mut events = Vec::new();
        if before.id != after.id {
            events.push(format!("a new session began: {}", after.id));
        } else if before.boot_id != after.boot_id {
            events.push("the computer was rebooted".to_owned());
        } else if before.closed && !after.closed {
            events.push("rosrescue was started again".to_owned());
        }
        if before.incarnation != after.incarnation {
            let number = after.incarnation;
            events.push(format!(
                "another master was brought to the state: number {number}"
            ));
        }
        if before.term != after.term {
            // A follower's checkpoint names the term, too.
            events.push(format!(
                "a computer took over as the leader: term {}",
                after.term
            ));
        }
        if !before.closed && after.closed {
            events.push("rosrescue was stopped".to_owned());
        }
        for event in events {
            self.entries.push(LogEntry {
                event: Some(event),
                ..self.entry(at)
            });
        }
    }

    fn entry(&self, at: u64) -> LogEntry {
        LogEntry {
            seq: self.seq,
            at,
            caller: None,
            from: None,
            change: None,
            event: None,
        }
    }
}

/// Applies `call`, which is no multicall, to `state`. Returns what it changed.
fn changes(state: &mut Master, call: &Request, hide: &Hide) -> Vec<Difference> {
    let Some(write) = Write::parse(call) else {
        state.apply_telling(call, &mut ());
        return Vec::new();
    };
    let (caller, name) = (write.caller, write.name());
    let facts = |state: &Master| Facts {
        api: state.api_of(caller).map(str::to_owned),
        value: registration_of(state, &write),
    };
    let what = match write.target() {
        WriteTarget::Publisher => What::Publisher,
        WriteTarget::Subscriber => What::Subscriber,
        WriteTarget::Service => What::Service,
        WriteTarget::ParamSubscriber => What::ParamSubscriber,
        WriteTarget::Parameter => What::Parameter,
    };
    let param = write.parameter().and_then(|key| state.param(key));
    let before = facts(state);
    state.apply_telling(call, &mut ());
    let after = facts(state);
    if what == What::Parameter {
        return compare_param(name, param.as_ref(), state.param(name).as_ref(), hide);
    }
    let difference = |what, name: &str, node, a, b| Difference {
        what,
        name: name.to_owned(),
        node,
        a,
        b,
        registrations: Vec::new(),
    };
    let mut found = Vec::new();
    if before.api != after.api {
        found.push(difference(What::Node, caller, None, before.api, after.api));
    }
    if before.value != after.value {
        let node = Some(caller.to_owned());
        found.push(difference(what, name, node, before.value, after.value));
    }
    found
}

/// What a call can change about its caller and its subject.
struct Facts {
    /// The caller's address.
    api: Option<String>,
    /// The type, address or empty text of the registration. `None` if there is none.
    value: Option<String>,
}

/// The caller's registration that `write` is about.
fn registration_of(state: &Master, write: &Write<'_>) -> Option<String> {
    let (caller, name) = (write.caller, write.name());
    let topic = |publishes| {
        let there = state.has_topic(caller, publishes, name);
        there.then(|| state.type_of(name).unwrap_or_default().to_owned())
    };
    match write.target() {
        WriteTarget::Publisher => topic(true),
        WriteTarget::Subscriber => topic(false),
        WriteTarget::Service => {
            let node = state.provider_of(name)?;
            let mut services = state.services_of(node);
            let (_, api) = services.find(|(service, _)| *service == name)?;
            Some(format!("{node} at {api}"))
        }
        WriteTarget::ParamSubscriber => {
            let key = names::param_key(name);
            let mut keys = state.param_subscriptions(caller);
            keys.any(|it| it == key).then(String::new)
        }
        WriteTarget::Parameter => None,
    }
}

#[cfg(test)]
mod tests;
