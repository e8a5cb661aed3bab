//! `rosrescue check --live`: asks the nodes whether each subscriber is connected to each publisher of its topics.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
    time::Duration,
};

use rescue_core::replay::Token;
use ros1_master::{
    master::{Master, question},
    xmlrpc::Value,
};
use tokio::{sync::Semaphore, task::JoinSet, time::sleep};

use super::{Finding, Severity, find_running, robot};
use crate::{
    cli::CheckArgs,
    commands::{CommandFailure, counted, live::Live},
    nodes::client::{self, Reaction},
    status::summary::shortened,
};

const SUBJECT: &str = "links";
/// Longest time for a node to answer.
const ANSWER_LIMIT: Duration = Duration::from_secs(3);
/// Number of nodes that are asked at the same time.
const AT_ONCE: usize = 64;
/// Pause before a second look at missing connections: a node that has just started may connect meanwhile.
const LOOK_AGAIN: Duration = Duration::from_secs(1);

/// Asks the nodes of the running robot.
pub(super) async fn check_links(args: &CheckArgs) -> Result<Vec<Finding>, CommandFailure> {
    let running = find_running(args)?;
    let mut live = Live::connect(&running).await?;
    let mut found = read_connections(&mut live).await?;
    if !found.missing.is_empty() || !found.silent.is_empty() {
        sleep(LOOK_AGAIN).await;
        let before = found;
        found = read_connections(&mut live).await?;
        found.missing.retain(|link| before.missing.contains(link));
    }
    let mut findings = found.findings();
    findings.extend(robot::find_trouble(&running, false).await);
    Ok(findings)
}

async fn read_connections(live: &mut Live) -> Result<Found, CommandFailure> {
    let state = live.state(&Master::default()).await?;
    let permits = Arc::new(Semaphore::new(AT_ONCE));
    let mut answers = JoinSet::new();
    for (name, api) in state.nodes().filter(|(name, _)| !Token::is_ours(name)) {
        let (name, api, permits) = (name.to_owned(), api.to_owned(), permits.clone());
        answers.spawn(async move {
            // The semaphore is never closed.
            let _permit = permits.acquire().await;
            let answer = client::call_for_value(&api, &question("getBusInfo"), ANSWER_LIMIT).await;
            (name, Answer::read(answer))
        });
    }
    let answers = answers.join_all().await.into_iter().collect();
    Ok(compare(&state, &answers))
}

/// A node's answer about its connections.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Answer {
    Connections(Vec<Connection>),
    /// An answer that contains no connections.
    Other,
    Silent,
}

#[derive(Clone, Debug, PartialEq, Eq)]
struct Connection {
    topic: String,
    /// The publisher's address if the connection is incoming, the subscriber's name if it is outgoing.
    peer: String,
    is_incoming: bool,
}

impl Answer {
    fn read((sign, value): (Reaction, Option<Value>)) -> Self {
        let list = value.as_ref().and_then(Value::as_array);
        match (sign, list) {
            (Reaction::Alive, Some(list)) => {
                let connections = list.iter().map(Connection::read).collect::<Option<_>>();
                connections.map_or(Self::Other, Self::Connections)
            }
            (Reaction::Alive, None) => Self::Other,
            _ => Self::Silent,
        }
    }
}

impl Connection {
    /// Reads an entry of `getBusInfo`. rospy and roscpp send id, peer, direction, transport, topic, and more.
    fn read(entry: &Value) -> Option<Self> {
        let [_, peer, direction, _, topic, ..] = entry.as_array()? else {
            return None;
        };
        Some(Self {
            topic: topic.as_str()?.to_owned(),
            peer: trimmed(peer.as_str()?).to_owned(),
            is_incoming: direction.as_str()? == "i",
        })
    }
}

fn trimmed(api: &str) -> &str {
    api.trim_end_matches('/')
}

/// A connection that should exist between a subscriber and a publisher of one topic.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Link {
    subscriber: String,
    topic: String,
    publisher: String,
}

#[derive(Debug, Default, PartialEq, Eq)]
struct Found {
    /// Number of connections that the subscriber confirms.
    seen: usize,
    missing: BTreeSet<Link>,
    /// Connections that the subscriber's answer neither shows nor rules out.
    unknown: BTreeSet<Link>,
    /// Nodes that did not answer.
    silent: BTreeSet<String>,
}

/// Compares the registrations with the nodes' answers. Leaves out connections of nodes that did not answer.
fn compare(state: &Master, answers: &BTreeMap<String, Answer>) -> Found {
    let mut found = Found::default();
    let mut publishers = BTreeMap::<_, Vec<_>>::new();
    for (name, api) in state.nodes() {
        match answers.get(name) {
            None => {}
            Some(Answer::Silent) => {
                found.silent.insert(name.to_owned());
            }
            Some(answer) => {
                for topic in state.publications(name) {
                    let all = publishers.entry(topic.to_owned()).or_default();
                    all.push((name, trimmed(api), answer));
                }
            }
        }
    }
    for (subscriber, _) in state.nodes() {
        let Some(answer) = answers.get(subscriber).filter(|it| **it != Answer::Silent) else {
            continue;
        };
        for topic in state.subscriptions(subscriber) {
            for (publisher, api, word) in publishers.get(topic).into_iter().flatten() {
                let link = || Link {
                    subscriber: subscriber.to_owned(),
                    topic: topic.to_owned(),
                    publisher: (*publisher).to_owned(),
                };
                let has = |answer: &Answer, peer, is_incoming| match answer {
                    Answer::Connections(all) => all.iter().any(|it| {
                        it.topic == topic && it.peer == peer && it.is_incoming == is_incoming
                    }),
                    _ => false,
                };
                // Some libraries always answer with an empty list.
                let is_empty = *answer == Answer::Connections(Vec::new());
                if has(answer, *api, true) {
                    found.seen += 1;
                } else if *answer == Answer::Other || is_empty && has(word, subscriber, false) {
                    found.unknown.insert(link());
                } else {
                    found.missing.insert(link());
                }
            }
        }
    }
    found
}

