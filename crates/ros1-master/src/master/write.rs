//! The writes of the Master API: the calls that change the state, with their arguments by name.

use std::borrow::Cow;

use super::api::{Arguments, Failure};
use super::{Request, checks, names};
use crate::xmlrpc::Value;

/// A write that the master does not refuse because of its arguments. Only this type knows which argument means what.
///
/// ```
/// use ros1_master::master::{Effect, Method, Request, Write};
///
/// let call = Request::new(Method::RegisterPublisher, ["/arm/talker", "chatter", "std_msgs/String", "http://arm:1/"]);
/// let write = Write::parse(&call).unwrap();
/// assert!(matches!(&write.effect, Effect::RegisterPublisher { topic, .. } if topic == "/arm/chatter"));
/// assert_eq!(write.registrant(), Some(("/arm/talker", "http://arm:1/")));
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Write<'a> {
    /// The calling node. The master takes this name as it comes, without resolving it.
    pub caller: &'a str,
    pub effect: Effect<'a>,
}

/// What a write does. Names of topics, services and parameters are resolved; all else is as the caller sent it.
#[derive(Clone, Debug, PartialEq)]
pub enum Effect<'a> {
    RegisterPublisher {
        topic: Cow<'a, str>,
        topic_type: &'a str,
        api: &'a str,
    },
    RegisterSubscriber {
        topic: Cow<'a, str>,
        topic_type: &'a str,
        api: &'a str,
    },
    RegisterService {
        service: Cow<'a, str>,
        service_api: &'a str,
        api: &'a str,
    },
    UnregisterPublisher {
        topic: Cow<'a, str>,
        api: &'a str,
    },
    UnregisterSubscriber {
        topic: Cow<'a, str>,
        api: &'a str,
    },
    UnregisterService {
        service: Cow<'a, str>,
        service_api: &'a str,
    },
    SubscribeParam {
        key: Cow<'a, str>,
        api: &'a str,
    },
    UnsubscribeParam {
        key: Cow<'a, str>,
        api: &'a str,
    },
    SetParam {
        key: Cow<'a, str>,
        value: &'a Value,
    },
    DeleteParam {
        key: Cow<'a, str>,
    },
}

/// What a write registers, unregisters, sets or deletes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum WriteTarget {
    Publisher,
    Subscriber,
    Service,
    /// A subscription to a parameter.
    ParamSubscriber,
    Parameter,
}

impl<'a> Write<'a> {
    /// The write that `call` makes. `None` for a multicall, for a call that changes nothing, and for a call that every
    /// master refuses because of its arguments.
    pub fn parse(call: &'a Request) -> Option<Self> {
        let (caller, rest) = call.params().split_first()?;
        let caller = caller.as_str()?;
        let decode = call.method().decoder()?;
        let arguments = Arguments {
            caller_id: caller,
            rest,
        };
        let effect = decode(arguments).ok()?;
        Some(Self { caller, effect })
    }

    /// The writes in `call`, in order: those of its entries if it is a multicall.
    pub fn all(call: &'a Request) -> impl Iterator<Item = Self> {
        call.calls().into_iter().filter_map(Self::parse)
    }

    /// The resolved name of the topic, service or parameter.
    pub fn name(&self) -> &str {
        match &self.effect {
            Effect::RegisterPublisher { topic, .. }
            | Effect::RegisterSubscriber { topic, .. }
            | Effect::UnregisterPublisher { topic, .. }
            | Effect::UnregisterSubscriber { topic, .. } => topic,
            Effect::RegisterService { service, .. } | Effect::UnregisterService { service, .. } => {
                service
            }
            Effect::SubscribeParam { key, .. }
            | Effect::UnsubscribeParam { key, .. }
            | Effect::SetParam { key, .. }
            | Effect::DeleteParam { key } => key,
        }
    }

    /// Name and address of the node for which this write registers something. If the name is registered at another
    /// address, the node there is told to shut down.
    pub fn registrant(&self) -> Option<(&'a str, &'a str)> {
        match self.effect {
            Effect::RegisterPublisher { api, .. }
            | Effect::RegisterSubscriber { api, .. }
            | Effect::RegisterService { api, .. }
            | Effect::SubscribeParam { api, .. } => Some((self.caller, api)),
            Effect::UnregisterPublisher { .. }
            | Effect::UnregisterSubscriber { .. }
            | Effect::UnregisterService { .. }
            | Effect::UnsubscribeParam { .. }
            | Effect::SetParam { .. }
            | Effect::DeleteParam { .. } => None,
        }
    }

