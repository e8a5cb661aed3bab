//! What calls and notifications are about: topics, parameters and node names.

use crate::health::port_of;
use ros1_master::master::{Effect, Master, Method, Request, Write, names};

/// What a call or a notification is about.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Subject {
    /// The publishers of a topic, given by its resolved name.
    Topic(String),
    /// A parameter, by its resolved key, which ends in a slash. News about a parameter also concerns the keys above and
    /// below.
    Param(String),
    /// A node's own name. A node is shut down when another node takes its name.
    Name(String),
}

impl Subject {
    /// Whether news about one of the two subjects is news about the other.
    pub fn concerns(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Param(one), Self::Param(other)) => {
                one.starts_with(other.as_str()) || other.starts_with(one.as_str())
            }
            _ => self == other,
        }
    }
}

/// A node that an answer or a notification informs about a [`Subject`].
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Recipient {
    /// The node's port; see [`port_of`].
    pub port: String,
    pub subject: Subject,
}

/// The [`Subject`]s of a write: those about which nodes may be notified, and those about which its answer informs the
/// caller.
#[derive(Clone, Debug, Default)]
pub struct Concern {
    /// The topics, parameters and names about which the master may notify nodes because of the write.
    notified: Vec<Subject>,
    /// The caller, once for each topic, parameter or name about which the answer informs it.
    recipients: Vec<Recipient>,
    /// The port of the node that registers; see [`port_of`].
    port: Option<String>,
    /// Whether the call cannot be decoded, so that it may change anything.
    may_change_anything: bool,
}

impl Concern {
    /// What a call is about. `None` stands for a call that could not be decoded.
    pub fn of_call(call: Option<&Request>) -> Self {
        let Some(call) = call else {
            return Self {
                may_change_anything: true,
                ..Self::default()
            };
        };
        let mut concern = Self::default();
        Write::all(call).for_each(|write| concern.add(&write));
        concern
    }

    fn add(&mut self, write: &Write<'_>) {
        let topic = |topic: &str| Some(Subject::Topic(topic.to_owned()));
        let param = |key: &str| Some(Subject::Param(names::param_key(key)));
        let (notified, answered) = match &write.effect {
            Effect::RegisterPublisher { topic: name, .. }
            | Effect::UnregisterPublisher { topic: name, .. } => (topic(name), None),
            Effect::SetParam { key, .. } | Effect::DeleteParam { key } => (param(key), None),
            Effect::RegisterSubscriber { topic: name, .. } => (None, topic(name)),
            Effect::SubscribeParam { key, .. } => (None, param(key)),
            Effect::RegisterService { .. }
            | Effect::UnregisterService { .. }
            | Effect::UnregisterSubscriber { .. }
            | Effect::UnsubscribeParam { .. } => (None, None),
        };
        self.notified.extend(notified);
        let Some((node, api)) = write.registrant() else {
            return;
        };
        let port = port_of(api);
        // A node of this name at another address will be shut down.
        let name = Subject::Name(node.to_owned());
        self.notified.push(name.clone());
        let subjects = [Some(name), answered].into_iter().flatten();
        self.recipients.extend(subjects.map(|subject| Recipient {
            port: port.to_owned(),
            subject,
        }));
        self.port.get_or_insert_with(|| port.to_owned());
    }

    /// The topics, parameters and names about which the master may notify nodes because of the write.
    pub fn notified_subjects(&self) -> &[Subject] {
        &self.notified
    }

    pub fn may_change_anything(&self) -> bool {
        self.may_change_anything
    }

    /// The caller's port if `subject` is a node name. The call need not wait for answers to that port, because it never
    /// shuts its own node down.
    pub(super) fn port_if_name(&self, subject: &Subject) -> Option<&str> {
        match subject {
            Subject::Name(_) => self.port.as_deref(),
            _ => None,
        }
    }

    /// The caller, once for each topic, parameter or name about which the answer informs it.
    pub fn recipients(&self) -> Vec<Recipient> {
        self.recipients.clone()
    }

    /// All [`Subject`]s of the write.
    pub fn subjects(&self) -> impl Iterator<Item = &Subject> {
        self.notified
            .iter()
            .chain(self.recipients.iter().map(|recipient| &recipient.subject))
    }
}

/// The caller of a read, once for each parameter to which it subscribes and which the answer contains. roscpp uses the
/// value that `getParam` returns until it is notified of a newer one.
pub fn recipients_of_read(read: &Request, mirror: &Master) -> Vec<Recipient> {
    let of = |call: &Request| {
        let (caller, key) = (call.caller()?, call.text(1)?);
        if *call.method() != Method::GetParam || key.is_empty() || !mirror.subscribes_params(caller)
        {
            return None;
        }
        let key = names::param_key(&names::resolve(key, caller));
        let mut subscribed = mirror.param_subscriptions(caller);
        if !subscribed.any(|other| other.starts_with(&key) || key.starts_with(other)) {
            return None;
        }
        Some(Recipient {
            port: port_of(mirror.api_of(caller)?).to_owned(),
            subject: Subject::Param(key),
        })
    };
    match read.method() {
        Method::Multicall => read.calls().into_iter().filter_map(of).collect(),
        _ => of(read).into_iter().collect(),
    }
}
