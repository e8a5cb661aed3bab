//! Why a document was not decoded.

use thiserror::Error;

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
