//! The errors of decoding.

use thiserror::Error;

use super::python::Python;

/// Maximum number of characters of a value's text in an error.
pub(super) const TEXT_CHARS_MAX: usize = 40;
// Reasons from which expat's own error text can be derived.
pub(super) const NO_ELEMENT: &str = "there is no element";
pub(super) const NOT_CLOSED: &str = "an element is not closed";
pub(super) const SECOND_ROOT: &str = "a second root element";
pub(super) const TEXT_BEFORE_ROOT: &str = "text before the root element";
pub(super) const TEXT_AFTER_ROOT: &str = "text after the root element";
pub(super) const BAD_REFERENCE: &str = "a reference to an unknown entity or character";
pub(super) const LATE_DECLARATION: &str = "an XML declaration after the start of the document";
pub(super) const OTHER_END: &str = "an end tag that does not match its start tag";
pub(super) const BAD_MARKUP: &str = "markup that is not closed or not allowed here";
pub(super) const MARKUP_OUTSIDE: &str =
    "markup outside of the root element that is not closed or not allowed there";
/// The document has no element that CPython knows.
pub(super) const NOTHING: &str = "it has no params, fault or methodName";
/// The call has parameters but no method name.
pub(super) const NO_METHOD: &str = "it has no method name";

/// ASCII characters with which nothing begins that may stand outside of an element.
const NO_TOKEN: [char; 16] = [
    '!', '$', '*', '+', '/', ';', '=', '?', '@', '\\', '^', '`', '{', '}', '~', '\u{7f}',
];

