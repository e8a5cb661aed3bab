//! `system.multicall`, which CPython's `xmlrpc.server` brings along.

use std::borrow::Cow;

use super::api::{self, fault, unsupported};
use super::{Kind, Master, NoticeSink, python};
use crate::xmlrpc::{Call, Reply, Struct, Value};

/// The name of the method.
pub(crate) const METHOD: &str = "system.multicall";

/// Multicalls within multicalls that Python's recursion limit allows, and no more than our stack does.
pub(crate) const DEEPEST: usize = 480;

/// More parameters than any method takes.
const TOO_MANY: usize = 5;

/// One entry of a multicall.
pub(crate) enum Entry<'a> {
    /// Something that is run.
    Call {
        method: &'a str,
        params: Cow<'a, [Value]>,
    },
    /// Something that gets a fault of its own.
    Refused(String),
    /// Something that ends the whole multicall with a fault. What came before it has run.
    Malformed(String),
}

/// The entries of a multicall with these parameters, or the fault if there are none to find. Of what is
/// iterable and no list only the first: no item of that is an entry, and the first ends the multicall.
pub(crate) fn entries(params: &[Value]) -> Result<Cow<'_, [Value]>, String> {
    match params {
        [] => Err("<class 'TypeError'>:SimpleXMLRPCDispatcher.system_multicall() missing 1 required positional argument: 'call_list'".to_owned()),
        [list] => python::items(list, 1).ok_or_else(|| {
            format!("<class 'TypeError'>:'{}' object is not iterable", python::type_name(list))
        }),
        more => Err(too_many(more.len())),
    }
}

/// The fault for a multicall with this number of parameters.
fn too_many(count: usize) -> String {
    format!(
        "<class 'TypeError'>:SimpleXMLRPCDispatcher.system_multicall() takes 2 positional arguments but {} were given",
        count + 1
    )
}

impl<'a> Entry<'a> {
    /// What the dispatcher makes of an element of the list.
    pub(crate) fn new(element: &'a Value) -> Self {
        let Some(members) = element.as_struct() else {
            return Self::Malformed(format!(
                "<class 'TypeError'>:{}",
                python::subscript_error(element)
            ));
        };
        let (Some(name), Some(params)) = (members.get("methodName"), members.get("params")) else {
            let missing = if members.contains_key("methodName") {
                "params"
            } else {
                "methodName"
            };
            return Self::Malformed(format!("<class 'KeyError'>:'{missing}'"));
        };
        let Value::String(method) = name else {
            return Self::Refused(match python::text(name) {
                Some(text) => format!("<class 'Exception'>:method \"{text}\" is not supported"),
                None => format!(
                    "<class 'TypeError'>:unhashable type: '{}'",
                    python::type_name(name)
                ),
            });
        };
        let count = python::count(params);
        match python::items(params, TOO_MANY) {
            // What a method of the Master API says to too many is the same for any number.
            Some(params) if params.len() == count || api::method(method).is_some() => {
                Self::Call { method, params }
            }
            Some(_) if method == METHOD => Self::Refused(too_many(count)),
            Some(_) => Self::Refused(unsupported(method, count)),
            None => Self::Refused(not_iterable(method, params)),
        }
    }
}

/// The fault of parameters that are no list.
fn not_iterable(name: &str, params: &Value) -> String {
    let function = if name == METHOD {
        "xmlrpc.server.SimpleXMLRPCDispatcher.system_multicall()"
    } else if api::method(name).is_some() {
        "rosmaster.master_api.apivalidate.<locals>.check_validates.<locals>.validated_f()"
    } else if name == "param_update_task" {
        "rosmaster.master_api.ROSMasterHandler.param_update_task()"
    } else {
        return unsupported(name, 0);
    };
    format!(
        "<class 'TypeError'>:{function} argument after * must be an iterable, not {}",
        python::type_name(params)
    )
}

impl Master {
    /// Runs a whole multicall: what it returns, or the text of its fault.
    pub(crate) fn run_multicall(
        &mut self,
        params: &[Value],
        notices: &mut dyn NoticeSink,
    ) -> Result<Value, String> {
        let result = self.run_entries(params, notices, &mut Vec::new());
        let watched = self.params.take_watched();
        let mut result = result?;
        for (at, value) in watched {
            if let Some(place) = place(&mut result, &at) {
                *place = value;
            }
        }
        Ok(result)
    }

