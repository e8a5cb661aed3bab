//! Whether a node of a checkpoint lives where it was, and is still what it was. What is registered for a node that
//! is another one could shut down an innocent one later.

use std::{collections::HashMap, io::IsTerminal, sync::Arc, time::Duration};

use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpStream,
    task::JoinSet,
    time::timeout,
};

use crate::{
    checkpoint::putback::{Absent, LeftOut, Registration},
    health::{Reconciliation, port_of},
    master::{CALLER_ID, Master, question},
    nodes::client::{self, Interview, Sign},
    resolver,
    ros_env::MasterUri,
    xmlrpc::Value,
};

/// How long a node may take to answer a question.
const ANSWER_LIMIT: Duration = Duration::from_secs(3);
/// Nodes that are asked at the same time.
const AT_ONCE: usize = 64;
/// Largest header of a service's answer, in bytes.
const MAX_HEADER: usize = 64 << 10;

/// What is to be registered for those of `absent` that live, and are what they were. Adds the others to `left_out`.
pub(super) async fn of_living(
    file: &Arc<Master>,
    live: &Master,
    absent: Vec<Absent>,
    left_out: &mut Vec<LeftOut>,
) -> Vec<Registration> {
    if !absent.is_empty() && std::io::stderr().is_terminal() {
        eprintln!("asking {} nodes whether they are alive …", absent.len());
    }
    let mut others: HashMap<String, &str> = HashMap::new();
    for (name, api) in live.nodes() {
        others.insert(port_of(api).to_owned(), name);
    }
    let mut found = Vec::new();
    let mut waiting = absent.into_iter().peekable();
    while waiting.peek().is_some() {
        let mut questions = JoinSet::new();
        for absent in waiting.by_ref().take(AT_ONCE) {
            let other = others
                .get(port_of(&absent.api))
                .filter(|name| **name != absent.node);
            if let Some(other) = other {
                let why = format!("{other} is registered at its address now");
                left_out.push((format!("node {}", absent.node), why));
                continue;
            }
            questions.spawn(ask(file.clone(), absent));
        }
        while let Some(answer) = questions.join_next().await {
            let Ok((registrations, others)) = answer else {
                continue;
            };
            found.extend(registrations);
            left_out.extend(others);
        }
    }
    // By node, as the questions were not answered in order.
    found.sort_by(|a: &Registration, b| a.text.cmp(&b.text));
    left_out.sort();
    found
}

/// Asks one node, and splits its registrations into those that are so and those that are not.
async fn ask(file: Arc<Master>, absent: Absent) -> (Vec<Registration>, Vec<LeftOut>) {
    let Absent {
        node,
        api,
        registrations,
    } = absent;
    let leave = |why: String| (Vec::new(), vec![(format!("node {node}"), why)]);
    let Interview { sign, claims, .. } = client::interview(&api, ANSWER_LIMIT).await;
    match sign {
        Sign::Alive => {}
        Sign::Dead => return leave(format!("it is dead: nothing listens at {api}")),
        Sign::Silent => return leave(format!("it does not answer at {api}")),
    }
    // roscpp lacks this one.
    let (_, name) = client::ask_for(&api, &question("getName"), ANSWER_LIMIT).await;
    let mut names: Vec<String> = name
        .iter()
        .filter_map(Value::as_str)
        .map(str::to_owned)
        .collect();
    let mut serving = Vec::new();
    for (service, at) in file.services_of(&node) {
        if let Some(name) = timeout(ANSWER_LIMIT, provider(at, service))
            .await
            .ok()
            .flatten()
        {
            serving.extend((name == node).then(|| service.to_owned()));
            names.push(name);
        }
    }
    if let Some(other) = names.iter().find(|name| **name != node) {
        return leave(format!("another node, {other}, answers at its address"));
    }
    let Some(claims) = claims else {
        return leave("it does not say what it publishes and subscribes".to_owned());
    };
    let not_so: Vec<_> = Reconciliation::new(&file, &node, &claims).extra;
    let not_so: Vec<_> = not_so
        .iter()
        .map(|registration| registration.describe(&node))
        .collect();
    let topics: Vec<_> = file
        .publications(&node)
        .chain(file.subscriptions(&node))
        .collect();
    let topics: Vec<_> = topics.into_iter().map(str::to_owned).collect();
    if names.is_empty() && !(not_so.is_empty() && claims.shares(&topics)) {
        return leave(format!("nothing shows that it is still the node at {api}"));
    }
    let (mut so, mut others) = (Vec::new(), Vec::new());
    for registration in registrations {
        let why = match &registration.service {
            Some((service, _)) if !serving.contains(service) => Some("it does not serve it now"),
            None if not_so.contains(&registration.text) => Some("it says otherwise"),
            _ => None,
        };
        match why {
            None => so.push(registration),
            Some(why) => others.push((registration.text, why.to_owned())),
        }
    }
    (so, others)
}

/// The node that provides `service` at `at`, as it says itself: a probe, as rosservice makes one.
async fn provider(at: &str, service: &str) -> Option<String> {
    let MasterUri { host, port } =
        MasterUri::parse(&at.replacen("rosrpc://", "http://", 1)).ok()?;
    let addresses = resolver::addresses(&host, port).await.ok()?;
    let mut stream = TcpStream::connect(&*addresses).await.ok()?;
    stream.write_all(&header(service)).await.ok()?;
    let length = usize::try_from(stream.read_u32_le().await.ok()?).ok()?;
    let mut answer = vec![0; length.min(MAX_HEADER)];
    stream.read_exact(&mut answer).await.ok()?;
    field(&answer, "callerid")
}

/// The header of a probe: its length, and fields with their lengths.
fn header(service: &str) -> Vec<u8> {
    let mut fields = Vec::new();
    for (key, value) in [
        ("callerid", CALLER_ID),
        ("service", service),
        ("md5sum", "*"),
        ("probe", "1"),
    ] {
        push(&mut fields, format!("{key}={value}").as_bytes());
    }
    let mut header = Vec::new();
    push(&mut header, &fields);
    header
}

fn push(to: &mut Vec<u8>, bytes: &[u8]) {
    // No name is that long.
    to.extend(u32::try_from(bytes.len()).unwrap_or(u32::MAX).to_le_bytes());
    to.extend(bytes);
}

/// The value of a field of a header.
fn field(mut header: &[u8], key: &str) -> Option<String> {
    while let Some((length, rest)) = header.split_first_chunk::<4>() {
        let length = usize::try_from(u32::from_le_bytes(*length)).ok()?;
        let (field, rest) = rest.split_at_checked(length)?;
        let value = field
            .strip_prefix(key.as_bytes())
            .and_then(|rest| rest.strip_prefix(b"="));
        if let Some(value) = value {
            return Some(String::from_utf8_lossy(value).into_owned());
        }
        header = rest;
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_field_of_a_header_is_found_and_a_broken_header_has_none() {
        let header = header("/s");
        let fields = &header[4..];
        assert_eq!(field(fields, "callerid").as_deref(), Some(CALLER_ID));
        assert_eq!(field(fields, "probe").as_deref(), Some("1"));
        assert_eq!(field(fields, "nothing"), None);
        for end in 0..fields.len() {
            field(&fields[..end], "probe");
        }
        assert_eq!(field(&[255, 255, 255, 255, 1], "probe"), None);
    }
}