/// Why a document was not decoded. Either CPython would raise an exception too, or it would accept something that is
/// not decoded here on purpose (see [`DecodeError::Unsupported`]).
///
/// This is never a reason to fail a call: forward the body unchanged, and let the receiver decide.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum DecodeError {
    /// Not well-formed XML: expat refuses it too.
    #[error("not well-formed XML at byte {at}: {what}; forward the body unchanged")]
    Syntax {
        /// Position in the body in bytes, not counting a byte order mark.
        at: usize,
        what: &'static str,
    },
    /// CPython would accept this, but no known ROS client sends it. Not decoding it is better than decoding
    /// it wrongly.
    #[error("unsupported: {what} at byte {at}; forward the body unchanged")]
    Unsupported { at: usize, what: &'static str },
    /// The encoding is not UTF-8, UTF-16 with a byte order mark, US-ASCII or ISO-8859-1; or the XML declaration
    /// contradicts the byte order mark; or the UTF-16 is broken.
    #[error("encoding {name:?} is not supported; forward the body unchanged")]
    Encoding { name: String },
    /// The bytes are not in the document's encoding.
    #[error("byte {at} is not valid {encoding}; forward the body unchanged")]
    NotText { at: usize, encoding: &'static str },
    /// Too many levels of arrays, structs or elements.
    #[error("nested deeper than {limit} levels at byte {at}; forward the body unchanged")]
    TooDeep { at: usize, limit: usize },
    /// A `<value>` contains an element that is not a type.
    #[error("unknown type <{tag}> at byte {at}; forward the body unchanged")]
    UnknownType {
        /// Position after the tag, in bytes.
        at: usize,
        /// The tag's name without its namespace prefix.
        tag: String,
    },
    /// A value's text does not fit its type.
    #[error("{text:?} is not a valid {tag} (before byte {at}); forward the body unchanged")]
    BadText {
        /// Position after the end of the element, in bytes.
        at: usize,
        tag: &'static str,
        /// The text, shortened.
        text: String,
    },
    /// Well-formed XML, but not the expected call or reply.
    #[error("not a {wanted}: {what}; forward the body unchanged")]
    Shape {
        /// `call` or `reply`.
        wanted: &'static str,
        what: &'static str,
    },
}

impl DecodeError {
    /// The fault text with which rosmaster on this version of Python answers `body`, which was not decoded because of
    /// this error. `None` if the text is not known here.
    pub fn fault(&self, body: &[u8], python: Python) -> Option<String> {
        let (class, text) = match self {
            Self::BadText { tag, text, .. } => match *tag {
                "int" => {
                    // Python 2 skips leading spaces before it quotes the text.
                    let text = match python.is_two() && !text.trim().is_empty() {
                        true => repr(text.trim_start())?,
                        false => repr(text)?,
                    };
                    (
                        "ValueError",
                        format!("invalid literal for int() with base 10: {text}"),
                    )
                }
                "double" if python.is_two() => ("ValueError", no_float_of_2(text)?),
                "double" => {
                    let text = repr(text)?;
                    (
                        "ValueError",
                        format!("could not convert string to float: {text}"),
                    )
                }
                "base64" => ("binascii.Error", no_base64(text, python)?),
                "boolean" => ("TypeError", "bad boolean value".to_owned()),
                "struct" => ("IndexError", "list index out of range".to_owned()),
                _ => return None,
            },
            Self::UnknownType { tag, .. } => {
                let unicode = if python.is_two() { "u" } else { "" };
                let comma = if python < Python::new(3, 7, 0) {
                    ","
                } else {
                    ""
                };
                let text = format!(
                    "ResponseError(\"unknown tag {unicode}{}\"{comma})",
                    repr(tag)?
                );
                ("xmlrpc.client.ResponseError", text)
            }
            Self::Shape { what: NOTHING, .. } => {
                ("xmlrpc.client.ResponseError", "ResponseError()".to_owned())
            }
            Self::Shape {
                what: NO_METHOD, ..
            } => ("Exception", "method \"None\" is not supported".to_owned()),
            Self::Syntax { at, what } => (
                "xml.parsers.expat.ExpatError",
                expat_error(body, *at, what)?,
            ),
            _ => return None,
        };
        Some(python.fault(format!("<class '{class}'>:{text}")))
    }
}

/// Python 2's complaint about a text that is no number.
fn no_float_of_2(text: &str) -> Option<String> {
    repr(text)?;
    let text = text.trim_start();
    let begins_with_one = (1..text.len())
        .filter_map(|end| text.get(..end))
        .any(|part| part.parse::<f64>().is_ok());
    let complaint = match begins_with_one {
        true => "invalid literal for float()",
        false => "could not convert string to float",
    };
    Some(format!("{complaint}: {text}"))
}

/// Python's complaint about a text that is not base64.
fn no_base64(text: &str, python: Python) -> Option<String> {
    // The text may have been shortened, or hold characters for which there is another complaint.
    if text.len() >= TEXT_CHARS_MAX || !text.is_ascii() {
        return None;
    }
    let is_data = |byte: &u8| byte.is_ascii_alphanumeric() || matches!(byte, b'+' | b'/');
    let count = text.bytes().filter(is_data).count();
    Some(match count % 4 == 1 && python >= Python::new(3, 7, 0) {
        true => format!(
            "Invalid base64-encoded string: number of data characters ({count}) cannot be 1 more than a multiple of 4"
        ),
        false => "Incorrect padding".to_owned(),
    })
}

/// Expat's error text for the problem `what` at byte `at`.
fn expat_error(body: &[u8], at: usize, what: &str) -> Option<String> {
    let body = std::str::from_utf8(body).ok()?;
    // Positions are computed only for plain line feeds and without a byte order mark.
    if body.contains(['\r', '\u{feff}']) {
        return None;
    }
    let rest = body.get(at..)?;
    let word = rest.trim_ascii_start();
    let word_at = body.len() - word.len();
    let (text, at) = match what {
        NO_ELEMENT | NOT_CLOSED => ("no element found", body.len()),
        SECOND_ROOT if is_name(rest.get(1..2)?) => ("junk after document element", at),
        TEXT_BEFORE_ROOT | TEXT_AFTER_ROOT if word.starts_with(NO_TOKEN) => {
            ("not well-formed (invalid token)", word_at)
        }
        TEXT_AFTER_ROOT if is_word(word) => ("junk after document element", word_at),
        TEXT_BEFORE_ROOT if is_word(word) => ("syntax error", word_at),
        BAD_REFERENCE if is_name(inside(rest, "&", ";")?) => ("undefined entity", at),
        BAD_REFERENCE if is_number(inside(rest, "&#", ";")?) => {
            ("reference to invalid character number", at)
        }
        LATE_DECLARATION if is_before_root(body.get(..at)?) => {
            ("XML or text declaration not at start of entity", at)
        }
        OTHER_END if is_name(inside(rest, "</", ">")?.trim_ascii_end()) => {
            ("mismatched tag", at + "</".len())
        }
        MARKUP_OUTSIDE if is_declaration(rest) && is_before_root(body.get(..at)?) => {
            ("syntax error", at)
        }
        BAD_MARKUP | MARKUP_OUTSIDE if is_begun(rest.strip_prefix('<')?) => ("unclosed token", at),
        BAD_MARKUP if is_begun(rest.strip_prefix("</")?) => ("unclosed token", at),
        _ => return None,
    };
    let before = body.get(..at)?;
    let line = 1 + before.matches('\n').count();
    let column = before.chars().rev().take_while(|&c| c != '\n').count();
    Some(format!("{text}: line {line}, column {column}"))
}

/// Whether `text`, the start of a document, ends before the root element: it is empty or only an XML declaration.
fn is_before_root(text: &str) -> bool {
    text.trim_ascii().is_empty() || text.starts_with("<?xml ") && text.matches('<').count() == 1
}

/// Whether `text` starts with a declaration such as `<!ENTITY a 'b'>`, which belongs into a document type.
fn is_declaration(text: &str) -> bool {
    let mut words = text
        .strip_prefix("<!")
        .into_iter()
        .flat_map(|rest| rest.split_ascii_whitespace());
    let is_word = |word: &str| word.bytes().all(|byte| byte.is_ascii_alphabetic());
    words.next().is_some_and(is_word) && words.next().is_some()
}

/// The part of `text` after `begin`, with which `text` must start, up to the next `end`.
fn inside<'t>(text: &'t str, begin: &str, end: &str) -> Option<&'t str> {
    Some(text.strip_prefix(begin)?.split_once(end)?.0)
}

/// Whether this is, or may be, the name of an XML-RPC element.
fn is_name(text: &str) -> bool {
    text.starts_with(|c: char| c.is_ascii_alphabetic())
        && text.bytes().all(|b| b.is_ascii_alphanumeric())
}

/// Whether this is empty or may be the begin of a name.
fn is_begun(text: &str) -> bool {
    text.is_empty() || is_name(text)
}

/// Whether `text` starts with a name that is followed by white space or the end.
fn is_word(text: &str) -> bool {
    text.split_ascii_whitespace().next().is_some_and(is_name)
}

/// Whether this is a character number, such as `65` or `x41`.
fn is_number(text: &str) -> bool {
    match text.strip_prefix('x') {
        Some(digits) => !digits.is_empty() && digits.bytes().all(|b| b.is_ascii_hexdigit()),
        None => !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit()),
    }
}

/// Python's `repr(text)`. `None` if the text may need an escape or may have been shortened.
fn repr(text: &str) -> Option<String> {
    let is_plain = |c: char| c == ' ' || c.is_ascii_graphic() && !matches!(c, '\'' | '\\');
    let is_whole = text.len() < TEXT_CHARS_MAX;
    (is_whole && text.chars().all(is_plain)).then(|| format!("'{text}'"))
}
