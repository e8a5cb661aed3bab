//! A call, parsed once: its method, its parameters, and the entries of a multicall.

use std::borrow::Cow;

use super::{Kind, Method};
use crate::xmlrpc::{self, Call, DecodeError, Python, Value};

/// A number of parameters that is too many for every method: one more than any method takes.
const TOO_MANY: usize = 5;

/// A call to a master, parsed once.
///
/// ```
/// use ros1_master::master::{Kind, Method, Request};
///
/// let body = b"<methodCall><methodName>setParam</methodName><params>\
///     <param><value>/node</value></param><param><value>/gain</value></param>\
///     <param><value><int>3</int></value></param></params></methodCall>";
/// let request = Request::decode(body)?;
/// assert_eq!(request.method(), &Method::SetParam);
/// assert_eq!(request.caller(), Some("/node"));
/// assert_eq!(request.kind(), Kind::Mutate);
/// # Ok::<(), ros1_master::xmlrpc::DecodeError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Request {
    method: Method,
    /// Empty for a multicall, which has entries instead.
    params: Vec<Value>,
    entries: Vec<Entry>,
}

/// One entry of a multicall.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Entry {
    /// An entry that can be run.
    Request(Request),
    /// An entry that is answered with a fault. This is the fault's text.
    Refused(&'static str),
    /// An entry that makes the whole multicall fail with a fault, after the previous entries have run. It is always the
    /// last entry of its multicall.
    Malformed(Malformed),
}

