//! The methods of the Master API, and the dispatcher that runs them.

use std::fmt;

use super::{Effect, Entry, Kind, Master, Notice, NoticeSink, Request, returnable, write};
use crate::xmlrpc::{Reply, Value};

/// What a method returns: status code, message, value.
pub(crate) type MethodResult = Result<(i32, String, Value), Failure>;

/// Why a method ended early.
#[derive(Debug, PartialEq)]
pub(crate) enum Failure {
    /// A check refused a parameter. The text is the message of the answer.
    Refused(String),
    /// rosmaster raises a `TypeError`, which it answers with code -1. The text differs from rosmaster's.
    Type(&'static str),
    /// rosmaster takes a member of a date or of binary data. Python 3 raises a `TypeError`, and Python 2, where these
    /// are instances of old classes, an `AttributeError`. The text differs from rosmaster's.
    Instance(&'static str),
    /// rosmaster raises an exception other than `TypeError`, which it answers with code 0. The text differs from
    /// rosmaster's.
    Internal(&'static str),
}

/// The arguments of a method.
#[derive(Clone, Copy)]
pub(crate) struct Arguments<'a> {
    pub(crate) caller_id: &'a str,
    /// The parameters after the caller id.
    pub(crate) rest: &'a [Value],
}

impl<'a> Arguments<'a> {
    pub(crate) fn params<const N: usize>(&self) -> Result<&'a [Value; N], Failure> {
        self.rest.try_into().map_err(|_| bad_arity())
    }
}

/// Checks and names the arguments of a write.
pub(crate) type Decoder = for<'a> fn(Arguments<'a>) -> Result<Effect<'a>, Failure>;

/// How a method is run.
enum Run {
    /// The method changes nothing.
    Read(for<'a> fn(&mut Master, Arguments<'a>) -> MethodResult),
    /// The method does what its arguments are decoded to.
    Write(Decoder),
}

/// The properties of a Master API method.
struct Spec {
    kind: Kind,
    /// Number of parameters, the caller id included.
    arity: usize,
    /// The value of an answer that reports an error.
    error: fn() -> Value,
    run: Run,
}

const MULTICALL: &str = "system.multicall";

/// The public attributes of rosmaster's `ROSMasterHandler` with their Python types. rosmaster also tries to call an
/// attribute if a client uses its name as a method.
const ATTRIBUTES: [(&str, &str); 11] = [
    ("done", "bool"),
    ("param_server", "ParamDictionary"),
    ("param_subscribers", "Registrations"),
    ("ps_lock", "Condition"),
    ("publishers", "Registrations"),
    ("reg_manager", "RegistrationManager"),
    ("services", "Registrations"),
    ("subscribers", "Registrations"),
    ("thread_pool", "MarkedThreadPool"),
    ("topics_types", "dict"),
    ("uri", "str"),
];

macro_rules! methods {
    ($($method:ident $name:literal $kind:ident $arity:literal $error:expr => $run:expr;)*) => {
        /// A method of the Master API, or any other method that a client may call.
        #[derive(Clone, Debug, PartialEq, Eq, Hash)]
        pub enum Method {
            $(#[doc = concat!("`", $name, "`.")] $method,)*
            /// `system.multicall`, from CPython's `xmlrpc.server`.
            Multicall,
            /// Any method that rosmaster does not have.
            Unknown(Box<str>),
        }

        impl Method {
            pub fn named(name: &str) -> Self {
                match name {
                    $($name => Self::$method,)*
                    MULTICALL => Self::Multicall,
                    _ => Self::Unknown(name.into()),
                }
            }

            pub fn name(&self) -> &str {
                match self {
                    $(Self::$method => $name,)*
                    Self::Multicall => MULTICALL,
                    Self::Unknown(name) => name,
                }
            }

            fn spec(&self) -> Option<&'static Spec> {
                match self {
                    $(Self::$method => Some(const { &Spec {
                        kind: Kind::$kind,
                        arity: $arity,
                        error: || $error,
                        run: $run,
                    } }),)*
                    Self::Multicall | Self::Unknown(_) => None,
                }
            }
        }
    };
}

