//! Tells whether a call would change the state, without copying the state.

use super::{Effect, Entry, Master, Request, Write, names};
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

    /// Whether a master in this state surely accepts `write`. False if in doubt.
    pub fn accepts(&self, write: &Write<'_>) -> bool {
        match &write.effect {
            Effect::SetParam { key, value } => {
                matches!(value, Value::Struct(_)) || names::parts(key).next().is_some()
            }
            Effect::DeleteParam { key } => {
                names::parts(key).next().is_some() && self.params.written(key).is_some()
            }
            Effect::RegisterPublisher { .. }
            | Effect::RegisterSubscriber { .. }
            | Effect::RegisterService { .. }
            | Effect::UnregisterPublisher { .. }
            | Effect::UnregisterSubscriber { .. }
            | Effect::UnregisterService { .. }
            | Effect::SubscribeParam { .. }
            | Effect::UnsubscribeParam { .. } => true,
        }
    }

    /// Whether the state is already the one that `call` would lead to. `None` if unknown, as for a write that the
    /// master refuses.
    fn is_settled(&self, call: &Request) -> Option<bool> {
        if !call.method().kind().mutates() {
            return Some(true);
        }
        let Write { caller, effect } = Write::parse(call)?;
        // The calling node, if it is registered at this address.
        let node = |api: &str| {
            let node = self.registry.nodes.get(caller);
            node.filter(|node| node.api == api)
        };
        let provides = |service: &str, api: &str| {
            let entry = self.registry.services.get(service);
            entry.is_some_and(|of| of.node == caller && of.api == api)
        };
        Some(match effect {
            Effect::RegisterPublisher {
                topic,
                topic_type,
                api,
            } => {
                let same_type = topic_type == "*" || self.type_of(&topic) == Some(topic_type);
                same_type && node(api)?.publications.contains(&*topic)
            }
            Effect::RegisterSubscriber {
                topic,
                topic_type,
                api,
            } => {
                let typed = topic_type == "*" || self.type_of(&topic).is_some();
                typed && node(api)?.subscriptions.contains(&*topic)
            }
            Effect::RegisterService {
                service,
                service_api,
                api,
            } => node(api)?.services.contains(&*service) && provides(&service, service_api),
            Effect::SubscribeParam { key, api } => node(api)?
                .param_subscriptions
                .contains(&names::param_key(&key)),
            Effect::UnregisterPublisher { topic, api } => {
                !node(api).is_some_and(|node| node.publications.contains(&*topic))
            }
            Effect::UnregisterSubscriber { topic, api } => {
                !node(api).is_some_and(|node| node.subscriptions.contains(&*topic))
            }
            Effect::UnregisterService {
                service,
                service_api,
            } => !provides(&service, service_api),
            Effect::UnsubscribeParam { key, api } => {
                let key = names::param_key(&key);
                !node(api).is_some_and(|node| node.param_subscriptions.contains(&key))
            }
            Effect::SetParam { key, value } => {
                // A struct with its members in another order is a different state.
                let plain = !matches!(value, Value::Struct(_) | Value::Array(_));
                plain && self.params.written(&names::param_key(&key)).as_ref() == Some(value)
            }
            Effect::DeleteParam { key } => self.params.written(&names::param_key(&key)).is_none(),
        })
    }
}
