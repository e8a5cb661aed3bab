//! Checks the parameters of calls as `rosmaster/validators.py` does, with the same error messages.

use std::borrow::Cow;

use super::api::Failure;
use super::names;
use crate::xmlrpc::Value;

type Checked<T> = Result<T, Failure>;

fn refuse<T>(what: &str, complaint: &str) -> Checked<T> {
    Err(Failure::Refused(format!(
        "ERROR: parameter [{what}] {complaint}"
    )))
}

/// rosmaster's `non_empty_str('key')`.
pub(crate) fn key(value: &Value) -> Checked<&str> {
    match value.as_str() {
        Some(text) if !text.is_empty() => Ok(text),
        None if !is_falsy(value) => refuse("key", "must be a string"),
        _ => refuse("key", "must be specified and non-empty"),
    }
}

/// Whether Python treats a value that is not a string as false.
fn is_falsy(value: &Value) -> bool {
    match value {
        Value::Nil | Value::Bool(false) | Value::Int(0) => true,
        Value::Double(number) => *number == 0.0,
        Value::BigDecimal(text) => !text.contains(|c: char| matches!(c, '1'..='9')),
        Value::Array(elements) => elements.is_empty(),
        Value::Struct(members) => members.is_empty(),
        _ => false,
    }
}

/// rosmaster's `not_none('value')`.
pub(crate) fn param_value(value: &Value) -> Checked<&Value> {
    match value {
        Value::Nil => refuse("value", "must be specified"),
        _ => Ok(value),
    }
}

/// rosmaster's `is_api`.
pub(crate) fn api<'a>(what: &str, value: &'a Value) -> Checked<&'a str> {
    match value.as_str() {
        None | Some("") => refuse(what, "is not an XMLRPC URI"),
        Some(text) if text.starts_with("http://") || text.starts_with("rosrpc://") => Ok(text),
        Some(_) => refuse(what, "is not an RPC URI"),
    }
}

/// rosmaster's `valid_name`.
pub(crate) fn name<'a>(what: &str, value: &'a Value, caller_id: &str) -> Checked<Cow<'a, str>> {
    match value.as_str() {
        None | Some("") => refuse(what, "must be a non-empty string"),
        Some(text) if names::has_illegal_chars(text) => refuse(what, "contains illegal chars"),
        Some(text) => Ok(names::resolve(text, caller_id)),
    }
}

/// rosmaster's `is_topic` and `is_service`.
pub(crate) fn resource<'a>(what: &str, value: &'a Value, caller_id: &str) -> Checked<Cow<'a, str>> {
    let resolved = name(what, value, caller_id)?;
    match value.as_str() {
        Some("/") => refuse(what, "cannot be the global namespace"),
        _ => Ok(resolved),
    }
}

/// rosmaster's `valid_type_name('topic_type')`. rosmaster also accepts a date whose text is `*`, and keeps the date.
/// This function returns the date's text instead.
pub(crate) fn topic_type(value: &Value) -> Checked<&str> {
    match value {
        Value::DateTime(text) | Value::String(text) if text == "*" => Ok(text),
        Value::String(text) if text.matches('/').count() == 1 => Ok(text),
        Value::String(text) if !text.is_empty() => {
            refuse("topic_type", "is not a valid package resource name")
        }
        _ => refuse("topic_type", "must be a non-empty string"),
    }
}

/// rosmaster's `empty_or_valid_name('subgraph')`.
pub(crate) fn subgraph(value: &Value, caller_id: &str) -> Checked<String> {
    match value.as_str() {
        None => refuse("subgraph", "must be a string"),
        Some("") => Ok(String::new()),
        Some(text) => Ok(names::resolve(text, caller_id).into_owned()),
    }
}
