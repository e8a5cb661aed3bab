//! Decodes text as CPython's `xmlrpc.client.Unmarshaller` under expat does.
//!
//! That unmarshaller is a stack machine: it handles tags one by one and hardly checks their nesting. Clients
//! depend on that leniency, so this is the same machine.

use std::borrow::Cow;

use super::error::{DecodeError, NO_METHOD, NOTHING, TEXT_MOST};
use super::number;
use super::prolog::text_of;
use super::scan::{Event, LineEnds, Scanner};
use super::value::{Call, Reply, Struct, Value};

/// Most levels of nested arrays and structs.
///
/// rosmaster accepts any depth (measured: 20,000), but returns at most 492 levels, its own `[code, message,
/// value]` included; for anything deeper it answers a fault. So this limit keeps everything that can be read
/// back, and bounds recursion over values, their drop included.
pub const MAX_DEPTH: usize = 512;

/// Most open elements. A level takes three (`value`, `struct`, `member` or `value`, `array`, `data`). The
/// rest is for the frame, and for clients that nest a little more.
const MAX_OPEN: usize = 4 * MAX_DEPTH;

/// Decodes a request.
///
/// ```
/// use ros1_master::xmlrpc::{Value, decode_call};
///
/// let call = decode_call(
///     b"<methodCall><methodName>getPid</methodName>\
///       <params><param><value>/me</value></param></params></methodCall>",
/// )?;
/// assert_eq!((call.method.as_str(), call.params), ("getPid", vec![Value::from("/me")]));
/// # Ok::<(), ros1_master::xmlrpc::DecodeError>(())
/// ```
///
/// # Errors
///
/// Where CPython raises, and in the few cases listed at [`DecodeError`].
pub fn decode_call(body: &[u8]) -> Result<Call, DecodeError> {
    let wanted = "call";
    let document = unmarshal(body, wanted, Writer::Any)?;
    if document.is_fault {
        let what = "it is a fault";
        return Err(DecodeError::Shape { wanted, what });
    }
    let Some(method) = document.method else {
        let what = NO_METHOD;
        return Err(DecodeError::Shape { wanted, what });
    };
    Ok(Call::new(method, document.values))
}

/// Decodes an answer as CPython's server meant it. That server does not escape a carriage return, which XML
/// reads as a line feed, nor a date's text, in which XML would find references. So neither is interpreted
/// here, and a master's values are read unchanged.
///
/// # Errors
///
/// Where CPython raises, if there is not exactly one value, and in the few cases listed at [`DecodeError`].
pub fn decode_reply(body: &[u8]) -> Result<Reply, DecodeError> {
    let wanted = "reply";
    let document = unmarshal(body, wanted, Writer::Python)?;
    let mut values = document.values.into_iter();
    let (Some(value), None) = (values.next(), values.next()) else {
        let what = "it does not hold one value";
        return Err(DecodeError::Shape { wanted, what });
    };
    if !document.is_fault {
        return Ok(Reply::Value(value));
    }
    let members = value.as_struct();
    let member = |name| members.and_then(|members| members.get(name));
    match (member("faultCode"), member("faultString")) {
        (Some(Value::Int(code)), Some(Value::String(text)))
            if members.map(|members| members.len()) == Some(2) =>
        {
            let (code, text) = (*code, text.clone());
            Ok(Reply::Fault { code, text })
        }
        (Some(_), Some(_)) => {
            let what = "a fault with more than a number and a text";
            let at = body.len();
            Err(DecodeError::Unsupported { at, what })
        }
        _ => {
            let what = "its fault lacks faultCode or faultString";
            Err(DecodeError::Shape { wanted, what })
        }
    }
}

/// The machine's result.
struct Document {
    values: Vec<Value>,
    method: Option<String>,
    is_fault: bool,
}

/// Who wrote a document.
#[derive(Clone, Copy, Default, PartialEq, Eq)]
enum Writer {
    /// Any XML writer.
    #[default]
    Any,
    /// CPython's server: it does not escape carriage returns and dates.
    Python,
}

fn unmarshal(body: &[u8], wanted: &'static str, writer: Writer) -> Result<Document, DecodeError> {
    let text = text_of(body)?;
    let line_ends = match writer {
        Writer::Any => LineEnds::Normal,
        Writer::Python => LineEnds::Kept,
    };
    let mut scanner = Scanner::new(&text, MAX_OPEN, line_ends);
    let mut machine = Unmarshaller {
        writer,
        ..Unmarshaller::default()
    };
    while let Some(event) = scanner.next()? {
        match event {
            Event::Start(tag) => machine.start(tag.name().0, scanner.at())?,
            Event::End(tag) => machine.end(tag.name().0, scanner.at())?,
            // Mostly there is one piece, which is borrowed when added to an empty text.
            Event::Text(piece) => machine.text += piece,
            Event::Reference(reference, _) if machine.is_unescaped => {
                machine.text += "&";
                machine.text += reference.into_inner();
                machine.text += ";";
            }
            Event::Reference(_, character) => machine.text += character,
        }
    }
    let Some(kind) = machine.kind else {
        let what = NOTHING;
        return Err(DecodeError::Shape { wanted, what });
    };
    Ok(Document {
        values: machine.stack,
        method: machine.method,
        is_fault: kind == Kind::Fault,
    })
}

/// The last of these elements; it decides for CPython.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Kind {
    Call,
    Fault,
}

/// The elements that CPython's unmarshaller knows; it ignores all others.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Tag {
    Value,
    Text,
    Int,
    Boolean,
    Double,
    Nil,
    DateTime,
    Base64,
    BigDecimal,
    Array,
    Struct,
    Params,
    Fault,
    MethodName,
}