    /// The address that is registered or unregistered: for a service its own, else that of the node.
    pub fn address(&self) -> Option<&'a str> {
        match self.effect {
            Effect::RegisterPublisher { api, .. }
            | Effect::RegisterSubscriber { api, .. }
            | Effect::UnregisterPublisher { api, .. }
            | Effect::UnregisterSubscriber { api, .. }
            | Effect::SubscribeParam { api, .. }
            | Effect::UnsubscribeParam { api, .. } => Some(api),
            Effect::RegisterService { service_api, .. }
            | Effect::UnregisterService { service_api, .. } => Some(service_api),
            Effect::SetParam { .. } | Effect::DeleteParam { .. } => None,
        }
    }

    pub fn target(&self) -> WriteTarget {
        match self.effect {
            Effect::RegisterPublisher { .. } | Effect::UnregisterPublisher { .. } => {
                WriteTarget::Publisher
            }
            Effect::RegisterSubscriber { .. } | Effect::UnregisterSubscriber { .. } => {
                WriteTarget::Subscriber
            }
            Effect::RegisterService { .. } | Effect::UnregisterService { .. } => {
                WriteTarget::Service
            }
            Effect::SubscribeParam { .. } | Effect::UnsubscribeParam { .. } => {
                WriteTarget::ParamSubscriber
            }
            Effect::SetParam { .. } | Effect::DeleteParam { .. } => WriteTarget::Parameter,
        }
    }

    /// The resolved name of the parameter that this write sets or deletes.
    pub fn parameter(&self) -> Option<&str> {
        (self.target() == WriteTarget::Parameter).then(|| self.name())
    }

    /// The value to which this write sets a parameter.
    pub fn value(&self) -> Option<&'a Value> {
        match self.effect {
            Effect::SetParam { value, .. } => Some(value),
            Effect::RegisterPublisher { .. }
            | Effect::RegisterSubscriber { .. }
            | Effect::RegisterService { .. }
            | Effect::UnregisterPublisher { .. }
            | Effect::UnregisterSubscriber { .. }
            | Effect::UnregisterService { .. }
            | Effect::SubscribeParam { .. }
            | Effect::UnsubscribeParam { .. }
            | Effect::DeleteParam { .. } => None,
        }
    }

    /// Whether this write unregisters something.
    pub fn unregisters(&self) -> bool {
        self.target() != WriteTarget::Parameter && self.registrant().is_none()
    }
}

// The decoders check arguments in rosmaster's order.

pub(super) fn register_publisher<'a>(of: Arguments<'a>) -> Result<Effect<'a>, Failure> {
    let (topic, topic_type, api) = topic_arguments(of)?;
    Ok(Effect::RegisterPublisher {
        topic,
        topic_type,
        api,
    })
}

pub(super) fn register_subscriber<'a>(of: Arguments<'a>) -> Result<Effect<'a>, Failure> {
    let (topic, topic_type, api) = topic_arguments(of)?;
    Ok(Effect::RegisterSubscriber {
        topic,
        topic_type,
        api,
    })
}

pub(super) fn register_service<'a>(of: Arguments<'a>) -> Result<Effect<'a>, Failure> {
    let [service, service_api, api] = of.params()?;
    Ok(Effect::RegisterService {
        service: checks::resource("service", service, of.caller_id)?,
        service_api: checks::api("service_api", service_api)?,
        api: checks::api("caller_api", api)?,
    })
}

pub(super) fn unregister_publisher<'a>(of: Arguments<'a>) -> Result<Effect<'a>, Failure> {
    let [topic, api] = of.params()?;
    Ok(Effect::UnregisterPublisher {
        topic: checks::resource("topic", topic, of.caller_id)?,
        api: checks::api("caller_api", api)?,
    })
}

pub(super) fn unregister_subscriber<'a>(of: Arguments<'a>) -> Result<Effect<'a>, Failure> {
    let [topic, api] = of.params()?;
    Ok(Effect::UnregisterSubscriber {
        topic: checks::resource("topic", topic, of.caller_id)?,
        api: checks::api("caller_api", api)?,
    })
}

pub(super) fn unregister_service<'a>(of: Arguments<'a>) -> Result<Effect<'a>, Failure> {
    let [service, service_api] = of.params()?;
    Ok(Effect::UnregisterService {
        service: checks::resource("service", service, of.caller_id)?,
        service_api: checks::api("service_api", service_api)?,
    })
}

pub(super) fn subscribe_param<'a>(of: Arguments<'a>) -> Result<Effect<'a>, Failure> {
    let [api, key] = of.params()?;
    let api = checks::api("caller_api", api)?;
    let key = names::resolve(checks::key(key)?, of.caller_id);
    Ok(Effect::SubscribeParam { key, api })
}

pub(super) fn unsubscribe_param<'a>(of: Arguments<'a>) -> Result<Effect<'a>, Failure> {
    let [api, key] = of.params()?;
    let api = checks::api("caller_api", api)?;
    let key = names::resolve(checks::key(key)?, of.caller_id);
    Ok(Effect::UnsubscribeParam { key, api })
}

pub(super) fn set_param<'a>(of: Arguments<'a>) -> Result<Effect<'a>, Failure> {
    let [key, value] = of.params()?;
    Ok(Effect::SetParam {
        key: names::resolve(checks::key(key)?, of.caller_id),
        value: checks::param_value(value)?,
    })
}

pub(super) fn delete_param<'a>(of: Arguments<'a>) -> Result<Effect<'a>, Failure> {
    let [key] = of.params()?;
    let key = names::resolve(checks::key(key)?, of.caller_id);
    Ok(Effect::DeleteParam { key })
}

fn topic_arguments<'a>(of: Arguments<'a>) -> Result<(Cow<'a, str>, &'a str, &'a str), Failure> {
    let [topic, topic_type, api] = of.params()?;
    Ok((
        checks::resource("topic", topic, of.caller_id)?,
        checks::topic_type(topic_type)?,
        checks::api("caller_api", api)?,
    ))
}
