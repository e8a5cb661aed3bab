//! Why a document was not decoded.

use thiserror::Error;

/// Most characters of a value's text in an error.
pub(super) const TEXT_MOST: usize = 40;
// What is wrong, where expat's own words for it are determined.
pub(super) const NO_ELEMENT: &str = "there is no element";
pub(super) const NOT_CLOSED: &str = "an element is not closed";
pub(super) const SECOND_ROOT: &str = "a second root element";
pub(super) const TEXT_BEFORE_ROOT: &str = "text before the root element";
pub(super) const TEXT_AFTER_ROOT: &str = "text after the root element";
pub(super) const BAD_REFERENCE: &str = "a reference to nothing";
pub(super) const LATE_DECLARATION: &str = "an XML declaration that is not at the start";
pub(super) const OTHER_END: &str = "an end tag that closes another element";
pub(super) const BAD_MARKUP: &str = "markup that is not closed or has no place here";
/// Of a document without an element that CPython knows.
pub(super) const NOTHING: &str = "it has no params, fault or methodName";
/// Of parameters without a method.
pub(super) const NO_METHOD: &str = "it names no method";

/// Why a document was not decoded: CPython would raise too, or would accept something that is deliberately
/// not decoded here (see [`DecodeError::Unsupported`]).
///
/// Never a reason to fail a call: the bytes can be forwarded unchanged, and the receiver decides.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum DecodeError {
    /// Expat refuses it too.
    #[error("not well-formed XML at byte {at}: {what}; forward the body as it came")]
    Syntax {
        /// Byte in the body, not counting a byte order mark.
        at: usize,
        what: &'static str,
    },
    /// CPython would accept it, but no known ROS client sends it; not decoding is better than decoding
    /// wrongly.
    #[error("not decoded here: {what} at byte {at}; forward the body as it came")]
    Unsupported { at: usize, what: &'static str },
    /// The XML declaration names another encoding than UTF-8, US-ASCII or ISO-8859-1.
    #[error("encoding {name:?} is not decoded here; forward the body as it came")]
    Encoding { name: String },
    /// The bytes are not in the document's encoding.
    #[error("byte {at} is not {encoding}; forward the body as it came")]
    NotText { at: usize, encoding: &'static str },
    /// Too many levels of arrays, structs or elements.
    #[error("nested deeper than {limit} levels at byte {at}; forward the body as it came")]
    TooDeep { at: usize, limit: usize },
    /// A `<value>` holds an element that is not a type.
    #[error("unknown type <{tag}> at byte {at}; forward the body as it came")]
    UnknownType {
        /// Byte after the tag.
        at: usize,
        /// Its name without a prefix.
        tag: String,
    },
    /// The text of a value does not fit its type.
    #[error("{text:?} is no {tag} (before byte {at}); forward the body as it came")]
    BadText {
        /// Byte after the end of the element.
        at: usize,
        tag: &'static str,
        /// The text, cut to a few characters.
        text: String,
    },
    /// Well-formed, but not the expected call or reply.
    #[error("not a {wanted}: {what}; forward the body as it came")]
    Shape {
        /// `call` or `reply`.
        wanted: &'static str,
        what: &'static str,
    },
}

impl DecodeError {
    /// The text of the fault with which rosmaster on Python 3 answers `body`, which was not decoded because of this;
    /// none if it depends on versions, or is not known here.
    pub fn fault(&self, body: &[u8]) -> Option<String> {
        let (class, text) = match self {
            Self::BadText { tag, text, .. } => match *tag {
                "int" => {
                    let text = repr(text)?;
                    (
                        "ValueError",
                        format!("invalid literal for int() with base 10: {text}"),
                    )
                }
                "double" => {
                    let text = repr(text)?;
                    (
                        "ValueError",
                        format!("could not convert string to float: {text}"),
                    )
                }
                "boolean" => ("TypeError", "bad boolean value".to_owned()),
                "struct" => ("IndexError", "list index out of range".to_owned()),
                _ => return None,
            },
            Self::UnknownType { tag, .. } => {
                let text = format!("ResponseError(\"unknown tag {}\")", repr(tag)?);
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
        Some(format!("<class '{class}'>:{text}"))
    }
}

/// Expat's words for `what` at byte `at`.
fn expat_error(body: &[u8], at: usize, what: &str) -> Option<String> {
    let body = std::str::from_utf8(body).ok()?;
    // Line ends are counted as expat counts them, and bytes as they are in the text.
    if body.contains(['\r', '\u{feff}']) {
        return None;
    }
    let rest = body.get(at..)?;
    let word = rest.trim_ascii_start();
    let word_at = body.len() - word.len();
    let (text, at) = match what {
        NO_ELEMENT | NOT_CLOSED => ("no element found", body.len()),
        SECOND_ROOT if is_name(rest.get(1..2)?) => ("junk after document element", at),
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
        BAD_MARKUP
            if rest
                .strip_prefix('<')
                .is_some_and(|name| name.is_empty() || is_name(name)) =>
        {
            ("unclosed token", at)
        }
        _ => return None,
    };
    let before = body.get(..at)?;
    let line = 1 + before.matches('\n').count();
    let column = before.chars().rev().take_while(|&c| c != '\n').count();
    Some(format!("{text}: line {line}, column {column}"))
}

/// Whether nothing precedes a root element but a declaration.
fn is_before_root(text: &str) -> bool {
    text.trim_ascii().is_empty() || text.starts_with("<?xml ") && text.matches('<').count() == 1
}

/// What is between `begin`, with which `text` begins, and `end`.
fn inside<'t>(text: &'t str, begin: &str, end: &str) -> Option<&'t str> {
    Some(text.strip_prefix(begin)?.split_once(end)?.0)
}

/// Whether this is the name of an element in XML-RPC, or might be one.
fn is_name(text: &str) -> bool {
    text.starts_with(|c: char| c.is_ascii_alphabetic())
        && text.bytes().all(|b| b.is_ascii_alphanumeric())
}

/// Whether a text begins with a name that ends with it or with a blank.
fn is_word(text: &str) -> bool {
    text.split_ascii_whitespace().next().is_some_and(is_name)
}

/// Whether this is the number of a character, as `65` or `x41`.
fn is_number(text: &str) -> bool {
    match text.strip_prefix('x') {
        Some(digits) => !digits.is_empty() && digits.bytes().all(|b| b.is_ascii_hexdigit()),
        None => !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit()),
    }
}

/// Python's `repr(text)`; none if it may need an escape, or the text may have been cut.
fn repr(text: &str) -> Option<String> {
    let is_plain = |c: char| c == ' ' || c.is_ascii_graphic() && !matches!(c, '\'' | '\\');
    let is_whole = text.len() < TEXT_MOST;
    (is_whole && text.chars().all(is_plain)).then(|| format!("'{text}'"))
}
