//! Reads the XML declaration and the encoding of a document.

use std::borrow::Cow;

use quick_xml::events::{BytesDecl, BytesStart, Event};
use quick_xml::reader::Reader;

use super::error::DecodeError;
use super::scan::{checked_attributes, is_in_xml};

/// The text of a document, without a byte order mark.
///
/// # Errors
///
/// For an encoding other than UTF-8, US-ASCII and ISO-8859-1 (expat also knows UTF-16, and CPython all 8-bit codecs),
/// for bytes that are not valid in it, for characters that XML does not allow, and for a bad declaration.
pub(super) fn text_of(body: &[u8]) -> Result<Cow<'_, str>, DecodeError> {
    let encoding = match Reader::from_reader(body).read_event() {
        Ok(Event::Decl(declaration)) => declared(&declaration)?,
        _ => None,
    };
    let name = encoding.unwrap_or_else(|| "UTF-8".to_owned());
    let not_text = |at, encoding| DecodeError::NotText { at, encoding };
    let marked = body.strip_prefix("\u{feff}".as_bytes());
    let body = marked.unwrap_or(body);
    let utf8 = || std::str::from_utf8(body).map_err(|e| not_text(e.valid_up_to(), "UTF-8"));
    let text = match name.to_ascii_uppercase().as_str() {
        "UTF-8" => Cow::Borrowed(utf8()?),
        _ if marked.is_some() => return Err(DecodeError::Encoding { name }),
        "US-ASCII" => match body.iter().position(|b| !b.is_ascii()) {
            None => Cow::Borrowed(utf8()?),
            Some(at) => return Err(not_text(at, "US-ASCII")),
        },
        "ISO-8859-1" if body.is_ascii() => Cow::Borrowed(utf8()?),
        "ISO-8859-1" => body.iter().map(|&b| char::from(b)).collect(),
        _ => return Err(DecodeError::Encoding { name }),
    };
    // A second byte order mark is text, but quick-xml would skip it.
    let second = text.starts_with('\u{feff}').then_some(0);
    if let Some(at) = second.or_else(|| text.find(|c| !is_in_xml(c))) {
        let what = "a character that XML does not allow";
        return Err(DecodeError::Syntax { at, what });
    }
    Ok(text)
}

/// The document without its document type, if that is only a name and so declares nothing. `None` if the document has
/// no document type, or one that declares something.
pub fn without_doctype(body: &[u8]) -> Option<Vec<u8>> {
    const DOCTYPE: &[u8] = b"<!DOCTYPE";
    let declared = match body.starts_with(b"<?xml") {
        true => body.windows(2).position(|it| it == b"?>")? + 2,
        false => 0,
    };
    let blank = body.get(declared..)?.iter();
    let begin = declared + blank.take_while(|byte| byte.is_ascii_whitespace()).count();
    let doctype = body.get(begin..)?;
    let end = doctype.iter().position(|&byte| byte == b'>')?;
    let name = doctype.get(..end)?.strip_prefix(DOCTYPE)?;
    let is_name = |name: &[u8]| {
        name.first().is_some_and(u8::is_ascii_alphabetic)
            && name.iter().all(u8::is_ascii_alphanumeric)
    };
    let is_plain = name.first().is_some_and(u8::is_ascii_whitespace) && is_name(name.trim_ascii());
    is_plain.then(|| {
        [body.get(..begin), doctype.get(end + 1..)]
            .into_iter()
            .flatten()
            .flatten()
            .copied()
            .collect()
    })
}

/// The encoding named in `<?xml version="…" encoding="…" standalone="…"?>`.
fn declared(declaration: &BytesDecl<'_>) -> Result<Option<String>, DecodeError> {
    let tag = BytesStart::from_content(&**declaration, "xml".len());
    let attributes = checked_attributes(&tag, 0)?;
    let mut names = ["version", "encoding", "standalone"].into_iter();
    let is_plain = |b: u8| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'-' | b'_');
    let is_fine = attributes.iter().all(|attribute| {
        let (name, value) = (attribute.key.0, &attribute.value);
        // Each name comes at most once, and in this order.
        names.any(|next| next == name)
            && value.bytes().all(is_plain)
            && (name != "standalone" || value == "yes" || value == "no")
    });
    let has_version = attributes.first().is_some_and(|it| it.key.0 == "version");
    if !is_fine || !has_version {
        let what = "a malformed XML declaration";
        return Err(DecodeError::Syntax { at: 0, what });
    }
    let encoding = attributes.iter().find(|it| it.key.0 == "encoding");
    Ok(encoding.map(|it| it.value.clone().into_owned()))
}