impl Found {
    fn findings(self) -> Vec<Finding> {
        let finding = |severity, what, todo: String| Finding {
            severity,
            subject: SUBJECT,
            what,
            todo,
        };
        let mut all = Vec::new();
        for Link {
            subscriber,
            topic,
            publisher,
        } in self.missing
        {
            let what = format!("{subscriber} is not connected to {topic} of {publisher}");
            let todo = format!(
                "restart {subscriber}; if that does not help, and the log of {publisher} has `md5sum` or `types do \
                 not match`, their message types differ"
            );
            all.push(finding(Severity::Problem, what, todo));
        }
        for Link {
            subscriber,
            topic,
            publisher,
        } in self.unknown
        {
            let what = format!(
                "{subscriber} does not say whether it is connected to {topic} of {publisher}"
            );
            all.push(finding(Severity::Note, what, String::new()));
        }
        if !self.silent.is_empty() {
            let silent: Vec<_> = self.silent.into_iter().collect();
            let what = format!(
                "{} without an answer: {}",
                counted(silent.len(), "node"),
                shortened(&silent)
            );
            let todo =
                "`rosrescue status` shows which are dead; `rosnode cleanup` unregisters those";
            all.push(finding(Severity::Warning, what, todo.to_owned()));
        }
        let seen = format!(
            "{} between subscribers and publishers",
            counted(self.seen, "link")
        );
        all.push(finding(Severity::Ok, seen, String::new()));
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros1_master::{master::Request, xmlrpc::Call};

    fn state() -> Master {
        let mut state = Master::default();
        for (method, node, topic, port) in [
            ("registerPublisher", "/talker", "/chatter", 1),
            ("registerPublisher", "/other", "/chatter", 2),
            ("registerSubscriber", "/listener", "/chatter", 3),
        ] {
            let api = format!("http://robot:{port}/");
            let params = vec![
                node.into(),
                topic.into(),
                "std_msgs/String".into(),
                api.as_str().into(),
            ];
            state.apply_telling(&Request::from(Call::new(method, params)), &mut ());
        }
        state
    }

    fn answer_with(connections: &[(&str, &str)]) -> Answer {
        let entry = |(peer, direction): &(&str, &str)| {
            let fields = ["1", peer, direction, "TCPROS", "/chatter", "1", "…"];
            Value::Array(fields.map(Value::from).to_vec())
        };
        let list = Value::Array(connections.iter().map(entry).collect());
        Answer::read((Reaction::Alive, Some(list)))
    }

    /// Numbers of seen, missing and unknown connections and of silent nodes.
    fn counts(talker: Answer, other: Answer, listener: Answer) -> [usize; 4] {
        let names = ["/talker", "/other", "/listener"].map(str::to_owned);
        let answers = names.into_iter().zip([talker, other, listener]).collect();
        let found = compare(&state(), &answers);
        [
            found.seen,
            found.missing.len(),
            found.unknown.len(),
            found.silent.len(),
        ]
    }

    #[test]
    fn each_subscriber_is_compared_with_each_publisher_that_lives() {
        let none = || answer_with(&[]);
        let both = answer_with(&[
            ("http://robot:1", "i"),
            ("http://robot:2/", "i"),
            ("/rosout", "o"),
        ]);
        assert_eq!(counts(none(), none(), both), [2, 0, 0, 0]);
        let one = || answer_with(&[("http://robot:1/", "i")]);
        assert_eq!(counts(none(), none(), one()), [1, 1, 0, 0]);
        // A publisher may still list a connection that its subscriber has closed.
        let claims = || answer_with(&[("/listener", "o")]);
        assert_eq!(counts(claims(), claims(), one()), [1, 1, 0, 0]);
        assert_eq!(counts(claims(), none(), none()), [0, 1, 1, 0]);
        assert_eq!(counts(none(), Answer::Silent, one()), [1, 0, 0, 1]);
        assert_eq!(counts(none(), none(), Answer::Silent), [0, 0, 0, 1]);
        assert_eq!(counts(none(), none(), Answer::Other), [0, 0, 2, 0]);
    }

    #[test]
    fn an_answer_of_another_form_says_nothing() {
        let read = |value| Answer::read((Reaction::Alive, value));
        assert_eq!(read(None), Answer::Other);
        assert_eq!(read(Some(Value::Array(vec![1.into()]))), Answer::Other);
        assert_eq!(Answer::read((Reaction::Dead, None)), Answer::Silent);
    }
}
