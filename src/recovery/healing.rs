//! Telling nodes what the master may not have told them, or will tell them late.
//!
//! A node does nothing with a list of publishers that it knows already. A stale one could make it
//! drop links: so what a letter says is read from the mirror at the moment at which it is sent, a
//! node gets one letter at a time, and one that has become stale on its way is followed by another.

use std::{
    collections::HashMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use indexmap::IndexSet;
use tokio::sync::Semaphore;

use super::node::{self, Sign};
use crate::{
    master::Master,
    proxy::{Proxy, activity::Letter},
    xmlrpc::Call,
};

/// Nodes that are told something at the same time. Each takes a file descriptor.
const AT_ONCE: usize = 64;

/// The letters under way.
#[derive(Debug)]
pub struct Post {
    /// What each address is still to be told; an entry for each that is being told something.
    pending: Mutex<HashMap<String, IndexSet<Letter>>>,
    permits: Semaphore,
}

impl Default for Post {
    fn default() -> Self {
        Self {
            pending: Mutex::default(),
            permits: Semaphore::new(AT_ONCE),
        }
    }
}

impl Post {
    fn lock(&self) -> MutexGuard<'_, HashMap<String, IndexSet<Letter>>> {
        self.pending.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Tells every subscriber of `topic` its publishers. Answers whether there are subscribers.
pub fn tell_subscribers(proxy: &Arc<Proxy>, topic: &str) -> bool {
    let subscribers = proxy
        .shadow
        .with_mirror(|mirror| mirror.subscribers_of(topic));
    for api in &subscribers {
        send(proxy, api, Letter::Topic(topic.to_owned()));
    }
    !subscribers.is_empty()
}

/// Tells the node at `api` of every topic and every parameter that it subscribes.
pub fn tell_all(proxy: &Arc<Proxy>, api: &str) {
    let letters = proxy.shadow.with_mirror(|mirror| {
        let names = mirror.nodes().filter(|(_, at)| *at == api);
        let letters = names.flat_map(|(name, _)| {
            let topics = mirror.subscriptions(name).map(str::to_owned);
            // What is not set, and may never have been, is no news.
            let keys = mirror.param_subscriptions(name);
            let keys = keys.filter(|key| mirror.is_set(key)).map(Arc::from);
            topics.map(Letter::Topic).chain(keys.map(Letter::Param))
        });
        letters.collect::<Vec<_>>()
    });
    for letter in letters {
        send(proxy, api, letter);
    }
}

/// Tells the node at `api` something, unless it is a suspect: those are told everything as soon as
/// they answer. Who does not take a letter becomes a suspect.
pub fn send(proxy: &Arc<Proxy>, api: &str, letter: Letter) {
    if proxy.nodes.is_suspect(api) {
        return;
    }
    let mut pending = proxy.nodes.post.lock();
    if let Some(letters) = pending.get_mut(api) {
        letters.insert(letter);
        return;
    }
    pending.insert(api.to_owned(), IndexSet::from([letter]));
    drop(pending);
    tokio::spawn(deliver(proxy.clone(), api.to_owned()));
}

async fn deliver(proxy: Arc<Proxy>, api: String) {
    let post = &proxy.nodes.post;
    loop {
        let letter = {
            let mut pending = post.lock();
            match pending.get_mut(&api).and_then(IndexSet::pop) {
                Some(letter) => letter,
                None => {
                    pending.remove(&api);
                    return;
                }
            }
        };
        let compose = || {
            proxy
                .shadow
                .with_mirror(|mirror| compose(mirror, &api, &letter))
        };
        // Never closed.
        let permit = post.permits.acquire().await;
        let Some(call) = compose() else { continue };
        let sign = node::ask(&api, &call, proxy.config.census_timeout).await;
        drop(permit);
        if sign != Sign::Alive {
            post.lock().remove(&api);
            proxy.nodes.suspect(&proxy, &api);
            return;
        }
        if compose().is_some_and(|now| now != call)
            && let Some(letters) = post.lock().get_mut(&api)
        {
            letters.insert(letter);
        }
    }
}

/// What `letter` to the node at `api` says now; none if it does not concern that node any more.
fn compose(mirror: &Master, api: &str, letter: &Letter) -> Option<Call> {
    match letter {
        Letter::Topic(topic) => mirror
            .subscribes(api, topic)
            .then(|| mirror.publisher_update(topic)),
        Letter::Param(key) => match mirror.subscribes_param(api, key) {
            true => mirror.param_update(key),
            false => None,
        },
    }
}
