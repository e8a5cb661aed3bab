//! Defines the YAML document of a checkpoint: which value is under which key.

use std::net::IpAddr;

use super::emit::{block, block_key, decimal, flow, flow_list, quoted};
use super::{
    Announced, Checkpoint, EncodeError, Label, Origin, PendingWrite, RecordContent, Session, frame,
    yaml,
};
use ros1_master::master::{Displaced, OrderedMap, Request, ServiceEntry, Snapshot, SnapshotNode};
use ros1_master::xmlrpc::{Call, Struct, Value};

/// Writes the document up to and including the line `journal:`.
pub(super) fn write_snapshot(checkpoint: &Checkpoint) -> Result<Vec<u8>, EncodeError> {
    let Checkpoint {
        seq,
        session,
        snapshot,
        pending,
        displaced,
        follows: _,
    } = checkpoint;
    let mut out = Vec::with_capacity(64 * 1024);
    let out = &mut out;
    out.extend_from_slice(
        b"# The state of a ROS master: a snapshot, then a journal of what came after it.\n\
          # Any YAML reader reads it. Do not edit: the check sums would no longer hold.\n\
          seq: ",
    );
    decimal(out, seq);
    out.extend_from_slice(b"\nsession:\n");
    for (name, value) in session_members(session) {
        out.extend_from_slice(b"  ");
        out.extend_from_slice(name.as_bytes());
        out.extend_from_slice(b": ");
        flow(out, &value, 0)?;
        out.push(b'\n');
    }
    section(out, "nodes", &snapshot.nodes, |out, node| {
        text_line(out, "    api: ", &node.api);
        if !node.taken_over_services.is_empty() {
            out.extend_from_slice(b"    taken_over_services: ");
            names(out, &node.taken_over_services);
        }
        if let Some(from) = node.from {
            text_line(out, "    from: ", &from.to_string());
        }
    });
    section_of_lines(out, "topic_types", &snapshot.topic_types, |out, kind| {
        text_line(out, "", kind);
    });
    section_of_lines(out, "publishers", &snapshot.publishers, |out, ids| {
        names(out, ids)
    });
    section_of_lines(out, "subscribers", &snapshot.subscribers, |out, ids| {
        names(out, ids)
    });
    section(out, "services", &snapshot.services, |out, service| {
        text_line(out, "    node: ", &service.node);
        text_line(out, "    api: ", &service.api);
    });
    if snapshot.had_services {
        out.extend_from_slice(b"had_services: true\n");
    }
    section_of_lines(
        out,
        "param_subscribers",
        &snapshot.param_subscribers,
        |out, ids| {
            names(out, ids);
        },
    );
    if !pending.is_empty() {
        out.extend_from_slice(b"pending:\n");
        for PendingWrite { seq, call } in pending {
            out.extend_from_slice(b"- {seq: ");
            decimal(out, *seq);
            out.push(b',');
            write_call(out, call)?;
            out.extend_from_slice(b"}\n");
        }
    }
    if !displaced.is_empty() {
        out.extend_from_slice(b"displaced:\n");
        for node in displaced {
            out.extend_from_slice(b"- ");
            flow(out, &displaced_value(node), 0)?;
            out.push(b'\n');
        }
    }
    if snapshot.params.is_empty() {
        out.extend_from_slice(b"parameters: {}\n");
    } else {
        out.extend_from_slice(b"parameters:\n");
        block(out, &snapshot.params, 2, 0)?;
    }
    out.extend_from_slice(b"journal:\n");
    Ok(std::mem::take(out))
}

/// Writes a key whose entries each take several lines.
fn section<T>(
    out: &mut Vec<u8>,
    title: &str,
    entries: &OrderedMap<T>,
    mut write: impl FnMut(&mut Vec<u8>, &T),
) {
    section_of_lines(out, title, entries, |out, entry| {
        // Removes the blank after the key.
        out.pop();
        out.push(b'\n');
        write(out, entry);
    });
}

/// Writes a key whose entries each take one line; `write` ends the line.
fn section_of_lines<T>(
    out: &mut Vec<u8>,
    title: &str,
    entries: &OrderedMap<T>,
    mut write: impl FnMut(&mut Vec<u8>, &T),
) {
    out.extend_from_slice(title.as_bytes());
    out.extend_from_slice(if entries.is_empty() {
        b": {}\n"
    } else {
        b":\n"
    });
    for (name, entry) in entries {
        block_key(out, name, 2);
        out.push(b' ');
        write(out, entry);
    }
}

