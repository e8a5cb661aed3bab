//! `system.multicall`, as in CPython's `xmlrpc.server`.

use super::api::fault;
use super::{Entry, Kind, Master, Method, NoticeSink, Request, names};
use crate::xmlrpc::{Reply, Struct, Value};

impl Master {
    /// Runs a whole multicall. Returns its value, or the text of its fault.
    pub(crate) fn run_multicall(
        &mut self,
        entries: &[Entry],
        notices: &mut dyn NoticeSink,
    ) -> Result<Value, String> {
        let result = self.run_entries(entries, notices, &mut Vec::new());
        let watched = self.params.take_watched();
        let mut result = result?;
        for (at, value) in watched {
            if let Some(element) = element_at(&mut result, &at) {
                *element = value;
            }
        }
        Ok(result)
    }

    fn run_entries(
        &mut self,
        entries: &[Entry],
        notices: &mut dyn NoticeSink,
        at: &mut Vec<usize>,
    ) -> Result<Value, String> {
        let mut results = Vec::with_capacity(entries.len());
        for (index, entry) in entries.iter().enumerate() {
            // The result of entry `index` is a list with one element.
            at.extend([index, 0]);
            let depth = at.len();
            let result = match entry {
                Entry::Malformed(malformed) => return Err(malformed.fault(self.python)),
                Entry::Refused(text) => Err((*text).to_owned()),
                Entry::Request(request) if *request.method() == Method::Multicall => {
                    self.run_entries(request.entries(), notices, at)
                }
                Entry::Request(request) => {
                    let result = self.dispatch(request, notices);
                    self.watch(request, result.as_ref().ok(), at);
                    result
                }
            };
            at.truncate(depth - 2);
            results.push(match result {
                Ok(value) => Value::Array(vec![value]),
                Err(text) => fault_entry(text),
            });
        }
        Ok(Value::Array(results))
    }

    /// Whether the answers to all reads of a multicall fit into about `most` bytes of memory. Creates each answer and
    /// drops it again. A call that is not a multicall always fits.
    pub fn fits(&mut self, request: &Request, mut most: usize) -> bool {
        if *request.method() != Method::Multicall {
            return true;
        }
        let mut calls = request.calls().into_iter();
        calls.all(|call| {
            if !matches!(call.kind(), Kind::Read | Kind::Identity) {
                return true;
            }
            let answer = self.dispatch(call, &mut ());
            let rest = most.checked_sub(answer.as_ref().map_or(0, Value::size));
            most = rest.unwrap_or_default();
            rest.is_some()
        })
    }

    /// Notes where the result contains a dict of the parameter tree itself, because later entries may still change that
    /// dict.
    fn watch(&mut self, request: &Request, result: Option<&Value>, at: &[usize]) {
        let (key, subscribes) = match request.method() {
            Method::GetParam => (request.text(1), false),
            Method::SubscribeParam => (request.text(2), true),
            _ => return,
        };
        let (Some(Value::Array(answer)), Some(key), Some(caller_id)) =
            (result, key, request.caller())
        else {
            return;
        };
        let [Value::Int(1), _, Value::Struct(_)] = answer.as_slice() else {
            return;
        };
        let mut key = names::resolve(key, caller_id).into_owned();
        if subscribes {
            key = names::param_key(&key);
        }
        // For a key that is not set, `subscribeParam` returns a new dict, which is not part of the tree.
        if self.params.has(&key) {
            let at = at.iter().copied().chain([2]).collect();
            self.params.watch(&key, at);
        }
    }
}

fn element_at<'a>(value: &'a mut Value, at: &[usize]) -> Option<&'a mut Value> {
    at.iter().try_fold(value, |value, index| match value {
        Value::Array(elements) => elements.get_mut(*index),
        _ => None,
    })
}

/// Converts a fault to an entry of a multicall's result.
fn fault_entry(text: String) -> Value {
    Value::Struct(Struct::from([
        ("faultCode".to_owned(), 1.into()),
        ("faultString".to_owned(), text.into()),
    ]))
}

/// Converts a reply to an entry of a multicall's result.
pub fn reply_entry(reply: Reply) -> Value {
    match reply {
        Reply::Value(value) => Value::Array(vec![value]),
        Reply::Fault { text, .. } => fault_entry(text),
    }
}

/// The reply that an entry of a multicall's result contains.
pub fn entry_reply(result: &Value) -> Option<Reply> {
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
