//! The methods of the Master API, as in `rosmaster/master_api.py`.

use super::api::{Arguments, MethodResult, strings};
use super::registry::SharedRegistration;
use super::{Effect, Master, NoticeSink, checks, names};
use crate::xmlrpc::{Struct, Value};

impl Master {
    pub(crate) fn get_pid(&mut self, _: Arguments<'_>) -> MethodResult {
        Ok((1, String::new(), self.pid.into()))
    }

    pub(crate) fn get_uri(&mut self, _: Arguments<'_>) -> MethodResult {
        Ok((1, String::new(), self.uri.as_str().into()))
    }

    pub(crate) fn shutdown(&mut self, _: Arguments<'_>) -> MethodResult {
        Ok((1, "shutdown".to_owned(), 0.into()))
    }

    /// Makes a write of `caller_id`, whose arguments are checked.
    pub(crate) fn run(
        &mut self,
        caller_id: &str,
        effect: Effect<'_>,
        notices: &mut dyn NoticeSink,
    ) -> MethodResult {
        match effect {
            Effect::RegisterPublisher {
                topic,
                topic_type,
                api,
            } => {
                let shared = SharedRegistration::Publishers;
                let bumped = self.registry.register(shared, &topic, caller_id, api);
                self.notify_bumped(caller_id, bumped, notices);
                if topic_type != "*" || !self.topic_types.contains_key(&topic) {
                    self.topic_types
                        .insert(topic.to_string(), topic_type.to_owned());
                }
                let subscribers = self.notify_publishers(&topic, notices);
                let message = format!("Registered [{caller_id}] as publisher of [{topic}]");
                Ok((1, message, strings(subscribers)))
            }
            Effect::RegisterSubscriber {
                topic,
                topic_type,
                api,
            } => {
                let shared = SharedRegistration::Subscribers;
                let bumped = self.registry.register(shared, &topic, caller_id, api);
                self.notify_bumped(caller_id, bumped, notices);
                if topic_type != "*" && !self.topic_types.contains_key(&topic) {
                    self.topic_types
                        .insert(topic.to_string(), topic_type.to_owned());
                }
                let publishers = self.registry.apis(SharedRegistration::Publishers, &topic);
                Ok((1, format!("Subscribed to [{topic}]"), strings(publishers)))
            }
            Effect::RegisterService {
                service,
                service_api,
                api,
            } => {
                let bumped = self
                    .registry
                    .register_service(&service, caller_id, api, service_api);
                self.notify_bumped(caller_id, bumped, notices);
                let message = format!("Registered [{caller_id}] as provider of [{service}]");
                Ok((1, message, 1.into()))
            }
            Effect::UnregisterPublisher { topic, api } => {
                let shared = SharedRegistration::Publishers;
                let (message, done) = self.registry.unregister(shared, &topic, caller_id, api);
                if done {
                    self.notify_publishers(&topic, notices);
                }
                Ok((1, message, i32::from(done).into()))
            }
            Effect::UnregisterSubscriber { topic, api } => {
                let shared = SharedRegistration::Subscribers;
                let (message, done) = self.registry.unregister(shared, &topic, caller_id, api);
                Ok((1, message, i32::from(done).into()))
            }
            Effect::UnregisterService {
                service,
                service_api,
            } => {
                let (message, done) =
                    self.registry
                        .unregister_service(&service, caller_id, service_api);
                Ok((1, message, i32::from(done).into()))
            }
            Effect::SubscribeParam { key, api } => {
                let subscribed = names::param_key(&key);
                let value = self.params.get(&subscribed);
                let value = value.unwrap_or_else(|| Value::Struct(Struct::new()));
                let shared = SharedRegistration::ParamSubscribers;
                let bumped = self.registry.register(shared, &subscribed, caller_id, api);
                self.notify_bumped(caller_id, bumped, notices);
                Ok((1, format!("Subscribed to parameter [{key}]"), value))
            }
            Effect::UnsubscribeParam { key, api } => {
                let shared = SharedRegistration::ParamSubscribers;
                self.registry
                    .unregister(shared, &names::param_key(&key), caller_id, api);
                Ok((1, format!("Unsubscribe to parameter [{key}]"), 1.into()))
            }
            Effect::SetParam { key, value } => {
                let changed = names::param_key(&key);
                let subscribers = &self.registry.param_subscribers;
                let ignored = (self.old != Some(true)).then_some(caller_id);
                let updates = self.params.set(&changed, value, ignored, subscribers)?;
                self.registry.notify_params(updates, notices);
                Ok((1, format!("parameter {key} set"), 0.into()))
            }
            Effect::DeleteParam { key } => {
                let changed = names::param_key(&key);
                let subscribers = &self.registry.param_subscribers;
                Ok(match self.params.delete(&changed, subscribers)? {
                    Some(updates) => {
                        self.registry.notify_params(updates, notices);
                        (1, format!("parameter {key} deleted"), 0.into())
                    }
                    None => (-1, format!("parameter [{key}] is not set"), 0.into()),
                })
            }
        }
    }

