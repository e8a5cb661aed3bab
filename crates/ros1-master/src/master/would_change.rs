//! Tells whether a call would change the state, without copying the state.

use super::{Entry, Master, Method, Request, names};
use crate::xmlrpc::Value;

impl Master {
    /// Whether `call` would change the state. False only if every write in it, in order, is known to leave the state
    /// unchanged. An unregistration of something that is not registered changes nothing.
    pub fn would_change(&self, call: &Request) -> bool {
        let entries = call.entries();
        !entries
            .iter()
            .all(|entry| matches!(entry, Entry::Request(_)))
            || (call.calls().iter()).any(|call| self.is_settled(call) != Some(true))
    }

    /// Whether the state is already the one that `call` would lead to. `None` if unknown.
    fn is_settled(&self, call: &Request) -> Option<bool> {
        let text = |index| call.text(index);
        let caller_id = call.caller()?;
        let name = |index| Some(names::resolve(text(index)?, caller_id));
        let key = |index| Some(names::param_key(&name(index)?));
        // The calling node, if it is registered at the address in the call.
        let node = |index| {
            let node = self.registry.nodes.get(caller_id);
            node.filter(|node| Some(node.api.as_str()) == text(index))
        };
        let provides = |service: &str| {
            let entry = self.registry.services.get(service);
            entry.is_some_and(|of| of.node == caller_id && Some(of.api.as_str()) == text(2))
        };
        Some(match call.method() {
            Method::RegisterPublisher => {
                let (topic, topic_type) = (name(1)?, text(2)?);
                let same_type = topic_type == "*" || self.type_of(&topic) == Some(topic_type);
                same_type && node(3)?.publications.contains(&topic)
            }
            Method::RegisterSubscriber => {
                let (topic, topic_type) = (name(1)?, text(2)?);
                let typed = topic_type == "*" || self.type_of(&topic).is_some();
                typed && node(3)?.subscriptions.contains(&topic)
            }
            Method::RegisterService => {
                let service = name(1)?;
                node(3)?.services.contains(&service) && provides(&service)
            }
            Method::SubscribeParam => node(1)?.param_subscriptions.contains(&key(2)?),
            Method::UnregisterPublisher => {
                let topic = name(1)?;
                !node(2).is_some_and(|node| node.publications.contains(&topic))
            }
            Method::UnregisterSubscriber => {
                let topic = name(1)?;
                !node(2).is_some_and(|node| node.subscriptions.contains(&topic))
            }
            Method::UnregisterService => !provides(&name(1)?),
            Method::UnsubscribeParam => {
                let key = key(2)?;
                !node(1).is_some_and(|node| node.param_subscriptions.contains(&key))
            }
            Method::SetParam => {
                let value = call.params().get(2)?;
                // A struct with its members in another order is a different state.
                let plain = !matches!(value, Value::Struct(_) | Value::Array(_));
                plain && self.params.written(&key(1)?).as_ref() == Some(value)
            }
            Method::DeleteParam => self.params.written(&key(1)?).is_none(),
            // A read changes nothing. A write that is not listed above might.
            method => !method.kind().mutates(),
        })
    }
}
