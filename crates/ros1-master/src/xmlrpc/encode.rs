//! Encodes calls to a master compactly, and calls to nodes and answers exactly as CPython writes them.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use indexmap::map;
use std::slice;

use super::number::repr;
use super::value::{Call, Reply, Struct, Value};

/// Deepest nesting that rosmaster can return. Its Python allows 1000 nested calls, and encoding takes two per level.
/// Measured with rosmaster on Python 3.11, which encodes every reply at the same stack depth.
pub(crate) const MAX_REPLY_DEPTH: usize = 492;

/// Bytes of binary data per line of base64; they make 76 characters.
const BASE64_LINE: usize = 57;

/// Encodes a call to a master compactly. For calls to nodes, use [`encode_node_call`].
///
/// Strings have no type element, and there is no white space between tags. A carriage return is written as a
/// reference, because XML reads a bare one as a line feed. Characters that XML does not allow (a decoded
/// document has none) are written unchanged, and the receiver refuses them.
pub fn encode_call(call: &Call) -> Vec<u8> {
    encode_call_of(&call.method, &call.params)
}

/// Like [`encode_call`], for a call of `method` with `params`.
pub(crate) fn encode_call_of(method: &str, params: &[Value]) -> Vec<u8> {
    let mut writer = Writer::request(method);
    for param in params {
        writer.raw("<param>");
        writer.value(param);
        writer.raw("</param>");
    }
    writer.raw("</params></methodCall>");
    writer.out.into_bytes()
}

/// Encodes a call to a node byte for byte as rosmaster does, that is like `dumps` of CPython's `xmlrpc.client`.
///
/// Boards find the arguments by searching for texts such as `<value><string>/master</string></value>`: they have never
/// met other ones (the STM32 port of ROS, mROS). CPython must be able to encode the arguments.
pub fn encode_node_call(call: &Call) -> Vec<u8> {
    let mut writer = Writer::new(Form::Python);
    writer.raw("<?xml version='1.0'?>\n<methodCall>\n<methodName>");
    writer.escaped(&call.method);
    writer.raw("</methodName>\n<params>\n");
    for param in &call.params {
        writer.raw("<param>\n");
        writer.value(param);
        writer.raw("</param>\n");
    }
    writer.raw("</params>\n</methodCall>\n");
    writer.out.into_bytes()
}

/// Encodes an answer byte for byte like rosmaster, that is like `_marshaled_dispatch` of CPython's
/// `SimpleXMLRPCServer`.
///
/// A value that rosmaster cannot encode (nil, an integer beyond 32 bits, too many levels) becomes the fault
/// that rosmaster answers in that case. As in rosmaster, the text of a date is not escaped.
///
/// ```
/// use ros1_master::xmlrpc::{Reply, Value, decode_reply, encode_reply};
///
/// let reply = Reply::Value(vec![Value::from(1), "".into(), 42.into()].into());
/// assert_eq!(decode_reply(&encode_reply(&reply)), Ok(reply));
/// ```
pub fn encode_reply(reply: &Reply) -> Vec<u8> {
    match reply {
        Reply::Value(value) => encode_result(value).unwrap_or_else(|text| encode_fault(1, text)),
        Reply::Fault { code, text } => encode_fault(*code, text),
    }
}

/// Encodes the result of a method in the same form as [`encode_reply`].
///
/// # Errors
///
/// The text of rosmaster's fault, if rosmaster cannot encode the value.
pub fn encode_result(value: &Value) -> Result<Vec<u8>, &'static str> {
    let mut writer = Writer::answer();
    writer.value(value);
    match writer.refusal {
        None => Ok(writer.end_answer()),
        Some(text) => Err(text),
    }
}

/// The start of every answer.
const ANSWER: &str = "<?xml version='1.0'?>\n<methodResponse>\n";

fn encode_fault(code: i32, text: &str) -> Vec<u8> {
    let members = Value::Struct(Struct::from([
        ("faultCode".to_owned(), Value::Int(code)),
        ("faultString".to_owned(), Value::from(text)),
    ]));
    let mut writer = Writer::new(Form::Python);
    writer.raw(ANSWER);
    writer.raw("<fault>\n");
    writer.value(&members);
    writer.raw("</fault>\n</methodResponse>\n");
    writer.out.into_bytes()
}

