//! Decodes XML-RPC as CPython's `xmlrpc.client.Unmarshaller` does with expat.
//!
//! That unmarshaller is a stack machine: it handles tags one by one and hardly checks how they nest. Clients
//! depend on this leniency, so this decoder is the same machine.

use std::borrow::Cow;

use super::error::{DecodeError, NO_METHOD, NOTHING, TEXT_CHARS_MAX};
use super::number;
use super::prolog::text_of;
use super::python::Python;
use super::scan::{Event, LineEnds, Scanner};
use super::value::{Call, Reply, Struct, Value};

/// Maximum nesting of arrays and structs.
///
/// rosmaster accepts any depth (20,000 levels were measured) but returns 492 levels at most, including its
/// own `[code, message, value]`; for anything deeper it answers a fault. So this limit keeps everything that
/// can be read back. It also bounds recursion over values, including when they are dropped.
pub const MAX_DEPTH: usize = 512;

/// Maximum number of open elements. One level takes three (`value`, `struct`, `member` or `value`, `array`, `data`).
/// The remaining elements are for the envelope and for clients that nest a little more.
const MAX_OPEN: usize = 4 * MAX_DEPTH;

/// Decodes a request as the default [`Python`] does.
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
/// Where CPython raises an exception, and in the few cases listed at [`DecodeError`].
pub fn decode_call(body: &[u8]) -> Result<Call, DecodeError> {
    decode_call_for(body, Python::default())
}

/// Decodes a request as this version of Python does. Python 2 knows fewer types.
///
/// # Errors
///
/// Those of [`decode_call`].
pub fn decode_call_for(body: &[u8], python: Python) -> Result<Call, DecodeError> {
    let wanted = "call";
    let document = unmarshal(body, wanted, Writer::Any, python)?;
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

/// Decodes an answer of CPython's server.
///
/// CPython's server escapes neither carriage returns nor the text of dates. An XML parser would turn a carriage return
/// into a line feed, and would find references in a date. This function keeps both as they are, so a master's values
/// arrive unchanged.
///
/// # Errors
///
/// Where CPython raises an exception, if there is not exactly one value, and in the few cases listed at
/// [`DecodeError`].
pub fn decode_reply(body: &[u8]) -> Result<Reply, DecodeError> {
    let wanted = "reply";
    let document = unmarshal(body, wanted, Writer::Python, Python::default())?;
    let mut values = document.values.into_iter();
    let (Some(value), None) = (values.next(), values.next()) else {
        let what = "it does not hold exactly one value";
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
            let what = "a fault that is not just a number and a text";
            let at = body.len();
            Err(DecodeError::Unsupported { at, what })
        }
        _ => {
            let what = "its fault lacks faultCode or faultString";
            Err(DecodeError::Shape { wanted, what })
        }
    }
}

/// The result of decoding a whole document.
struct Document {
    values: Vec<Value>,
    method: Option<String>,
    is_fault: bool,
}

/// The program that wrote a document.
#[derive(Clone, Copy, Default, PartialEq, Eq)]
enum Writer {
    /// Any XML writer.
    #[default]
    Any,
    /// CPython's server, which does not escape carriage returns and dates.
    Python,
}

