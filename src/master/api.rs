//! The Master API: `rosmaster/master_api.py`, and the dispatcher in front of it.

use super::{Kind, Master, Notice, NoticeSink, python};
use crate::xmlrpc::{Call, Reply, Value};

/// What a method returns: status code, message, value.
pub(crate) type Answer = Result<(i32, String, Value), Failure>;

/// Why a method ends early.
#[derive(Debug, PartialEq)]
pub(crate) enum Failure {
    /// A check refuses a parameter: the text is the message.
    Refused(String),
    /// A Python `TypeError`.
    Type(String),
    /// Any other Python exception.
    Internal(String),
}

/// One method of the Master API.
pub(crate) struct Method {
    name: &'static str,
    pub(crate) kind: Kind,
    /// Number of parameters, the caller id included.
    arity: usize,
    /// The value that goes with an error.
    error: fn() -> Value,
    run: fn(&mut Master, &str, &[Value], &mut dyn NoticeSink) -> Answer,
}

macro_rules! methods {
    ($($name:literal $kind:ident $arity:literal $error:expr => $run:ident;)*) => {
        &[$(Method { name: $name, kind: Kind::$kind, arity: $arity, error: || $error, run: Master::$run },)*]
    };
}

static METHODS: &[Method] = methods! {
    "registerPublisher" Mutate 4 list() => register_publisher;
    "registerSubscriber" Mutate 4 list() => register_subscriber;
    "registerService" Mutate 4 0.into() => register_service;
    "setParam" Mutate 3 0.into() => set_param;
    "getParam" Read 2 0.into() => get_param;
    "hasParam" Read 2 false.into() => has_param;
    "lookupService" Read 2 "".into() => lookup_service;
    "lookupNode" Read 2 "".into() => lookup_node;
    "unregisterPublisher" Unregister 3 0.into() => unregister_publisher;
    "unregisterSubscriber" Unregister 3 0.into() => unregister_subscriber;
    "unregisterService" Unregister 3 0.into() => unregister_service;
    "subscribeParam" Mutate 3 0.into() => subscribe_param;
    "unsubscribeParam" Unregister 3 0.into() => unsubscribe_param;
    "deleteParam" Mutate 2 0.into() => delete_param;
    "searchParam" Read 2 0.into() => search_param;
    "getParamNames" Read 1 list() => get_param_names;
    "getSystemState" Read 1 vec![list(), list(), list()].into() => get_system_state;
    "getPublishedTopics" Read 2 0.into() => get_published_topics;
    "getTopicTypes" Read 1 list() => get_topic_types;
    "getPid" Identity 1 (-1).into() => get_pid;
    "getUri" Identity 1 "".into() => get_uri;
    "shutdown" Shutdown 2 0.into() => shutdown;
};

/// Attributes of rosmaster's handler that can be named as a method, and their types.
const NOT_CALLABLE: &[(&str, &str)] = &[
    ("uri", "str"),
    ("done", "bool"),
    ("thread_pool", "MarkedThreadPool"),
    ("ps_lock", "Condition"),
    ("reg_manager", "RegistrationManager"),
    ("publishers", "Registrations"),
    ("subscribers", "Registrations"),
    ("services", "Registrations"),
    ("param_subscribers", "Registrations"),
    ("topics_types", "dict"),
    ("param_server", "ParamDictionary"),
];

const PARAM_UPDATE_TASK: [&str; 4] = ["caller_id", "caller_api", "param_key", "param_value"];

fn list() -> Value {
    Value::Array(Vec::new())
}

pub(crate) fn strings(texts: impl IntoIterator<Item = String>) -> Value {
    Value::Array(texts.into_iter().map(Value::String).collect())
}

/// The method of that name.
pub(crate) fn method(name: &str) -> Option<&'static Method> {
    METHODS.iter().find(|method| method.name == name)
}

/// What a call answers, and which callbacks the master sends because of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Applied {
    /// The answer.
    pub reply: Reply,
    /// The callbacks, in the order in which the master queues them. Those to one address are sent
    /// one after the other, those to different addresses at the same time.
    pub notices: Vec<Notice>,
}

