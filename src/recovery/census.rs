//! After a recovery, beside traffic: which nodes still live, and who has not heard the news.
//!
//! Nothing here may hold up a call: a roscpp node that is itself inside a parked registration
//! cannot answer us before that call is through.

use std::{sync::Arc, time::Duration};

use hyper::header::HeaderValue;
use tokio::{sync::Semaphore, task::JoinSet};

use crate::{
    master::Kind,
    proxy::{
        Proxy,
        upstream::{ConnectError, Upstream},
    },
    ros_env::MasterUri,
    xmlrpc::{Call, Reply, Value},
};

/// Nodes asked at the same time. Each takes a file descriptor for at most the deadline.
const AT_ONCE: usize = 128;

/// A list that changes all the time is told so often; the master tells each change too.
const ROUNDS: u32 = 10;

/// What a node said to a question.
#[derive(Debug, PartialEq, Eq)]
pub enum Sign {
    /// It answered.
    Alive,
    /// Its port refuses: the process is gone.
    Dead,
    /// No answer in time, or none that makes sense. That is no proof of death.
    Silent,
}

/// Makes `call` to the node at `api` and waits for a sign of life for at most `limit`.
pub async fn ask(api: &str, call: &Call, limit: Duration) -> Sign {
    ask_for(api, call, limit).await.0
}

/// As [`ask`], with the value that the node returned.
pub async fn ask_for(api: &str, call: &Call, limit: Duration) -> (Sign, Option<Value>) {
    let Ok(address) = MasterUri::parse(api) else {
        return (Sign::Silent, None);
    };
    let question = async {
        let name = HeaderValue::from_static("to-a-node");
        let mut connection = match Upstream::new(address, name).connect().await {
            Ok(connection) => connection,
            Err(ConnectError::Refused { .. }) => return (Sign::Dead, None),
            Err(ConnectError::Unreachable { .. }) => return (Sign::Silent, None),
        };
        match connection.call(call).await {
            Ok(Reply::Value(Value::Array(answer))) => (Sign::Alive, answer.into_iter().nth(2)),
            Ok(_) | Err(_) => (Sign::Silent, None),
        }
    };
    tokio::time::timeout(limit, question)
        .await
        .unwrap_or((Sign::Silent, None))
}

/// What a census found.
#[derive(Debug, Default)]
pub struct Census {
    /// Nodes that are dead and have been taken out, through the master, so that others are told.
    pub removed: Vec<String>,
    /// Nodes that did not answer.
    pub suspects: Vec<String>,
}

/// Asks every node for a sign of life and takes out the dead ones.
pub async fn census(proxy: &Arc<Proxy>) -> Census {
    let nodes: Vec<(String, String)> = proxy.shadow.with_mirror(|mirror| {
        mirror
            .nodes()
            .map(|(id, api)| (id.to_owned(), api.to_owned()))
            .collect()
    });
    let call = Call::new("getPid", vec!["/rosrescue".into()]);
    let limit = proxy.config.census_timeout;
    let permits = Arc::new(Semaphore::new(AT_ONCE));
    let mut questions = JoinSet::new();
    for (node, api) in nodes {
        let (call, permits) = (call.clone(), permits.clone());
        questions.spawn(async move {
            // Never closed.
            let _permit = permits.acquire().await;
            let sign = ask(&api, &call, limit).await;
            (node, api, sign)
        });
    }
    let mut census = Census::default();
    while let Some(answer) = questions.join_next().await {
        let Ok((node, api, sign)) = answer else {
            continue;
        };
        match sign {
            Sign::Alive => {}
            Sign::Silent => census.suspects.push(node),
            Sign::Dead => {
                if remove(proxy, &node, &api).await {
                    census.removed.push(node);
                }
            }
        }
    }
    census.removed.sort();
    census.suspects.sort();
    census
}

/// Unregisters a dead node as it would have done itself. Not if it has another address by now:
/// then it has come back.
async fn remove(proxy: &Proxy, node: &str, api: &str) -> bool {
    let calls = proxy.shadow.with_mirror(|mirror| {
        let same = mirror.nodes().any(|(id, now)| id == node && now == api);
        if same {
            mirror.unregister_calls(node)
        } else {
            Vec::new()
        }
    });
    if calls.is_empty() {
        return false;
    }
    proxy
        .lane
        .call(Call::multicall(calls), Kind::Unregister)
        .await
        .is_some()
}

/// Sends the full list of publishers to each subscriber of `topics`; answers the topics that had
/// any. A node does nothing with a list that it knows already.
pub async fn heal(proxy: &Arc<Proxy>, topics: Vec<String>) -> Vec<String> {
    let permits = Arc::new(Semaphore::new(AT_ONCE));
    let mut tasks = JoinSet::new();
    for topic in topics {
        let (publishers, subscribers) = lists(proxy, &topic);
        if subscribers.is_empty() {
            continue;
        }
        let (proxy, permits) = (proxy.clone(), permits.clone());
        tasks.spawn(async move {
            tell(&proxy, &permits, &topic, publishers, subscribers).await;
            topic
        });
    }
    let mut healed: Vec<String> = tasks.join_all().await;
    healed.sort();
    healed
}

/// Tells all until the list is the same before and after: the master may have told them a newer
/// one meanwhile, which ours must not outlast.
async fn tell(
    proxy: &Arc<Proxy>,
    permits: &Arc<Semaphore>,
    topic: &str,
    mut publishers: Vec<String>,
    mut subscribers: Vec<String>,
) {
    for _ in 0..ROUNDS {
        let list: Vec<Value> = publishers.iter().cloned().map(Value::String).collect();
        let params = vec!["/master".into(), topic.into(), Value::Array(list)];
        let call = Call::new("publisherUpdate", params);
        let mut letters = JoinSet::new();
        for api in subscribers {
            let (call, permits) = (call.clone(), permits.clone());
            let limit = proxy.config.census_timeout;
            letters.spawn(async move {
                // Never closed.
                let _permit = permits.acquire().await;
                ask(&api, &call, limit).await;
            });
        }
        letters.join_all().await;
        let (now, interested) = lists(proxy, topic);
        if now == publishers {
            return;
        }
        (publishers, subscribers) = (now, interested);
    }
}

fn lists(proxy: &Proxy, topic: &str) -> (Vec<String>, Vec<String>) {
    proxy
        .shadow
        .with_mirror(|mirror| (mirror.publishers_of(topic), mirror.subscribers_of(topic)))
}