methods! {
    RegisterPublisher "registerPublisher" Mutate 4 list() => Run::Write(write::register_publisher);
    RegisterSubscriber "registerSubscriber" Mutate 4 list() => Run::Write(write::register_subscriber);
    RegisterService "registerService" Mutate 4 0.into() => Run::Write(write::register_service);
    SetParam "setParam" Mutate 3 0.into() => Run::Write(write::set_param);
    GetParam "getParam" Read 2 0.into() => Run::Read(Master::get_param);
    HasParam "hasParam" Read 2 false.into() => Run::Read(Master::has_param);
    LookupService "lookupService" Read 2 "".into() => Run::Read(Master::lookup_service);
    LookupNode "lookupNode" Read 2 "".into() => Run::Read(Master::lookup_node);
    UnregisterPublisher "unregisterPublisher" Unregister 3 0.into() => Run::Write(write::unregister_publisher);
    UnregisterSubscriber "unregisterSubscriber" Unregister 3 0.into() => Run::Write(write::unregister_subscriber);
    UnregisterService "unregisterService" Unregister 3 0.into() => Run::Write(write::unregister_service);
    SubscribeParam "subscribeParam" Mutate 3 0.into() => Run::Write(write::subscribe_param);
    UnsubscribeParam "unsubscribeParam" Unregister 3 0.into() => Run::Write(write::unsubscribe_param);
    DeleteParam "deleteParam" Mutate 2 0.into() => Run::Write(write::delete_param);
    SearchParam "searchParam" Read 2 0.into() => Run::Read(Master::search_param);
    GetParamNames "getParamNames" Read 1 list() => Run::Read(Master::get_param_names);
    GetSystemState "getSystemState" Read 1 vec![list(), list(), list()].into() => Run::Read(Master::get_system_state);
    GetPublishedTopics "getPublishedTopics" Read 2 0.into() => Run::Read(Master::get_published_topics);
    GetTopicTypes "getTopicTypes" Read 1 list() => Run::Read(Master::get_topic_types);
    GetPid "getPid" Identity 1 (-1).into() => Run::Read(Master::get_pid);
    GetUri "getUri" Identity 1 "".into() => Run::Read(Master::get_uri);
    Shutdown "shutdown" Shutdown 2 0.into() => Run::Read(Master::shutdown);
}

impl fmt::Display for Method {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl Method {
    /// The kind of this method. [`Kind::Unknown`] for a multicall, because the kind of a multicall depends on its
    /// entries.
    pub(crate) fn kind(&self) -> Kind {
        self.spec().map_or(Kind::Unknown, |spec| spec.kind)
    }

    /// The decoder of a write. `None` for a method that changes nothing, and for a multicall.
    pub(crate) fn decoder(&self) -> Option<Decoder> {
        match self.spec()?.run {
            Run::Read(_) => None,
            Run::Write(decode) => Some(decode),
        }
    }
}

fn list() -> Value {
    Value::Array(Vec::new())
}

pub(crate) fn strings(texts: impl IntoIterator<Item = String>) -> Value {
    Value::Array(texts.into_iter().map(Value::String).collect())
}

/// The answer to a call, and the callbacks that the master sends to nodes because of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Applied {
    pub reply: Reply,
    /// The callbacks, in the order in which the master queues them. rosmaster sends callbacks to one address one after
    /// the other, and callbacks to different addresses at the same time.
    pub notices: Vec<Notice>,
}

impl Master {
    /// Answers `request` and changes the state as rosmaster does. `shutdown` is answered but changes nothing. Only
    /// errors that come from an exception in rosmaster, such as a `deleteParam` below a number, have other texts.
    ///
    /// ```
    /// use ros1_master::master::{Master, Method, Notice, Request, is_success};
    ///
    /// let mut master = Master::default();
    /// let subscribe = ["/listener", "/chatter", "std_msgs/String", "http://robot:2/"];
    /// master.apply(&Request::new(Method::RegisterSubscriber, subscribe));
    /// let publish = ["/talker", "/chatter", "std_msgs/String", "http://robot:1/"];
    /// let applied = master.apply(&Request::new(Method::RegisterPublisher, publish));
    /// assert!(is_success(&applied.reply));
    /// // The master tells the subscriber.
    /// assert!(matches!(&applied.notices[..], [Notice::PublisherUpdate { to, .. }] if to == "http://robot:2/"));
    /// ```
    pub fn apply(&mut self, request: &Request) -> Applied {
        let mut notices = Vec::new();
        let reply = self.apply_telling(request, &mut notices);
        Applied { reply, notices }
    }

    /// Like [`Master::apply`], but passes the callbacks to `notices` instead of returning them. So `notices` can avoid
    /// copies.
    pub fn apply_telling(&mut self, request: &Request, notices: &mut dyn NoticeSink) -> Reply {
        let result = match request.method() {
            Method::Multicall => self.run_multicall(request.entries(), notices),
            _ => self.dispatch(request, notices),
        };
        match result {
            Ok(value) => match returnable::reply_error(&value) {
                None => Reply::Value(value),
                Some(text) => fault(&self.python.fault(text.to_owned())),
            },
            Err(text) => fault(&text),
        }
    }

    /// The result of a read, if rosmaster would give the same result byte for byte. `None` if rosmaster's result may
    /// differ, and for a call that is not a read.
    pub fn exact_answer(&mut self, read: &Request) -> Option<Value> {
        if self.is_inexact() {
            return None;
        }
        let Some(spec) = read.method().spec() else {
            let entries = read.entries().iter().map(|entry| match entry {
                Entry::Request(read) => Some(Value::Array(vec![self.exact_answer(read)?])),
                Entry::Refused(_) | Entry::Malformed(_) => None,
            });
            let is_multicall = *read.method() == Method::Multicall;
            let results = entries.collect::<Option<_>>().filter(|_| is_multicall)?;
            return Some(Value::Array(results));
        };
        if !matches!(spec.kind, Kind::Read | Kind::Identity) {
            return None;
        }
        let (code, message, value) = self
            .validate_and_run(spec, read.params(), &mut ())
            .ok()
            .filter(|(_, _, value)| *value != Value::Nil)?;
        // A node that only subscribes to parameters may have registered without rosrescue's knowledge. Only
        // `lookupNode` shows such a node.
        let hidden = *read.method() == Method::LookupNode && code != 1;
        let in_some_order = !self.python.keeps_order() && shows_order(read.method(), &value);
        (!hidden && !in_some_order).then(|| Value::Array(vec![code.into(), message.into(), value]))
    }