fn text_line(out: &mut Vec<u8>, key: &str, text: &str) {
    out.extend_from_slice(key.as_bytes());
    quoted(out, text);
    out.push(b'\n');
}

fn names(out: &mut Vec<u8>, ids: &[String]) {
    // This cannot fail, because texts do not nest.
    let _ = flow_list(out, ids, |out, id| {
        quoted(out, id);
        Ok(())
    });
    out.push(b'\n');
}

/// Writes `setParam: […]`, or `call: "x", params: […]` for a method whose name cannot be a key.
fn write_call(out: &mut Vec<u8>, call: &Request) -> Result<(), EncodeError> {
    let method = call.method().name();
    if is_key(method) {
        out.extend_from_slice(method.as_bytes());
        out.extend_from_slice(b": ");
    } else {
        out.extend_from_slice(b"call: ");
        quoted(out, method);
        out.extend_from_slice(b", params: ");
    }
    flow_list(out, &call.wire_params(), |out, value| flow(out, value, 0))
}

/// Whether a method's name can be the key of its record. All writes have such names. Shorter words could be `true` or
/// `yes`, or another key of the record.
fn is_key(method: &str) -> bool {
    let letters = method.as_bytes();
    letters.len() >= 8
        && letters.iter().all(u8::is_ascii_alphabetic)
        && letters.first().is_some_and(u8::is_ascii_lowercase)
}

/// Writes the end of a record: when it was made and by whom. To save bytes, two of a record's commas have no blank behind
/// them.
fn write_label(out: &mut Vec<u8>, label: Label) {
    if label.at == 0 {
        return;
    }
    out.extend_from_slice(b",t: ");
    decimal(out, label.at);
    let from = match label.origin {
        Origin::COMMON => return,
        Origin::Unknown => String::new(),
        Origin::Rosrescue => ROSRESCUE.to_owned(),
        Origin::At(address) => address.to_string(),
    };
    out.extend_from_slice(b", from: ");
    quoted(out, &from);
}

/// Reverses [`write_label`]. An unreadable label is no damage: it is for people only.
fn read_label(entry: &Struct) -> Label {
    let at = count(entry, "t").ok().flatten().unwrap_or(0);
    let origin = match entry.get("from") {
        _ if at == 0 => Origin::Unknown,
        None => Origin::COMMON,
        Some(Value::String(from)) if from == ROSRESCUE => Origin::Rosrescue,
        Some(from) => from
            .as_str()
            .and_then(|from| from.parse().ok())
            .map_or(Origin::Unknown, Origin::At),
    };
    Label { at, origin }
}

/// The address of the computer from which a node has registered.
fn read_address(node: &Struct) -> Option<IpAddr> {
    node.get("from")?.as_str()?.parse().ok()
}

/// How a record names rosrescue as its caller.
const ROSRESCUE: &str = "rosrescue";

fn session_members(session: &Session) -> Vec<(&'static str, Value)> {
    let mut members = vec![
        ("id", session.id.as_str().into()),
        ("boot_id", session.boot_id.as_str().into()),
        ("closed", session.closed.into()),
        ("mark", session.mark.as_str().into()),
        (
            "master_uri",
            session
                .master_uri
                .as_deref()
                .map_or(Value::Nil, Value::from),
        ),
        ("started", session.started.as_str().into()),
    ];
    let announced = session.announced;
    let counts = [
        ("incarnation", session.incarnation),
        ("delivered", session.delivered),
        ("announced", announced.map_or(0, |it| it.incarnation)),
        ("announced_at", announced.map_or(0, |it| it.at)),
        ("term", session.term),
        ("cluster_journal", session.cluster_journal),
        ("cluster_seq", session.cluster_seq),
        ("port", session.port.into()),
        ("at", session.at),
    ];
    // A missing count is read as 0.
    let counts = counts.into_iter().filter(|(_, count)| *count > 0);
    members.extend(counts.map(|(name, count)| (name, integer(count))));
    members
}

fn integer(count: u64) -> Value {
    i32::try_from(count).map_or_else(|_| Value::BigInt(count.to_string()), Value::Int)
}