/// Initial capacity for a long text: more than 32 MiB. The C library maps such large blocks separately and returns them
/// as soon as they are freed, so it does not keep their memory. Pages that are never written take no memory.
const ROOM: usize = 33 << 20;

/// A call or an answer whose only value is an array, encoded element by element. As text it takes a tenth of
/// the memory that its values would take.
pub struct ListWriter(Writer);

impl ListWriter {
    /// Starts a call of `method`, encoded like [`encode_call`].
    pub fn request(method: &str) -> Self {
        let mut writer = Writer::request(method);
        writer.raw("<param>");
        Self::open(writer)
    }

    /// Starts an answer, encoded like [`encode_reply`].
    pub fn answer() -> Self {
        Self::open(Writer::answer())
    }

    fn open(mut writer: Writer) -> Self {
        writer.out.reserve(ROOM);
        writer.line(OPEN_ARRAY);
        Self(writer)
    }

    /// Writes the next element.
    pub fn push(&mut self, element: &Value) {
        self.0.value_at(element, 1);
    }

    /// Ends the array and returns the whole text.
    pub fn finish(mut self) -> Vec<u8> {
        self.0.line(CLOSE_ARRAY);
        match self.0.form {
            Form::Compact => {
                self.0.raw("</param></params></methodCall>");
                self.0.out.into_bytes()
            }
            Form::Python => self.0.end_answer(),
        }
    }
}

const OPEN_ARRAY: &str = "<value><array><data>";
const CLOSE_ARRAY: &str = "</data></array></value>";

#[derive(Clone, Copy, PartialEq, Eq)]
enum Form {
    Compact,
    Python,
}

/// An array or struct that is being encoded.
enum Open<'v> {
    Array(slice::Iter<'v, Value>),
    Struct {
        members: map::Iter<'v, String, Value>,
        in_member: bool,
    },
}

struct Writer {
    form: Form,
    out: String,
    /// The first error that CPython would have raised. The text must not be used after that.
    refusal: Option<&'static str>,
}

impl Writer {
    fn new(form: Form) -> Self {
        Self {
            form,
            out: String::new(),
            refusal: None,
        }
    }

    fn request(method: &str) -> Self {
        let mut writer = Self::new(Form::Compact);
        writer.raw("<?xml version=\"1.0\"?><methodCall><methodName>");
        writer.escaped(method);
        writer.raw("</methodName><params>");
        writer
    }

    fn answer() -> Self {
        let mut writer = Self::new(Form::Python);
        writer.raw(ANSWER);
        writer.raw("<params>\n<param>\n");
        writer
    }

    fn end_answer(mut self) -> Vec<u8> {
        self.raw("</param>\n</params>\n</methodResponse>\n");
        match self.refusal {
            None => self.out.into_bytes(),
            Some(text) => encode_fault(1, text),
        }
    }

    fn raw(&mut self, text: &str) {
        self.out.push_str(text);
    }

    /// Writes a tag, and the line break that CPython writes after it.
    fn line(&mut self, text: &str) {
        self.out.push_str(text);
        if self.form == Form::Python {
            self.out.push('\n');
        }
    }

    fn escaped(&mut self, text: &str) {
        let mut from = 0;
        for (at, byte) in text.bytes().enumerate() {
            let escape = match byte {
                b'&' => "&amp;",
                b'<' => "&lt;",
                b'>' => "&gt;",
                b'\r' if self.form == Form::Compact => "&#13;",
                _ => continue,
            };
            self.out.push_str(text.get(from..at).unwrap_or_default());
            self.out.push_str(escape);
            from = at + 1;
        }
        self.out.push_str(text.get(from..).unwrap_or_default());
    }

    fn leaf(&mut self, tag: &str, text: &str) {
        for piece in ["<value><", tag, ">", text, "</", tag] {
            self.out.push_str(piece);
        }
        self.line("></value>");
    }

    fn value(&mut self, value: &Value) {
        self.value_at(value, 0);
    }