    fn run_entries(
        &mut self,
        params: &[Value],
        notices: &mut dyn NoticeSink,
        at: &mut Vec<usize>,
    ) -> Result<Value, String> {
        let entries = entries(params)?;
        let mut results = Vec::with_capacity(entries.len());
        for (index, element) in entries.iter().enumerate() {
            // The result of entry `index` is the only element of a list.
            at.extend([index, 0]);
            let result = match Entry::new(element) {
                Entry::Malformed(text) => return Err(text),
                Entry::Refused(text) => Err(text),
                Entry::Call { method, .. } if method == METHOD && at.len() / 2 > DEEPEST => {
                    Err("<class 'RecursionError'>:maximum recursion depth exceeded".to_owned())
                }
                Entry::Call { method, params } if method == METHOD => {
                    let depth = at.len();
                    let result = self.run_entries(&params, notices, at);
                    at.truncate(depth);
                    result
                }
                Entry::Call { method, params } => {
                    let result = self.dispatch(method, &params, notices);
                    self.watch(method, &params, result.as_ref().ok(), at);
                    result
                }
            };
            at.truncate(at.len().saturating_sub(2));
            results.push(match result {
                Ok(value) => Value::Array(vec![value]),
                Err(text) => fault_entry(text),
            });
        }
        Ok(Value::Array(results))
    }

    /// Whether all that the reads in a multicall answer takes no more than `most` bytes of memory, about.
    /// Each answer is made and dropped. What is no multicall fits always.
    pub fn fits(&mut self, call: &Call, mut most: usize) -> bool {
        call.method != METHOD || self.spend(&call.params, DEEPEST, &mut most)
    }

    fn spend(&mut self, params: &[Value], levels: usize, left: &mut usize) -> bool {
        let (Ok(entries), Some(levels)) = (entries(params), levels.checked_sub(1)) else {
            return true;
        };
        entries.iter().all(|element| {
            let Entry::Call { method, params } = Entry::new(element) else {
                return true;
            };
            if method == METHOD {
                return self.spend(&params, levels, left);
            }
            let kind = api::method(method).map(|method| method.kind);
            if !matches!(kind, Some(Kind::Read | Kind::Identity)) {
                return true;
            }
            let answer = self.dispatch(method, &params, &mut ());
            let rest = left.checked_sub(answer.as_ref().map_or(0, python::size));
            *left = rest.unwrap_or_default();
            rest.is_some()
        })
    }

    /// Remembers where a dict of the parameter tree is part of the result.
    fn watch(&mut self, method: &str, params: &[Value], result: Option<&Value>, at: &[usize]) {
        let (key, subscribes) = match (method, params) {
            ("getParam", [_, key]) => (key, false),
            ("subscribeParam", [_, _, key]) => (key, true),
            _ => return,
        };
        let (Some(Value::Array(answer)), Some(key)) = (result, key.as_str()) else {
            return;
        };
        let ([Value::Int(1), _, Value::Struct(_)], Some(caller_id)) =
            (answer.as_slice(), params.first().and_then(Value::as_str))
        else {
            return;
        };
        let mut key = super::names::resolve(key, caller_id);
        if subscribes {
            key = super::names::param_key(&key);
        }
        // A subscription to what is not set gets a dict of its own.
        if self.params.has(&key) {
            let at = at.iter().copied().chain([2]).collect();
            self.params.watch(&key, at);
        }
    }
}

fn place<'a>(value: &'a mut Value, at: &[usize]) -> Option<&'a mut Value> {
    at.iter().try_fold(value, |value, index| match value {
        Value::Array(elements) => elements.get_mut(*index),
        _ => None,
    })
}

/// A fault as an entry of a multicall's result.
fn fault_entry(text: String) -> Value {
    Value::Struct(Struct::from([
        ("faultCode".to_owned(), 1.into()),
        ("faultString".to_owned(), text.into()),
    ]))
}

/// A reply as an entry of a multicall's result.
pub(crate) fn reply_entry(reply: Reply) -> Value {
    match reply {
        Reply::Value(value) => Value::Array(vec![value]),
        Reply::Fault { text, .. } => fault_entry(text),
    }
}

/// The reply that an entry of a multicall's result stands for.
pub(crate) fn entry_reply(result: &Value) -> Option<Reply> {
    match result {
        Value::Array(only) => match only.as_slice() {
            [value] => Some(Reply::Value(value.clone())),
            _ => None,
        },
        Value::Struct(members) => {
            let text = members.get("faultString")?.as_str()?;
            Some(match members.get("faultCode")?.as_int()? {
                1 => fault(text),
                code => Reply::Fault {
                    code,
                    text: text.to_owned(),
                },
            })
        }
        _ => None,
    }
}