    /// Answers any call except a multicall. The error is the text of a fault.
    pub(crate) fn dispatch(
        &mut self,
        request: &Request,
        notices: &mut dyn NoticeSink,
    ) -> Result<Value, String> {
        let Some(spec) = request.method().spec() else {
            return Err(self.python.fault(unsupported(request.method().name())));
        };
        let old = self.old == Some(true);
        let error = || match request.method() {
            Method::RegisterPublisher | Method::RegisterSubscriber | Method::LookupService
                if old =>
            {
                0.into()
            }
            _ => (spec.error)(),
        };
        let (code, message, value) = match self.validate_and_run(spec, request.params(), notices) {
            Ok((_, _, Value::Nil)) => {
                let text = "Internal error (None value returned)".to_owned();
                (-1, text, error())
            }
            Ok(answer) => answer,
            Err(Failure::Refused(text)) => (-1, text, error()),
            Err(Failure::Instance(text)) if self.python.is_two() => {
                (0, format!("Internal failure: {text}"), error())
            }
            Err(Failure::Type(text) | Failure::Instance(text)) => {
                (-1, format!("Error: invalid arguments: {text}"), error())
            }
            Err(Failure::Internal(text)) => (0, format!("Internal failure: {text}"), error()),
        };
        Ok(Value::Array(vec![code.into(), message.into(), value]))
    }

    /// Checks the number of parameters and the caller id, then runs the method, like rosmaster's `apivalidate`.
    fn validate_and_run(
        &mut self,
        spec: &Spec,
        params: &[Value],
        notices: &mut dyn NoticeSink,
    ) -> MethodResult {
        let Some((caller_id, rest)) = params.split_first() else {
            return refused("missing required caller_id parameter");
        };
        if params.len() != spec.arity {
            return Err(bad_arity());
        }
        let Some(caller_id) = caller_id.as_str() else {
            return refused("caller_id must be a string");
        };
        let arguments = Arguments { caller_id, rest };
        match spec.run {
            Run::Read(answer) => answer(self, arguments),
            Run::Write(decode) => {
                let effect = decode(arguments)?;
                // A topic type that passes the check and is not a string is a date. rosmaster keeps the date; this
                // master keeps its text.
                self.inexact |= matches!(rest.get(1), Some(Value::DateTime(_)))
                    && matches!(
                        effect,
                        Effect::RegisterPublisher { .. } | Effect::RegisterSubscriber { .. }
                    );
                self.run(caller_id, effect, notices)
            }
        }
    }
}

/// Whether `reply` is an answer of the Master API with code 1, success.
pub fn is_success(reply: &Reply) -> bool {
    matches!(reply, Reply::Value(Value::Array(answer)) if answer.first() == Some(&Value::Int(1)))
}

/// The text of the fault with which rosmaster on Python 3 answers an unknown method `name`.
fn unsupported(name: &str) -> String {
    match ATTRIBUTES.iter().find(|(attribute, _)| *attribute == name) {
        None => format!("<class 'Exception'>:method \"{name}\" is not supported"),
        Some((_, is_a)) => format!("<class 'TypeError'>:'{is_a}' object is not callable"),
    }
}

fn refused(text: &str) -> MethodResult {
    Err(Failure::Refused(text.to_owned()))
}

fn bad_arity() -> Failure {
    Failure::Refused("Error: bad call arity".to_owned())
}

pub(crate) fn fault(text: &str) -> Reply {
    Reply::Fault {
        code: 1,
        text: text.to_owned(),
    }
}

/// Whether `value`, the result of the read `method`, shows the order of a dictionary's keys.
fn shows_order(method: &Method, value: &Value) -> bool {
    match (method, value) {
        (Method::GetSystemState, Value::Array(lists)) => {
            let is_long = |list: &Value| list.as_array().is_some_and(|list| list.len() > 1);
            lists.iter().any(is_long)
        }
        (Method::GetTopicTypes | Method::GetPublishedTopics | Method::GetParamNames, list) => {
            list.as_array().is_some_and(|list| list.len() > 1)
        }
        (_, value) => holds_order(value),
    }
}

fn holds_order(value: &Value) -> bool {
    match value {
        Value::Struct(members) => members.len() > 1 || members.values().any(holds_order),
        Value::Array(elements) => elements.iter().any(holds_order),
        _ => false,
    }
}