    pub(crate) fn lookup_service(&mut self, of: Arguments<'_>) -> MethodResult {
        let [service] = of.params()?;
        let service = checks::resource("service", service, of.caller_id)?;
        Ok(match self.registry.services.get(&service) {
            Some(entry) => {
                let message = format!("rosrpc URI: [{}]", entry.api);
                (1, message, entry.api.as_str().into())
            }
            None => (-1, "no provider".to_owned(), "".into()),
        })
    }

    pub(crate) fn lookup_node(&mut self, of: Arguments<'_>) -> MethodResult {
        let [node] = of.params()?;
        let node = checks::name("node", node, of.caller_id)?;
        Ok(match self.registry.nodes.get(&node) {
            Some(found) => (1, "node api".to_owned(), found.api.as_str().into()),
            None => (-1, format!("unknown node [{node}]"), "".into()),
        })
    }

    pub(crate) fn get_published_topics(&mut self, of: Arguments<'_>) -> MethodResult {
        let [subgraph] = of.params()?;
        let mut subgraph = checks::subgraph(subgraph, of.caller_id)?;
        if !subgraph.is_empty() && !subgraph.ends_with('/') {
            subgraph.push('/');
        }
        let topics = self.registry.publishers.keys();
        let topics = topics.filter(|topic| topic.starts_with(&subgraph));
        let pairs = topics.filter_map(|topic| Some(pair(topic, self.topic_types.get(topic)?)));
        Ok((
            1,
            "current topics".to_owned(),
            Value::Array(pairs.collect()),
        ))
    }

    pub(crate) fn get_topic_types(&mut self, _: Arguments<'_>) -> MethodResult {
        let pairs = self.topic_types.iter();
        let pairs = pairs.map(|(topic, topic_type)| pair(topic, topic_type));
        let message = "current system state".to_owned();
        Ok((1, message, Value::Array(pairs.collect())))
    }

    pub(crate) fn get_system_state(&mut self, _: Arguments<'_>) -> MethodResult {
        let shared = |kind| {
            let keys = self.registry.shared(kind).iter();
            let keys = keys.map(|(key, callers)| {
                Value::Array(vec![key.as_str().into(), strings(callers.iter().cloned())])
            });
            Value::Array(keys.collect())
        };
        let services = self.registry.services.iter().map(|(service, entry)| {
            let provider = strings([entry.node.clone()]);
            Value::Array(vec![service.as_str().into(), provider])
        });
        let state = vec![
            shared(SharedRegistration::Publishers),
            shared(SharedRegistration::Subscribers),
            Value::Array(services.collect()),
        ];
        Ok((1, "current system state".to_owned(), Value::Array(state)))
    }

    pub(crate) fn get_param(&mut self, of: Arguments<'_>) -> MethodResult {
        let [key] = of.params()?;
        let key = names::resolve(checks::key(key)?, of.caller_id);
        Ok(match self.params.get(&key) {
            Some(value) => (1, format!("Parameter [{key}]"), value),
            None => (-1, format!("Parameter [{key}] is not set"), 0.into()),
        })
    }

    pub(crate) fn has_param(&mut self, of: Arguments<'_>) -> MethodResult {
        let [key] = of.params()?;
        let key = names::resolve(checks::key(key)?, of.caller_id);
        let has = self.params.has(&key);
        Ok((1, key.into_owned(), has.into()))
    }

    pub(crate) fn search_param(&mut self, of: Arguments<'_>) -> MethodResult {
        let [key] = of.params()?;
        let key = checks::key(key)?;
        Ok(match self.params.search(of.caller_id, key)? {
            Some(found) => (1, format!("Found [{found}]"), found.into()),
            None => {
                let text = format!("Cannot find parameter [{key}] in an upwards search");
                (-1, text, "".into())
            }
        })
    }

    pub(crate) fn get_param_names(&mut self, _: Arguments<'_>) -> MethodResult {
        Ok((
            1,
            "Parameter names".to_owned(),
            strings(self.params.names()),
        ))
    }

    /// Queues a `publisherUpdate` with the topic's publishers for each subscriber, and returns the addresses of the
    /// subscribers.
    fn notify_publishers(&self, topic: &str, notices: &mut dyn NoticeSink) -> Vec<String> {
        let subscribers = self.registry.apis(SharedRegistration::Subscribers, topic);
        if !subscribers.is_empty() {
            let publishers = self.registry.apis(SharedRegistration::Publishers, topic);
            notices.publisher_update(&subscribers, topic, &publishers);
        }
        subscribers
    }
}

fn pair(topic: &str, topic_type: &str) -> Value {
    vec![topic, topic_type].into()
}

impl Master {
    /// Queues a `shutdown` for the node at the address `bumped`, if any, because another node has registered with the
    /// same name `by`.
    fn notify_bumped(&self, by: &str, bumped: Option<String>, notices: &mut dyn NoticeSink) {
        if let Some(to) = bumped {
            notices.shutdown(&to, &super::tell::bump_reason(by, self.old == Some(true)));
        }
    }
}