/// Writes the line of a record without its check sum.
pub(super) fn write_record(
    out: &mut Vec<u8>,
    seq: u64,
    entry: &RecordContent,
) -> Result<(), EncodeError> {
    out.extend_from_slice(b"- {seq: ");
    decimal(out, seq);
    match entry {
        RecordContent::Call {
            call,
            pending,
            label,
        } => {
            out.push(b',');
            write_call(out, call)?;
            if *pending {
                out.extend_from_slice(b", pending: true");
            }
            write_label(out, *label);
        }
        RecordContent::Session(session) => {
            out.extend_from_slice(b", session: {");
            for (nth, (name, value)) in session_members(session).iter().enumerate() {
                if nth > 0 {
                    out.extend_from_slice(b", ");
                }
                out.extend_from_slice(name.as_bytes());
                out.extend_from_slice(b": ");
                flow(out, value, 0)?;
            }
            out.push(b'}');
        }
    }
    out.push(b'}');
    Ok(())
}

/// Reverses [`write_snapshot`].
pub(super) fn read_snapshot(yaml: &str) -> Result<Checkpoint, String> {
    let Value::Struct(mut document) = yaml::read(yaml)? else {
        return Err("it is not a mapping".to_owned());
    };
    let document = &mut document;
    let seq = count(document, "seq")?.ok_or("`seq` is missing")?;
    let session = read_session(members(document, "session")?)?;
    let snapshot = Snapshot {
        nodes: entries(document, "nodes", |value| {
            let mut node = structure(value)?;
            Some(SnapshotNode {
                api: text(&mut node, "api").ok()?,
                taken_over_services: match node.shift_remove("taken_over_services") {
                    Some(ids) => texts(ids)?,
                    None => Vec::new(),
                },
                from: read_address(&node),
            })
        })?,
        topic_types: entries(document, "topic_types", string)?,
        publishers: entries(document, "publishers", texts)?,
        subscribers: entries(document, "subscribers", texts)?,
        had_services: document.swap_remove("had_services") == Some(Value::Bool(true)),
        services: entries(document, "services", |value| {
            let mut service = structure(value)?;
            Some(ServiceEntry {
                node: text(&mut service, "node").ok()?,
                api: text(&mut service, "api").ok()?,
            })
        })?,
        param_subscribers: entries(document, "param_subscribers", texts)?,
        params: members(document, "parameters")?,
    };
    let pending = match document.swap_remove("pending") {
        None => Vec::new(),
        Some(Value::Array(calls)) => calls
            .into_iter()
            .map(read_pending)
            .collect::<Result<_, _>>()?,
        Some(_) => return Err("`pending` is not a list".to_owned()),
    };
    let displaced = match document.swap_remove("displaced") {
        None => Vec::new(),
        Some(Value::Array(nodes)) => nodes
            .into_iter()
            .map(|node| read_displaced(node).ok_or("`displaced` has a malformed entry"))
            .collect::<Result<_, _>>()?,
        Some(_) => return Err("`displaced` is not a list".to_owned()),
    };
    Ok(Checkpoint {
        seq,
        session,
        snapshot,
        pending,
        displaced,
        follows: false,
    })
}

fn displaced_value(node: &Displaced) -> Value {
    let topics = node.topics.iter().map(|topic| topic.as_str().into());
    let mut members = Struct::from([
        ("node".to_owned(), node.node.as_str().into()),
        ("api".to_owned(), node.api.as_str().into()),
        ("topics".to_owned(), Value::Array(topics.collect())),
    ]);
    if let Some(pid) = node.pid {
        members.insert("pid".to_owned(), pid.into());
    }
    if let Some(from) = node.from {
        members.insert("from".to_owned(), from.to_string().as_str().into());
    }
    Value::Struct(members)
}

/// Reverses [`displaced_value`].
fn read_displaced(value: Value) -> Option<Displaced> {
    let mut node = structure(value)?;
    Some(Displaced {
        pid: node.get("pid").and_then(Value::as_int),
        from: read_address(&node),
        topics: texts(node.shift_remove("topics")?)?,
        node: text(&mut node, "node").ok()?,
        api: text(&mut node, "api").ok()?,
    })
}