impl Tag {
    /// The element of this name, prefix removed.
    fn named(name: &str) -> Option<Self> {
        Some(match name {
            "value" => Self::Value,
            "string" | "name" => Self::Text,
            "i1" | "i2" | "i4" | "i8" | "int" | "biginteger" => Self::Int,
            "boolean" => Self::Boolean,
            "double" | "float" => Self::Double,
            "nil" => Self::Nil,
            "dateTime.iso8601" => Self::DateTime,
            "base64" => Self::Base64,
            "bigdecimal" => Self::BigDecimal,
            "array" => Self::Array,
            "struct" => Self::Struct,
            "params" => Self::Params,
            "fault" => Self::Fault,
            "methodName" => Self::MethodName,
            _ => return None,
        })
    }
}

/// The name without its prefix.
fn local(name: &str) -> &str {
    name.rsplit_once(':').map_or(name, |(_, local)| local)
}

#[derive(Default)]
struct Unmarshaller<'a> {
    kind: Option<Kind>,
    method: Option<String>,
    stack: Vec<Value>,
    /// Length of the stack at the start of each open array and struct.
    marks: Vec<usize>,
    /// Character data since the last start tag.
    text: Cow<'a, str>,
    /// A `<value>` is open without an element in it: an untyped string so far.
    is_bare: bool,
    writer: Writer,
    /// References are text, because the writer does not escape this element's content.
    is_unescaped: bool,
}

impl Unmarshaller<'_> {
    fn start(&mut self, name: &str, at: usize) -> Result<(), DecodeError> {
        let name = local(name);
        let tag = Tag::named(name);
        if matches!(tag, Some(Tag::Array | Tag::Struct)) {
            if self.marks.len() >= MAX_DEPTH {
                let limit = MAX_DEPTH;
                return Err(DecodeError::TooDeep { at, limit });
            }
            self.marks.push(self.stack.len());
        }
        self.text = Cow::Borrowed("");
        self.is_unescaped = self.writer == Writer::Python && tag == Some(Tag::DateTime);
        if self.is_bare && tag.is_none() {
            let tag = name.to_owned();
            return Err(DecodeError::UnknownType { at, tag });
        }
        self.is_bare = tag == Some(Tag::Value);
        Ok(())
    }

    fn end(&mut self, name: &str, at: usize) -> Result<(), DecodeError> {
        let Some(tag) = Tag::named(local(name)) else {
            return Ok(());
        };
        let value = match tag {
            Tag::Value if self.is_bare => Value::String(self.text.to_string()),
            Tag::Value => return Ok(()),
            Tag::Params => {
                self.kind = Some(Kind::Call);
                return Ok(());
            }
            Tag::Fault => {
                self.kind = Some(Kind::Fault);
                return Ok(());
            }
            Tag::MethodName => {
                self.kind = Some(Kind::Call);
                self.method = Some(self.text.to_string());
                return Ok(());
            }
            Tag::Array => {
                let mark = self.marks.pop().unwrap_or_default();
                Value::Array(self.stack.split_off(mark))
            }
            Tag::Struct => self.end_struct(at)?,
            _ => scalar(tag, &self.text, at)?,
        };
        self.stack.push(value);
        self.is_bare = false;
        Ok(())
    }

    /// Names and values alternate on the stack.
    fn end_struct(&mut self, at: usize) -> Result<Value, DecodeError> {
        let mark = self.marks.pop().unwrap_or_default();
        let mut members = Struct::with_capacity((self.stack.len() - mark) / 2);
        let mut items = self.stack.drain(mark..);
        while let Some(name) = items.next() {
            let Value::String(name) = name else {
                let what = "a struct with a name that is no string";
                return Err(DecodeError::Unsupported { at, what });
            };
            let Some(value) = items.next() else {
                let tag = "struct";
                return Err(bad_text(tag, &name, at));
            };
            // A repeated name keeps its place and takes the new value, as in a dict.
            members.insert(name, value);
        }
        Ok(Value::Struct(members))
    }
}

/// The value of a leaf with this text.
fn scalar(tag: Tag, text: &str, at: usize) -> Result<Value, DecodeError> {
    let (value, tag) = match tag {
        Tag::Text => return Ok(Value::String(text.to_owned())),
        Tag::DateTime => return Ok(Value::DateTime(text.trim().to_owned())),
        Tag::Nil => return Ok(Value::Nil),
        Tag::Boolean => {
            let value = match text {
                "0" => Some(Value::Bool(false)),
                "1" => Some(Value::Bool(true)),
                _ => None,
            };
            (value, "boolean")
        }
        Tag::Base64 if text.is_ascii() => (number::base64_bytes(text).map(Value::Base64), "base64"),
        Tag::Int | Tag::Double if !text.is_ascii() => {
            let what = "a number beyond ASCII";
            return Err(DecodeError::Unsupported { at, what });
        }
        Tag::Int => (number::int(text), "int"),
        Tag::Double => (number::float(text).map(Value::Double), "double"),
        Tag::BigDecimal => {
            let what = "a bigdecimal";
            return Err(DecodeError::Unsupported { at, what });
        }
        _ => (None, "base64"),
    };
    value.ok_or_else(|| bad_text(tag, text, at))
}

fn bad_text(tag: &'static str, text: &str, at: usize) -> DecodeError {
    let text = text.chars().take(TEXT_MOST).collect();
    DecodeError::BadText { at, tag, text }
}