fn unmarshal(
    body: &[u8],
    wanted: &'static str,
    writer: Writer,
    python: Python,
) -> Result<Document, DecodeError> {
    let text = text_of(body)?;
    let line_ends = match writer {
        Writer::Any => LineEnds::Normal,
        Writer::Python => LineEnds::Kept,
    };
    let mut scanner = Scanner::new(&text, MAX_OPEN, line_ends);
    let mut machine = Unmarshaller {
        writer,
        python,
        allowance: text.len(),
        ..Unmarshaller::default()
    };
    while let Some(event) = scanner.next()? {
        match event {
            Event::Start(tag) => machine.start(tag.name().0, scanner.at())?,
            Event::End(tag) => machine.end(tag.name().0, scanner.at())?,
            // Most texts have only one piece, and adding a piece to an empty text borrows it without a copy.
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

/// The kind of document. As in CPython, the last `params`, `fault` or `methodName` element decides.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Kind {
    Call,
    Fault,
}

/// The elements that CPython's unmarshaller knows. It ignores others.
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
    /// The element with this name, without its namespace prefix.
    fn named(name: &str, python: Python) -> Option<Self> {
        Some(match name {
            "i1" | "i2" | "biginteger" | "float" | "bigdecimal" if python.is_two() => return None,
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

/// Removes the namespace prefix from a name. Python 2 does not know prefixes.
fn local(name: &str, python: Python) -> &str {
    match name.rsplit_once(':') {
        Some((_, local)) if !python.is_two() => local,
        _ => name,
    }
}

#[derive(Default)]
struct Unmarshaller<'a> {
    kind: Option<Kind>,
    method: Option<String>,
    stack: Vec<Value>,
    /// Length of the stack when each open array or struct began.
    marks: Vec<usize>,
    /// Character data since the last start tag.
    text: Cow<'a, str>,
    /// Whether a `<value>` is open without an element in it so far. Then its text is an untyped string.
    is_bare: bool,
    writer: Writer,
    python: Python,
    /// Whether references in this element are plain text, because the writer does not escape its content.
    is_unescaped: bool,
    /// How many bytes of text the remaining elements may have. Only elements within each other that repeat one text can
    /// have more in total than the document. CPython's values share that text; here a small document would fill the
    /// memory.
    allowance: usize,
}

impl Unmarshaller<'_> {
    fn start(&mut self, name: &str, at: usize) -> Result<(), DecodeError> {
        let name = local(name, self.python);
        let tag = Tag::named(name, self.python);
        if matches!(tag, Some(Tag::Array | Tag::Struct)) {
            if self.marks.len() >= MAX_DEPTH {
                let limit = MAX_DEPTH;
                return Err(DecodeError::TooDeep { at, limit });
            }
            self.marks.push(self.stack.len());
        }
        self.text = Cow::Borrowed("");
        self.is_unescaped = self.writer == Writer::Python && tag == Some(Tag::DateTime);
        if self.is_bare && tag.is_none() && !self.python.ignores_unknown_types() {
            let tag = name.to_owned();
            return Err(DecodeError::UnknownType { at, tag });
        }
        self.is_bare = tag == Some(Tag::Value);
        Ok(())
    }

    fn end(&mut self, name: &str, at: usize) -> Result<(), DecodeError> {
        let Some(tag) = Tag::named(local(name, self.python), self.python) else {
            return Ok(());
        };
        let has_text = match tag {
            Tag::Value => self.is_bare,
            Tag::Params | Tag::Fault | Tag::Array | Tag::Struct => false,
            _ => true,
        };
        if has_text {
            let left = self.allowance.checked_sub(self.text.len());
            let what = "elements within each other that repeat a long text";
            self.allowance = left.ok_or(DecodeError::Unsupported { at, what })?;
        }
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
            _ => scalar(tag, &self.text, self.python, at)?,
        };
        self.stack.push(value);
        self.is_bare = false;
        Ok(())
    }

    /// Makes a struct of the names and values that the stack holds by turns.
    fn end_struct(&mut self, at: usize) -> Result<Value, DecodeError> {
        let mark = self.marks.pop().unwrap_or_default();
        let mut members = Struct::with_capacity((self.stack.len() - mark) / 2);
        let mut items = self.stack.drain(mark..);
        while let Some(name) = items.next() {
            let Value::String(name) = name else {
                let what = "a struct with a name that is not a string";
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

/// The value of a scalar element with this text.
fn scalar(tag: Tag, text: &str, python: Python, at: usize) -> Result<Value, DecodeError> {
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
        Tag::Int | Tag::Double => {
            let Some(text) = number::ascii_digits(text) else {
                let what = "a number with non-ASCII characters that are no digits";
                return Err(DecodeError::Unsupported { at, what });
            };
            let has_underscores = python.has_underscores();
            let text = Some(text).filter(|text| has_underscores || !text.contains('_'));
            match tag {
                Tag::Int => (text.and_then(|text| number::int(&text)), "int"),
                _ => {
                    let number = text.and_then(|text| number::float(&text));
                    (number.map(Value::Double), "double")
                }
            }
        }
        Tag::BigDecimal if number::is_plain_decimal(text) => {
            return Ok(Value::BigDecimal(text.to_owned()));
        }
        Tag::BigDecimal => {
            let what = "a bigdecimal other than digits with a point";
            return Err(DecodeError::Unsupported { at, what });
        }
        _ => (None, "base64"),
    };
    value.ok_or_else(|| bad_text(tag, text, at))
}

fn bad_text(tag: &'static str, text: &str, at: usize) -> DecodeError {
    let text = text.chars().take(TEXT_CHARS_MAX).collect();
    DecodeError::BadText { at, tag, text }
}