/// Why a multicall fails as a whole.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Malformed {
    /// It does not have exactly one parameter.
    Arity,
    /// Its parameter is of this Python type, which has no elements.
    NoList(&'static str),
    /// An entry is of this Python type, which has no members.
    NoStruct(&'static str),
    /// An entry lacks this member.
    Lacks(&'static str),
}

impl Malformed {
    /// The text of the fault with which a master on this version of Python answers. For [`Self::Arity`] it is not
    /// rosmaster's.
    pub(crate) fn fault(self, python: Python) -> String {
        let two = python.is_two();
        python.fault(match self {
            Self::Arity => "system.multicall takes one list".to_owned(),
            Self::Lacks(member) => format!("<class 'KeyError'>:'{member}'"),
            Self::NoList("Binary" | "DateTime") if two => {
                "<class 'TypeError'>:iteration over non-sequence".to_owned()
            }
            Self::NoList(is_a) => format!("<class 'TypeError'>:'{is_a}' object is not iterable"),
            Self::NoStruct("str") => {
                let not = match python {
                    _ if two => ", not str",
                    _ if python >= Python::new(3, 11, 0) => ", not 'str'",
                    _ => "",
                };
                format!("<class 'TypeError'>:string indices must be integers{not}")
            }
            Self::NoStruct("list") => {
                let or = if two { "" } else { " or slices" };
                format!("<class 'TypeError'>:list indices must be integers{or}, not str")
            }
            Self::NoStruct(is_a @ ("Binary" | "DateTime")) if two => {
                format!("<class 'AttributeError'>:{is_a} instance has no attribute '__getitem__'")
            }
            Self::NoStruct(is_a) if two => {
                format!("<class 'TypeError'>:'{is_a}' object has no attribute '__getitem__'")
            }
            Self::NoStruct(is_a) => {
                format!("<class 'TypeError'>:'{is_a}' object is not subscriptable")
            }
        })
    }
}

impl Request {
    /// Creates a call of `method`, which must not be a multicall.
    pub fn new(method: Method, params: impl IntoIterator<Item = impl Into<Value>>) -> Self {
        Self {
            method,
            params: params.into_iter().map(Into::into).collect(),
            entries: Vec::new(),
        }
    }

    /// Creates a `system.multicall` of `requests`, in order.
    pub fn multicall(requests: impl IntoIterator<Item = Self>) -> Self {
        Self::of_entries(requests.into_iter().map(Entry::Request).collect())
    }

    /// Creates a `system.multicall` with these entries.
    pub fn of_entries(entries: Vec<Entry>) -> Self {
        Self {
            method: Method::Multicall,
            params: Vec::new(),
            entries,
        }
    }

    /// Decodes and parses the body of a call.
    ///
    /// # Errors
    ///
    /// The errors of [`xmlrpc::decode_call`].
    pub fn decode(body: &[u8]) -> Result<Self, DecodeError> {
        xmlrpc::decode_call(body).map(Self::from)
    }

    /// Decodes and parses the body of a call as a master on this version of Python does.
    ///
    /// # Errors
    ///
    /// The errors of [`xmlrpc::decode_call`].
    pub fn decode_for(body: &[u8], python: Python) -> Result<Self, DecodeError> {
        xmlrpc::decode_call_for(body, python).map(Self::from)
    }

    /// Encodes the call as the body of a request, like [`xmlrpc::encode_call`].
    pub fn encode(&self) -> Vec<u8> {
        xmlrpc::encode_call_of(self.method.name(), &self.wire_params())
    }

    /// Recurses once per nested multicall. [`xmlrpc::MAX_DEPTH`] limits that for decoded calls.
    fn parse(method: Method, params: Vec<Value>) -> Self {
        let (params, entries) = match method {
            Method::Multicall => (Vec::new(), entries(params)),
            _ => (params, Vec::new()),
        };
        Self {
            method,
            params,
            entries,
        }
    }

    pub fn method(&self) -> &Method {
        &self.method
    }

    /// The parameters, caller id first. Empty for a multicall.
    pub fn params(&self) -> &[Value] {
        &self.params
    }

    /// The parameters as they are sent. Those of a multicall are one list of its entries; an entry that cannot be run is
    /// nil.
    pub fn wire_params(&self) -> Cow<'_, [Value]> {
        match self.method {
            Method::Multicall => Cow::Owned(self.clone().into_wire_params()),
            _ => Cow::Borrowed(&self.params),
        }
    }

    fn into_wire_params(self) -> Vec<Value> {
        if self.method != Method::Multicall {
            return self.params;
        }
        let entries = self.entries.into_iter().map(|entry| match entry {
            Entry::Request(request) => request.into_entry(),
            Entry::Refused(_) | Entry::Malformed(_) => Value::Nil,
        });
        vec![Value::Array(entries.collect())]
    }

    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    pub fn into_entries(self) -> Vec<Entry> {
        self.entries
    }

    pub fn caller(&self) -> Option<&str> {
        self.text(0)
    }

    pub fn text(&self, index: usize) -> Option<&str> {
        self.params.get(index)?.as_str()
    }

    /// Only this call if it is no multicall. For a multicall, all calls in it, in order, including those of nested
    /// multicalls.
    pub fn calls(&self) -> Vec<&Self> {
        fn collect<'a>(request: &'a Request, found: &mut Vec<&'a Request>) {
            if request.method != Method::Multicall {
                found.push(request);
            }
            for entry in &request.entries {
                if let Entry::Request(request) = entry {
                    collect(request, found);
                }
            }
        }
        let mut found = Vec::with_capacity(self.entries.len().max(1));
        collect(self, &mut found);
        found
    }

    /// Whether this multicall, or one within it, ends at a malformed entry. Its answer does not show which of its calls ran.
    pub fn ends_early(&self) -> bool {
        self.entries.iter().any(|entry| match entry {
            Entry::Request(request) => request.ends_early(),
            Entry::Malformed(_) => true,
            Entry::Refused(_) => false,
        })
    }

    /// Whether this call, or one within it, unregisters something or deletes a parameter. If it runs twice, the second
    /// answer says that there was nothing to remove.
    pub fn removes(&self) -> bool {
        let removes =
            |call: &Self| call.method == Method::DeleteParam || call.kind() == Kind::Unregister;
        self.calls().into_iter().any(removes)
    }

    pub fn kind(&self) -> Kind {
        if self.method != Method::Multicall {
            return self.method.kind();
        }
        let kinds = self.entries.iter().enumerate();
        let kinds = kinds.map(|(index, entry)| match entry {
            Entry::Request(request) => request.kind(),
            // The entries before a malformed one have run, and the reply does not show their results.
            Entry::Malformed(_) if index > 0 => Kind::Mutate,
            Entry::Refused(_) | Entry::Malformed(_) => Kind::Unknown,
        });
        kinds.reduce(Kind::join).unwrap_or(Kind::Read)
    }

    /// Whether [`Master`](super::Master) can answer this call in place of rosmaster, because only one answer is
    /// possible. It cannot answer `shutdown`, or a call whose error text depends on the Python version, or
    /// `param_update_task`, which rosmaster exports by accident and which has an effect.
    pub fn is_answerable(&self) -> bool {
        match &self.method {
            Method::Multicall => self.entries.iter().all(|entry| match entry {
                Entry::Request(request) => request.is_answerable(),
                Entry::Refused(_) => false,
                Entry::Malformed(malformed) => *malformed != Malformed::Arity,
            }),
            // rosmaster refuses a `shutdown` that does not have exactly two parameters, or whose caller id is not a
            // string.
            Method::Shutdown => self.params.len() != 2 || self.caller().is_none(),
            Method::Unknown(name) => **name != *"param_update_task",
            _ => true,
        }
    }

    /// Converts this call to an encoded entry of a multicall.
    pub fn into_entry(self) -> Value {
        let method = self.method.name().to_owned();
        Call::new(method, self.into_wire_params()).into_entry()
    }
}

