//! `rosrescue inspect`: shows what a checkpoint contains.

use std::{collections::BTreeMap, fmt};

use rescue_core::{
    checkpoint::{compare::plain, format::shown},
    hide::{Hide, Masked},
};
use ros1_master::master::{Counts, Master};
use serde::Serialize;

use super::{
    CommandFailure, Exit, counted,
    files::{self, Opened},
    print,
};
use crate::{
    cli::InspectArgs,
    clock,
    printable::{Lines, Page, display_lines, line},
    status::summary::size,
};

pub(super) async fn run(args: &InspectArgs) -> Result<Exit, CommandFailure> {
    let opened = files::read_either(args.file.as_deref(), args.at, &args.read).await?;
    print(
        &Inspected::new(&opened, &args.hide.hide_values),
        &args.output,
    )?;
    Ok(Exit::Good)
}

/// The contents of a checkpoint.
#[derive(Serialize)]
struct Inspected {
    file: String,
    bytes: u64,
    /// Whether the contents are everything that was recorded.
    exact: bool,
    damage: Vec<String>,
    /// Why the last record is incomplete. `None` if it is complete.
    torn: Option<String>,
    /// Wall time of the last change.
    written: String,
    session: Session,
    counts: Counts,
    nodes: Vec<Node>,
    topics: Vec<Topic>,
    /// The parameters. Values that match `--hide-values` are masked.
    parameters: Masked<'static>,
    journal: Journal,
    /// Methods of the writes that no master has run yet.
    pending: Vec<String>,
}

#[derive(Serialize)]
struct Session {
    id: String,
    started: String,
    /// Whether rosrescue was stopped cleanly.
    closed: bool,
    master_uri: Option<String>,
}

#[derive(Serialize)]
struct Node {
    name: String,
    address: String,
    publishes: Vec<String>,
    subscribes: Vec<String>,
    services: Vec<String>,
    watches: Vec<String>,
}

#[derive(Serialize)]
struct Topic {
    name: String,
    #[serde(rename = "type")]
    kind: Option<String>,
    publishers: usize,
    subscribers: usize,
}

#[derive(Serialize)]
struct Journal {
    /// Number of the last record that the snapshot includes.
    snapshot: Option<u64>,
    /// Number of records after the snapshot.
    records: usize,
    /// Number of records after the snapshot, for each method.
    calls: BTreeMap<String, usize>,
}

impl Inspected {
    fn new(opened: &Opened, hide: &Hide) -> Self {
        let state = &opened.state;
        let texts = |names: Vec<&str>| names.into_iter().map(str::to_owned).collect::<Vec<_>>();
        let mut nodes: Vec<_> = state
            .nodes()
            .map(|(name, address)| Node {
                name: name.to_owned(),
                address: address.to_owned(),
                publishes: texts(state.publications(name).collect()),
                subscribes: texts(state.subscriptions(name).collect()),
                services: texts(state.services_of(name).map(|(name, _)| name).collect()),
                watches: texts(state.param_subscriptions(name).map(plain).collect()),
            })
            .collect();
        nodes.sort_by(|a, b| a.name.cmp(&b.name));
        let mut calls = BTreeMap::new();
        for method in &opened.journal {
            *calls.entry(method.clone()).or_default() += 1;
        }
        let session = &opened.session;
        let pending = opened.pending.iter();
        Self {
            file: opened.path.display().to_string(),
            bytes: opened.bytes,
            exact: opened.exact,
            damage: opened.damage.clone(),
            torn: opened.torn.clone(),
            written: clock::wall_text(opened.written),
            session: Session {
                id: session.id.clone(),
                started: session.started.clone(),
                closed: session.closed,
                master_uri: session.master_uri.clone(),
            },
            counts: state.counts(),
            nodes,
            topics: topics(state),
            parameters: hide.mask_tree(state.params()),
            journal: Journal {
                snapshot: opened.snapshot_seq,
                records: opened.journal.len(),
                calls,
            },
            pending: pending
                .map(|call| call.method().name().to_owned())
                .collect(),
        }
    }
}

/// The topics that are in use.
fn topics(state: &Master) -> Vec<Topic> {
    let mut used: BTreeMap<&str, (usize, usize)> = BTreeMap::new();
    for (node, _) in state.nodes() {
        for topic in state.publications(node) {
            used.entry(topic).or_default().0 += 1;
        }
        for topic in state.subscriptions(node) {
            used.entry(topic).or_default().1 += 1;
        }
    }
    let topics = used
        .into_iter()
        .map(|(name, (publishers, subscribers))| Topic {
            name: name.to_owned(),
            kind: state.type_of(name).map(str::to_owned),
            publishers,
            subscribers,
        });
    topics.collect()
}

impl Lines for Inspected {
    fn lines(&self, f: &mut Page) -> fmt::Result {
        let Self {
            session, journal, ..
        } = self;
        line!(f, "checkpoint  {} ({})", self.file, size(self.bytes))?;
        for sentence in self.damage.iter().chain(&self.torn) {
            line!(f, "            {sentence}")?;
        }
        let end = match session.closed {
            true => "stopped cleanly",
            false => "running, or not stopped cleanly",
        };
        line!(
            f,
            "session     {} of {}, {end}",
            session.id,
            session.started
        )?;
        line!(f, "written     {}", self.written)?;
        let master = session.master_uri.as_deref().unwrap_or("none yet");
        line!(f, "master      {master}")?;
        line!(f, "state       {}", self.counts)?;
        let calls: Vec<_> = journal
            .calls
            .iter()
            .map(|(name, count)| format!("{count} {name}"))
            .collect();
        let calls = if calls.is_empty() {
            "nothing".to_owned()
        } else {
            calls.join(", ")
        };
        match journal.snapshot {
            Some(seq) => line!(
                f,
                "journal     {calls} since the snapshot, which ends with record {seq}"
            )?,
            None => line!(f, "journal     {calls}; there is no complete snapshot")?,
        }
        if !self.pending.is_empty() {
            line!(
                f,
                "pending     {} that no master has run yet",
                counted(self.pending.len(), "write")
            )?;
        }
        line!(f)?;
        line!(f, "nodes")?;
        for node in &self.nodes {
            line!(f, "  {} at {}", node.name, node.address)?;
            for (verb, names) in [
                ("publishes", &node.publishes),
                ("subscribes", &node.subscribes),
                ("provides", &node.services),
                ("watches", &node.watches),
            ] {
                if !names.is_empty() {
                    line!(f, "    {verb:<11}{}", names.join(", "))?;
                }
            }
        }
        line!(f)?;
        line!(f, "topics")?;
        for topic in &self.topics {
            let kind = topic.kind.as_deref().unwrap_or("of unknown type");
            let (publishers, subscribers) = (topic.publishers, topic.subscribers);
            line!(
                f,
                "  {}  {kind}  {publishers} publishing, {subscribers} subscribing",
                topic.name
            )?;
        }
        line!(f)?;
        line!(f, "parameters")?;
        write_params(f, "", &self.parameters)
    }
}

display_lines!(Inspected);

fn write_params(f: &mut Page, path: &str, value: &Masked<'_>) -> fmt::Result {
    for (key, value) in value.members().into_iter().flatten() {
        let name = format!("{path}/{key}");
        match value.members() {
            Some(_) => write_params(f, &name, &value)?,
            None => line!(f, "  {name}: {}", shown(&value))?,
        }
    }
    Ok(())
}
