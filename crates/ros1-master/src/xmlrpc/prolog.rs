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
/// For an encoding other than UTF-8, UTF-16 with a byte order mark, US-ASCII and ISO-8859-1 (CPython knows all 8-bit
/// codecs), for bytes that are not valid in it, for characters that XML does not allow, and for a bad declaration.
pub(super) fn text_of(body: &[u8]) -> Result<Cow<'_, str>, DecodeError> {
    if let Some(text) = utf16(body)? {
        return Ok(Cow::Owned(allowed(text)?));
    }
    let encoding = match Reader::from_reader(body).read_event() {
        Ok(Event::Decl(declaration)) => declared(&declaration)?,
        _ => None,
    };
    let name = encoding.unwrap_or_else(|| "UTF-8".to_owned());
    let known = name.to_ascii_uppercase();
    let known = of_python(&known).unwrap_or(&known);
    let not_text = |at, encoding| DecodeError::NotText { at, encoding };
    let marked = body.strip_prefix("\u{feff}".as_bytes());
    let body = marked.unwrap_or(body);
    let utf8 = || std::str::from_utf8(body).map_err(|e| not_text(e.valid_up_to(), "UTF-8"));
    let text = match known {
        "UTF-8" => Cow::Borrowed(utf8()?),
        _ if marked.is_some() => return Err(DecodeError::Encoding { name }),
        "US-ASCII" => match body.iter().position(|b| !b.is_ascii()) {
            None => Cow::Borrowed(utf8()?),
            Some(at) => return Err(not_text(at, "US-ASCII")),
        },
        "ISO-8859-1" if body.is_ascii() => Cow::Borrowed(utf8()?),
        "ISO-8859-1" => body.iter().map(|&b| char::from(b)).collect(),
        "WINDOWS-1252" if body.is_ascii() => Cow::Borrowed(utf8()?),
        _ => return Err(DecodeError::Encoding { name }),
    };
    allowed(text)
}

/// Returns `text` if XML allows all its characters.
fn allowed<T: AsRef<str>>(text: T) -> Result<T, DecodeError> {
    // A second byte order mark is text, but quick-xml would skip it.
    let second = text.as_ref().starts_with('\u{feff}').then_some(0);
    if let Some(at) = second.or_else(|| text.as_ref().find(|c| !is_in_xml(c))) {
        let what = "a character that XML does not allow";
        return Err(DecodeError::Syntax { at, what });
    }
    Ok(text)
}

/// The encoding that `name`, in upper case, stands for. Expat asks Python about all names except those of
/// [`text_of`]'s encodings. Python takes each byte for a character then, so its UTF-8 is ASCII only.
fn of_python(name: &str) -> Option<&'static str> {
    Some(match name {
        "UTF8" | "UTF_8" | "ASCII" => "US-ASCII",
        "LATIN1" | "LATIN-1" | "LATIN_1" | "ISO8859-1" | "ISO_8859-1" | "ISO8859_1" | "L1" => {
            "ISO-8859-1"
        }
        "CP1252" => "WINDOWS-1252",
        _ => return None,
    })
}

/// The text of a document in UTF-16 with a byte order mark, without the mark. `None` if there is no such mark.
///
/// # Errors
///
/// If the text is not valid, or declares another encoding.
fn utf16(body: &[u8]) -> Result<Option<String>, DecodeError> {
    let other = |name: &str| DecodeError::Encoding {
        name: name.to_owned(),
    };
    let unit: fn([u8; 2]) -> u16 = match body {
        [0xff, 0xfe, ..] => u16::from_le_bytes,
        [0xfe, 0xff, ..] => u16::from_be_bytes,
        _ => return Ok(None),
    };
    let units = body.chunks(2).skip(1);
    let units = units.map(|pair| {
        pair.try_into()
            .map(unit)
            .map_err(|_| other("half a UTF-16"))
    });
    let units: Vec<u16> = units.collect::<Result<_, _>>()?;
    let text = String::from_utf16(&units).map_err(|_| other("UTF-16"))?;
    if let Ok(Event::Decl(declaration)) = Reader::from_str(&text).read_event()
        && let Some(name) = declared(&declaration)?
        && !name.eq_ignore_ascii_case("UTF-16")
    {
        return Err(other(&name));
    }
    Ok(Some(text))
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