/// Reverses [`write_record`], except for the number, which the caller has read.
pub(super) fn read_record(line: &str) -> Result<RecordContent, String> {
    let entries = match yaml::read(line)? {
        Value::Array(entries) => entries,
        _ => Vec::new(),
    };
    let Ok([Value::Struct(mut entry)]) = <[Value; 1]>::try_from(entries) else {
        return Err("it is not a record".to_owned());
    };
    if entry.contains_key("session") {
        return read_session(members(&mut entry, "session")?)
            .map(|session| RecordContent::Session(session.into()));
    }
    let pending = entry.get("pending") == Some(&Value::Bool(true));
    let label = read_label(&entry);
    Ok(RecordContent::Call {
        call: read_call(entry)?,
        pending,
        label,
    })
}

/// Reverses [`write_call`].
fn read_call(mut entry: Struct) -> Result<Request, String> {
    if entry.contains_key("call") {
        let method = text(&mut entry, "call")?;
        return match entry.shift_remove("params") {
            Some(Value::Array(params)) => Ok(Call { method, params }.into()),
            _ => Err("`params` is not a list".to_owned()),
        };
    }
    let call = entry.into_iter().find_map(|(method, params)| match params {
        Value::Array(params) if is_key(&method) => Some(Call { method, params }.into()),
        _ => None,
    });
    call.ok_or_else(|| "it has no call".to_owned())
}

fn read_pending(write: Value) -> Result<PendingWrite, String> {
    let write = structure(write).ok_or("`pending` has a malformed entry")?;
    Ok(PendingWrite {
        seq: count(&write, "seq")?.ok_or("`seq` of a pending write is missing")?,
        call: read_call(write)?,
    })
}

fn read_session(mut session: Struct) -> Result<Session, String> {
    let session = &mut session;
    Ok(Session {
        id: text(session, "id")?,
        boot_id: text(session, "boot_id")?,
        closed: session.get("closed") == Some(&Value::Bool(true)),
        mark: text(session, "mark")?,
        master_uri: session.shift_remove("master_uri").and_then(string),
        started: text(session, "started")?,
        incarnation: count(session, "incarnation")?.unwrap_or(0),
        delivered: count(session, "delivered")?.unwrap_or(0),
        announced: match count(session, "announced")? {
            None => None,
            Some(incarnation) => Some(Announced {
                incarnation,
                at: count(session, "announced_at")?.unwrap_or(0),
            }),
        },
        term: count(session, "term")?.unwrap_or(0),
        cluster_journal: count(session, "cluster_journal")?.unwrap_or(0),
        cluster_seq: count(session, "cluster_seq")?.unwrap_or(0),
        port: count(session, "port")?
            .and_then(|port| u16::try_from(port).ok())
            .unwrap_or(0),
        at: count(session, "at")?.unwrap_or(0),
    })
}

fn count(members: &Struct, key: &str) -> Result<Option<u64>, String> {
    let count = match members.get(key) {
        None => return Ok(None),
        Some(Value::Int(number)) => u64::try_from(*number).ok(),
        Some(Value::BigInt(digits)) => frame::count(digits),
        Some(_) => None,
    };
    match count {
        Some(count) => Ok(Some(count)),
        None => Err(format!("`{key}` is not a count")),
    }
}

fn members(document: &mut Struct, key: &str) -> Result<Struct, String> {
    // Takes the value instead of cloning it. This changes the order of the remaining keys, which does not matter.
    document
        .swap_remove(key)
        .and_then(structure)
        .ok_or_else(|| format!("`{key}` is not a mapping"))
}

fn entries<T: Clone>(
    document: &mut Struct,
    key: &str,
    read: impl Fn(Value) -> Option<T>,
) -> Result<OrderedMap<T>, String> {
    members(document, key)?
        .into_iter()
        .map(|(name, value)| {
            let entry = read(value).ok_or_else(|| format!("`{key}` has a malformed entry"))?;
            Ok((name, entry))
        })
        .collect()
}

fn text(members: &mut Struct, key: &str) -> Result<String, String> {
    members
        .shift_remove(key)
        .and_then(string)
        .ok_or_else(|| format!("`{key}` is not a text"))
}

fn string(value: Value) -> Option<String> {
    match value {
        Value::String(text) => Some(text),
        _ => None,
    }
}

fn structure(value: Value) -> Option<Struct> {
    match value {
        Value::Struct(members) => Some(members),
        _ => None,
    }
}

fn texts(value: Value) -> Option<Vec<String>> {
    match value {
        Value::Array(elements) => elements.into_iter().map(string).collect(),
        _ => None,
    }
}