    /// Writes a value inside `outer` arrays. Does not recurse, whatever the value's depth.
    fn value_at(&mut self, value: &Value, outer: usize) {
        let mut open: Vec<Open<'_>> = Vec::new();
        let mut next = Some(value);
        loop {
            if let Some(value) = next.take() {
                if self.form == Form::Python && self.refusal.is_none() {
                    self.refusal = refusal(value, outer + open.len());
                }
                if self.refusal.is_some() {
                    return;
                }
                match value {
                    Value::Array(elements) => {
                        self.line(OPEN_ARRAY);
                        open.push(Open::Array(elements.iter()));
                    }
                    Value::Struct(members) => {
                        self.line("<value><struct>");
                        open.push(Open::Struct {
                            members: members.iter(),
                            in_member: false,
                        });
                    }
                    leaf => self.scalar(leaf),
                }
            }
            match open.last_mut() {
                None => return,
                Some(Open::Array(elements)) => {
                    next = elements.next();
                    if next.is_none() {
                        self.line(CLOSE_ARRAY);
                        open.pop();
                    }
                }
                Some(Open::Struct { members, in_member }) => {
                    if std::mem::replace(in_member, true) {
                        self.line("</member>");
                    }
                    if let Some((name, member)) = members.next() {
                        self.line("<member>");
                        self.raw("<name>");
                        self.escaped(name);
                        self.line("</name>");
                        next = Some(member);
                    } else {
                        self.line("</struct></value>");
                        open.pop();
                    }
                }
            }
        }
    }

    fn scalar(&mut self, value: &Value) {
        let compact = self.form == Form::Compact;
        match value {
            Value::Nil => self.raw("<value><nil/></value>"),
            Value::Bool(truth) => self.leaf("boolean", if *truth { "1" } else { "0" }),
            Value::Int(number) => {
                self.leaf(if compact { "i4" } else { "int" }, &number.to_string());
            }
            Value::BigInt(digits) => self.leaf("i8", digits),
            Value::BigDecimal(text) => self.leaf("bigdecimal", text),
            Value::Double(number) => self.leaf("double", &repr(*number)),
            Value::String(text) if compact => {
                self.raw("<value>");
                self.escaped(text);
                self.raw("</value>");
            }
            Value::String(text) => {
                self.raw("<value><string>");
                self.escaped(text);
                self.line("</string></value>");
            }
            Value::DateTime(text) if compact => {
                self.raw("<value><dateTime.iso8601>");
                self.escaped(text);
                self.raw("</dateTime.iso8601></value>");
            }
            Value::DateTime(text) => self.leaf("dateTime.iso8601", text),
            Value::Base64(bytes) => {
                self.line("<value><base64>");
                if compact {
                    STANDARD.encode_string(bytes, &mut self.out);
                } else {
                    for line in bytes.chunks(BASE64_LINE) {
                        STANDARD.encode_string(line, &mut self.out);
                        self.out.push('\n');
                    }
                }
                self.line("</base64></value>");
            }
            Value::Array(_) | Value::Struct(_) => {}
        }
    }
}

/// The text of rosmaster's fault for this value inside `depth` arrays and structs of a reply. `None` if
/// rosmaster can encode it there.
pub(crate) fn refusal(value: &Value, depth: usize) -> Option<&'static str> {
    match value {
        _ if depth > MAX_REPLY_DEPTH => Some(TOO_DEEP),
        Value::Nil => Some("<class 'TypeError'>:cannot marshal None unless allow_none is enabled"),
        Value::BigInt(_) => Some("<class 'OverflowError'>:int exceeds XML-RPC limits"),
        Value::BigDecimal(_) => {
            Some("<class 'TypeError'>:cannot marshal <class 'decimal.Decimal'> objects")
        }
        // Python makes more nested function calls for these types.
        Value::Double(_) | Value::DateTime(_) if depth >= MAX_REPLY_DEPTH => Some(TOO_DEEP),
        Value::Base64(_) if depth + 1 >= MAX_REPLY_DEPTH => Some(TOO_DEEP),
        _ => None,
    }
}

/// The fault for a reply with too many levels. rosmaster's own text depends on where it ran out of stack.
const TOO_DEEP: &str = "<class 'RecursionError'>:maximum recursion depth exceeded";