impl Master {
    /// Answers `call` as rosmaster does, and changes as rosmaster does.
    ///
    /// Every method that can be called is answered: reads, refused parameters, `system.multicall`
    /// (nested and malformed too) and unknown methods. `shutdown` is answered and changes nothing.
    /// The one method whose answer depends on the network, `param_update_task` (a slip of
    /// rosmaster's), is answered as if its callback had been taken, and sends none.
    pub fn apply(&mut self, call: &Call) -> Applied {
        let mut notices = Vec::new();
        let reply = self.apply_telling(call, &mut notices);
        Applied { reply, notices }
    }

    /// Like [`Master::apply`], with the callbacks told to `notices`, which copies as much as it needs.
    pub fn apply_telling(&mut self, call: &Call, notices: &mut dyn NoticeSink) -> Reply {
        let reply = if call.method == super::multicall::METHOD {
            self.run_multicall(&call.params, notices)
        } else {
            self.dispatch(&call.method, &call.params, notices)
        };
        match reply {
            Ok(value) => match python::write_error(&value) {
                None => Reply::Value(value),
                Some(text) => fault(text),
            },
            Err(text) => fault(&text),
        }
    }

    /// `_dispatch` of anything but a multicall; an error is the text of a fault.
    pub(crate) fn dispatch(
        &mut self,
        name: &str,
        params: &[Value],
        notices: &mut dyn NoticeSink,
    ) -> Result<Value, String> {
        let Some(method) = method(name) else {
            return Err(unsupported(name, params.len()));
        };
        let (code, message, value) = match self.validate_and_run(method, params, notices) {
            Ok((_, _, Value::Nil)) => {
                let text = "Internal error (None value returned)".to_owned();
                (-1, text, (method.error)())
            }
            Ok(answer) => answer,
            Err(Failure::Refused(text)) => (-1, text, (method.error)()),
            Err(Failure::Type(text)) => (
                -1,
                format!("Error: invalid arguments: {text}"),
                (method.error)(),
            ),
            Err(Failure::Internal(text)) => {
                (0, format!("Internal failure: {text}"), (method.error)())
            }
        };
        Ok(Value::Array(vec![code.into(), message.into(), value]))
    }

    /// `apivalidate`.
    fn validate_and_run(
        &mut self,
        method: &Method,
        params: &[Value],
        notices: &mut dyn NoticeSink,
    ) -> Answer {
        let Some((caller_id, rest)) = params.split_first() else {
            return Err(Failure::Refused(
                "missing required caller_id parameter".to_owned(),
            ));
        };
        if params.len() != method.arity {
            return Err(bad_arity());
        }
        let Some(caller_id) = caller_id.as_str() else {
            return Err(Failure::Refused("caller_id must be a string".to_owned()));
        };
        (method.run)(self, caller_id, rest, notices)
    }
}

/// Whether a method was answered with code 1.
pub fn is_success(reply: &Reply) -> bool {
    matches!(reply, Reply::Value(Value::Array(answer)) if answer.first() == Some(&Value::Int(1)))
}

pub(crate) fn bad_arity() -> Failure {
    Failure::Refused("Error: bad call arity".to_owned())
}

pub(crate) fn fault(text: &str) -> Reply {
    Reply::Fault {
        code: 1,
        text: text.to_owned(),
    }
}

/// The fault of a name that is no method.
pub(crate) fn unsupported(name: &str, arity: usize) -> String {
    if let Some((_, kind)) = NOT_CALLABLE
        .iter()
        .find(|(attribute, _)| *attribute == name)
    {
        return format!("<class 'TypeError'>:'{kind}' object is not callable");
    }
    if name == "param_update_task" {
        let missing = PARAM_UPDATE_TASK.get(arity..).unwrap_or_default();
        return match missing {
            [] if arity == 4 => {
                "<class 'TypeError'>:cannot marshal None unless allow_none is enabled".to_owned()
            }
            [] => format!(
                "<class 'TypeError'>:ROSMasterHandler.param_update_task() takes 5 positional arguments but {} were given",
                arity + 1
            ),
            [one] => format!(
                "<class 'TypeError'>:ROSMasterHandler.param_update_task() missing 1 required positional argument: '{one}'"
            ),
            [first, second] => format!(
                "<class 'TypeError'>:ROSMasterHandler.param_update_task() missing 2 required positional arguments: '{first}' and '{second}'"
            ),
            [firsts @ .., last] => format!(
                "<class 'TypeError'>:ROSMasterHandler.param_update_task() missing {} required positional arguments: '{}', and '{last}'",
                missing.len(),
                firsts.join("', '")
            ),
        };
    }
    format!("<class 'Exception'>:method \"{name}\" is not supported")
}