impl From<Call> for Request {
    fn from(call: Call) -> Self {
        Self::parse(Method::named(&call.method), call.params)
    }
}

/// The entries of a multicall with these parameters, up to and including the first malformed one.
fn entries(params: Vec<Value>) -> Vec<Entry> {
    let Ok([list]) = <[Value; 1]>::try_from(params) else {
        return vec![Entry::Malformed(Malformed::Arity)];
    };
    let is_a = list.python_type();
    let Some(list) = items(list) else {
        return vec![Entry::Malformed(Malformed::NoList(is_a))];
    };
    let mut entries = Vec::with_capacity(list.len());
    for element in list {
        entries.push(Entry::parse(element));
        if let Some(Entry::Malformed(_)) = entries.last() {
            break;
        }
    }
    entries
}

impl Entry {
    fn parse(element: Value) -> Self {
        let mut members = match element {
            Value::Struct(members) => members,
            other => return Self::Malformed(Malformed::NoStruct(other.python_type())),
        };
        let Some(name) = members.swap_remove("methodName") else {
            return Self::Malformed(Malformed::Lacks("methodName"));
        };
        let Some(params) = members.swap_remove("params") else {
            return Self::Malformed(Malformed::Lacks("params"));
        };
        let Value::String(name) = name else {
            return Self::Refused("the method name of an entry is not a string");
        };
        let Some(params) = items(params) else {
            return Self::Refused("the params of an entry are not a list");
        };
        Self::Request(Request::parse(Method::named(&name), params))
    }
}

