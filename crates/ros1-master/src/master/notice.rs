//! The callbacks (notifications) that a master sends to nodes.

use crate::xmlrpc::{Call, Value};

#[derive(Clone, Debug, PartialEq)]
pub enum Notice {
    /// `publisherUpdate('/master', topic, publishers)`, sent to a subscriber.
    PublisherUpdate {
        /// Address of the subscriber.
        to: String,
        topic: String,
        /// Addresses of all publishers of the topic.
        publishers: Vec<String>,
    },
    /// `paramUpdate('/master', key, value)`, sent to a subscriber of a parameter.
    ParamUpdate {
        /// Address of the subscriber.
        to: String,
        /// The changed key, with a trailing slash.
        key: String,
        /// The new value, or an empty struct if the parameter was deleted.
        value: Value,
    },
    /// `shutdown('/master', reason)`, sent to a node whose name was taken.
    Shutdown {
        /// Address of the node that had the name before.
        to: String,
        reason: String,
    },
}

impl Notice {
    /// Address of the node to which this callback goes.
    pub fn to(&self) -> &str {
        match self {
            Self::PublisherUpdate { to, .. }
            | Self::ParamUpdate { to, .. }
            | Self::Shutdown { to, .. } => to,
        }
    }

    /// The call of the node's slave API that carries this callback.
    pub fn call(&self) -> Call {
        match self {
            Self::PublisherUpdate {
                topic, publishers, ..
            } => super::publisher_update(topic, publishers),
            Self::ParamUpdate { key, value, .. } => super::param_update(key, value.clone()),
            Self::Shutdown { reason, .. } => Call::new(
                "shutdown",
                vec![super::tell::MASTER.into(), reason.as_str().into()],
            ),
        }
    }
}

/// Receives callbacks as the master queues them. Arguments are borrowed, because one change may go to thousands of
/// nodes, each time with a large value. The default methods ignore the callbacks.
pub trait NoticeSink {
    /// Receives a [`Notice::PublisherUpdate`] for each address in `to`.
    fn publisher_update(&mut self, _to: &[String], _topic: &str, _publishers: &[String]) {}

    /// Receives a [`Notice::ParamUpdate`] for each address in `to`.
    fn param_update(&mut self, _to: &[String], _key: &str, _value: &Value) {}

    fn shutdown(&mut self, _to: &str, _reason: &str) {}
}

/// Ignores all callbacks.
impl NoticeSink for () {}

/// Collects all callbacks.
impl NoticeSink for Vec<Notice> {
    fn publisher_update(&mut self, to: &[String], topic: &str, publishers: &[String]) {
        self.extend(to.iter().map(|to| Notice::PublisherUpdate {
            to: to.clone(),
            topic: topic.to_owned(),
            publishers: publishers.to_vec(),
        }));
    }

    fn param_update(&mut self, to: &[String], key: &str, value: &Value) {
        self.extend(to.iter().map(|to| Notice::ParamUpdate {
            to: to.clone(),
            key: key.to_owned(),
            value: value.clone(),
        }));
    }

    fn shutdown(&mut self, to: &str, reason: &str) {
        self.push(Notice::Shutdown {
            to: to.to_owned(),
            reason: reason.to_owned(),
        });
    }
}
