//! Converts YAML to values.
//!
//! This module reads the events of serde-saphyr's parser and does not use serde, because serde's data model lacks
//! scalar styles, tags, and integers beyond 64 bits, which distinguish the values. The module accepts only what `emit`
//! writes: no anchors, no aliases, no other tags. So no text can expand to more than its own length. No function
//! recurses.

use std::borrow::Cow;

use serde_saphyr::granit_parser::{self, Event, Parser, ScalarStyle, Tag};

use super::DEPTH_MAX;
use super::emit::{BIG_DECIMAL, BIG_INT, DATE_TIME, date_time};
use ros1_master::xmlrpc::{Struct, Value};

const TAG_PREFIX: &str = "tag:yaml.org,2002:";

/// A collection that has not been read completely.
enum Open {
    Array {
        elements: Vec<Value>,
        pairs: bool,
    },
    Struct {
        members: Struct,
        key: Option<String>,
    },
}

pub(super) fn read(text: &str) -> Result<Value, String> {
    // The document adds a few levels around the deepest value.
    let nesting = DEPTH_MAX + 8;
    let options = granit_parser::options! {
        emit_comments: false,
        disallow_directives: true,
        flow_nesting_limit: nesting,
        block_nesting_limit: nesting,
    };
    let mut open: Vec<Open> = Vec::new();
    let mut whole = None;
    for event in Parser::new_from_str_with_options(text, options) {
        let (event, span) = event.map_err(|error| error.to_string())?;
        let at = |why: &str| format!("{why} in line {}", span.start.line());
        let done = match event {
            Event::Scalar(text, style, 0, tag) => {
                scalar(text, style, tag.as_deref()).ok_or_else(|| at("an unknown scalar"))?
            }
            Event::SequenceStart(_, 0, tag) => {
                let pairs = match tag.as_deref().map(suffix) {
                    None => false,
                    Some(Some("pairs")) => true,
                    Some(_) => return Err(at("an unknown tag")),
                };
                open.push(Open::Array {
                    elements: Vec::new(),
                    pairs,
                });
                continue;
            }
            Event::MappingStart(_, 0, None) => {
                open.push(Open::Struct {
                    members: Struct::new(),
                    key: None,
                });
                continue;
            }
            Event::SequenceEnd | Event::MappingEnd => match open.pop() {
                Some(Open::Array {
                    elements,
                    pairs: false,
                }) => Value::Array(elements),
                Some(Open::Array {
                    elements,
                    pairs: true,
                }) => pair(elements).ok_or_else(|| at("unknown pairs"))?,
                Some(Open::Struct { members, key: None }) => Value::Struct(members),
                _ => return Err(at("a key without a value")),
            },
            Event::StreamStart
            | Event::StreamEnd
            | Event::DocumentStart(false, None)
            | Event::DocumentEnd => continue,
            _ => return Err(at("an unexpected element")),
        };
        match open.last_mut() {
            Some(Open::Array { elements, .. }) => elements.push(done),
            Some(Open::Struct { members, key }) => match key.take() {
                None => match done {
                    Value::String(name) => *key = Some(name),
                    _ => return Err(at("a key that is not a text")),
                },
                Some(name) => {
                    if members.insert(name, done).is_some() {
                        return Err(at("a value for a key that is there twice"));
                    }
                }
            },
            None if whole.is_none() => whole = Some(done),
            None => return Err(at("a second document")),
        }
    }
    whole.ok_or_else(|| "nothing there".to_owned())
}

fn suffix(tag: &Tag) -> Option<&str> {
    let (handle, suffix) = tag.parts();
    (handle == TAG_PREFIX).then_some(suffix)
}

fn scalar(text: Cow<'_, str>, style: ScalarStyle, tag: Option<&Tag>) -> Option<Value> {
    match (style, tag.map(suffix)) {
        (ScalarStyle::DoubleQuoted, None) => Some(Value::String(text.into_owned())),
        (ScalarStyle::DoubleQuoted, Some(Some("binary"))) => {
            use base64::Engine as _;
            base64::engine::general_purpose::STANDARD
                .decode(text.as_bytes())
                .ok()
                .map(Value::Base64)
        }
        (ScalarStyle::DoubleQuoted, Some(Some("timestamp"))) => {
            date_time(&text).map(Value::DateTime)
        }
        (ScalarStyle::Plain, None) => plain(&text),
        _ => None,
    }
}

fn plain(text: &str) -> Option<Value> {
    Some(match text {
        // The parser reports `~` for a key without a value. In a checkpoint that is `journal:`, whose lines are read
        // separately.
        "null" | "~" => Value::Nil,
        "true" => Value::Bool(true),
        "false" => Value::Bool(false),
        ".nan" => Value::Double(f64::NAN),
        ".inf" => Value::Double(f64::INFINITY),
        "-.inf" => Value::Double(f64::NEG_INFINITY),
        _ => {
            let magnitude = text.strip_prefix('-').unwrap_or(text);
            let first = magnitude.bytes().next()?;
            if first.is_ascii_digit() && magnitude.bytes().all(|byte| byte.is_ascii_digit()) {
                text.parse()
                    .map_or_else(|_| Value::BigInt(text.to_owned()), Value::Int)
            } else if first.is_ascii_digit() && magnitude.contains('.') {
                Value::Double(text.parse().ok()?)
            } else if first.is_ascii_lowercase() && text == magnitude {
                // Only the document's own keys are unquoted words.
                Value::String(text.to_owned())
            } else {
                return None;
            }
        }
    })
}

fn pair(elements: Vec<Value>) -> Option<Value> {
    let [Value::Struct(members)] = <[Value; 1]>::try_from(elements).ok()? else {
        return None;
    };
    let (kind, Value::String(text)) = members.into_iter().next()? else {
        return None;
    };
    match kind.as_str() {
        DATE_TIME => Some(Value::DateTime(text)),
        BIG_INT => Some(Value::BigInt(text)),
        BIG_DECIMAL => Some(Value::BigDecimal(text)),
        _ => None,
    }
}