/// The elements that Python finds when it iterates over a value: the characters of a string, or the keys of a struct.
/// Returns only as many as the outcome of the call depends on. `None` if Python cannot iterate over the value.
fn items(value: Value) -> Option<Vec<Value>> {
    match value {
        Value::Array(elements) => Some(elements),
        Value::Struct(members) => {
            let keys = members.into_iter().map(|(key, _)| key).take(TOO_MANY);
            Some(keys.map(Value::String).collect())
        }
        Value::String(text) => {
            let characters = text.chars().take(TOO_MANY);
            Some(characters.map(|c| Value::String(c.into())).collect())
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::xmlrpc::Struct;

    fn call(method: &str) -> Request {
        Request::from(Call::new(method, vec!["/n".into()]))
    }

    fn kind_of(methods: &[&str]) -> Kind {
        Request::multicall(methods.iter().map(|method| call(method))).kind()
    }

    fn multicall(list: Vec<Value>) -> Request {
        Request::from(Call::new("system.multicall", vec![Value::Array(list)]))
    }

    #[test]
    fn the_kind_of_a_multicall_covers_all_its_entries() {
        assert_eq!(kind_of(&[]), Kind::Read);
        assert_eq!(kind_of(&["getPid"]), Kind::Identity);
        assert_eq!(kind_of(&["getPid", "getParam"]), Kind::Read);
        assert_eq!(
            kind_of(&["getParam", "unregisterPublisher"]),
            Kind::Unregister
        );
        assert_eq!(kind_of(&["getParam", "nonsense"]), Kind::Unknown);
        assert_eq!(kind_of(&["unregisterService", "nonsense"]), Kind::Mutate);
        assert_eq!(kind_of(&["unregisterService", "setParam"]), Kind::Mutate);
        assert_eq!(
            kind_of(&["setParam", "shutdown", "nonsense"]),
            Kind::Shutdown
        );
        let inner = Request::multicall([call("subscribeParam")]);
        let nested = Request::multicall([inner, call("getPid")]);
        assert_eq!(nested.kind(), Kind::Mutate);
    }

    #[test]
    fn calls_that_only_a_master_can_answer_are_recognised() {
        for method in ["registerService", "getPid", "unsubscribeParam"] {
            assert!(call(method).is_answerable(), "{method}");
        }
        for method in ["nonsense", "system.listMethods", "shutdown", "uri"] {
            // A `shutdown` without a reason is refused.
            assert!(call(method).is_answerable(), "{method}");
        }
        let shutdown = Request::new(Method::Shutdown, ["/n", "reason"]);
        for call in [shutdown, call("param_update_task")] {
            assert!(!call.is_answerable(), "{call:?}");
            let inner = Request::multicall([self::call("setParam"), call]);
            assert!(!Request::multicall([inner]).is_answerable());
        }
        let inner = Request::multicall([call("setParam"), call("getParam")]);
        assert!(Request::multicall([inner]).is_answerable());
        assert!(multicall(vec![Value::Int(1)]).is_answerable());
        assert!(multicall(vec!["text".into()]).is_answerable());
        let no_list = Request::from(Call::new("system.multicall", vec![]));
        assert!(!no_list.is_answerable());
        let set = |value: Value| Request::new(Method::SetParam, ["/n".into(), "/a".into(), value]);
        assert!(set(vec![Value::Nil].into()).is_answerable());
    }

    /// Measured with Python 2.7.11, 3.10.4 and 3.11.2.
    #[test]
    fn a_malformed_multicall_is_refused_in_the_words_of_each_python() {
        let fault = |list: Value, version: (u32, u32)| {
            let call = Request::from(Call::new("system.multicall", vec![list]));
            let mut master = super::super::Master::default();
            master.set_python(Python::new(version.0, version.1, 0));
            match master.apply(&call).reply {
                xmlrpc::Reply::Fault { text, .. } => text,
                xmlrpc::Reply::Value(value) => format!("{value:?}"),
            }
        };
        let of = |entry: Value| Value::Array(vec![entry]);
        for (list, python, text) in [
            (
                of("x".into()),
                (2, 7),
                "<type 'exceptions.TypeError'>:string indices must be integers, not str",
            ),
            (
                of("x".into()),
                (3, 10),
                "<class 'TypeError'>:string indices must be integers",
            ),
            (
                of("x".into()),
                (3, 11),
                "<class 'TypeError'>:string indices must be integers, not 'str'",
            ),
            (
                of(1.into()),
                (2, 7),
                "<type 'exceptions.TypeError'>:'int' object has no attribute '__getitem__'",
            ),
            (
                of(1.into()),
                (3, 8),
                "<class 'TypeError'>:'int' object is not subscriptable",
            ),
            (
                of(of(1.into())),
                (2, 7),
                "<type 'exceptions.TypeError'>:list indices must be integers, not str",
            ),
            (
                of(of(1.into())),
                (3, 8),
                "<class 'TypeError'>:list indices must be integers or slices, not str",
            ),
            (
                of(Value::Base64(vec![])),
                (2, 7),
                "<type 'exceptions.AttributeError'>:Binary instance has no attribute '__getitem__'",
            ),
            (
                of(Value::Struct(Struct::new())),
                (2, 7),
                "<type 'exceptions.KeyError'>:'methodName'",
            ),
            (
                1.into(),
                (2, 7),
                "<type 'exceptions.TypeError'>:'int' object is not iterable",
            ),
            (
                Value::DateTime("x".into()),
                (2, 7),
                "<type 'exceptions.TypeError'>:iteration over non-sequence",
            ),
        ] {
            assert_eq!(fault(list.clone(), python), text, "{list:?} {python:?}");
        }
    }

    #[test]
    fn a_multicall_that_fails_after_some_entries_may_have_changed_the_state() {
        let good = call("getPid").into_entry();
        let kind = |list| multicall(list).kind();
        assert_eq!(kind(vec![Value::Int(1), good.clone()]), Kind::Unknown);
        assert_eq!(kind(vec![good, Value::Int(1)]), Kind::Mutate);
        let empty = Request::from(Call::new("system.multicall", vec![]));
        assert_eq!(empty.kind(), Kind::Unknown);
    }

    #[test]
    fn a_nested_multicall_is_parsed_completely_and_encoded_unchanged() {
        let nest =
            |levels| (0..levels).fold(call("setParam"), |inner, _| Request::multicall([inner]));
        let received = |call: &Request| Request::decode(&call.encode());
        // Each multicall takes three levels of a document.
        let deepest = xmlrpc::MAX_DEPTH / 3;
        assert_eq!(received(&nest(deepest)), Ok(nest(deepest)));
        let deeper = received(&nest(deepest + 1));
        assert!(matches!(deeper, Err(DecodeError::TooDeep { .. })));
        let calls = nest(3);
        assert_eq!(calls.calls(), [&call("setParam")]);
    }

    #[test]
    fn a_long_text_in_place_of_a_list_is_not_expanded_completely() {
        let text = Value::String("x".repeat(1 << 20));
        let list = Request::from(Call::new("system.multicall", vec![text.clone()]));
        assert!(matches!(list.entries(), [Entry::Malformed(_)]));
        let members = [("methodName", "getParam".into()), ("params", text)];
        let entry = Struct::from(members.map(|(key, value)| (key.to_owned(), value)));
        let one = multicall(vec![Value::Struct(entry)]);
        assert_eq!(one.calls()[0].params().len(), TOO_MANY);
    }
}
