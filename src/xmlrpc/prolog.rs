//! The XML declaration and the document's encoding.

use std::borrow::Cow;

use super::error::DecodeError;
use super::scan::is_space;

/// The document's text, and where in it the XML declaration ends.
///
/// # Errors
///
/// An encoding other than UTF-8, US-ASCII and ISO-8859-1 (expat also knows UTF-16, CPython every
/// codec with 8 bits), bytes that are not in it, or a bad declaration.
pub(super) fn text_of(body: &[u8]) -> Result<(Cow<'_, str>, usize), DecodeError> {
    const MARK: &[u8] = "\u{feff}".as_bytes();
    let (body, marked) = match body.strip_prefix(MARK) {
        Some(body) => (body, true),
        None => (body, false),
    };
    let (start, encoding) = match body {
        [b'<', b'?', b'x', b'm', b'l', next, ..] if is_space(*next) || *next == b'?' => {
            declared(body)?
        }
        _ => (0, None),
    };
    let encoding = encoding.unwrap_or("UTF-8");
    if encoding.eq_ignore_ascii_case("ISO-8859-1") && !marked {
        if !body.is_ascii() {
            let text = body.iter().map(|&b| char::from(b)).collect();
            return Ok((Cow::Owned(text), start));
        }
    } else if encoding.eq_ignore_ascii_case("US-ASCII") && !marked {
        if let Some(at) = body.iter().position(|b| !b.is_ascii()) {
            let encoding = "US-ASCII";
            return Err(DecodeError::NotText { at, encoding });
        }
    } else if !encoding.eq_ignore_ascii_case("UTF-8") {
        let name = encoding.to_owned();
        return Err(DecodeError::Encoding { name });
    }
    match std::str::from_utf8(body) {
        Ok(text) => Ok((Cow::Borrowed(text), start)),
        Err(error) => Err(DecodeError::NotText {
            at: error.valid_up_to(),
            encoding: "UTF-8",
        }),
    }
}

/// Reads `<?xml version="…" encoding="…" standalone="…"?>`: where it ends, and the encoding.
fn declared(body: &[u8]) -> Result<(usize, Option<&str>), DecodeError> {
    let bad = |what| DecodeError::Syntax { at: 0, what };
    let Some(length) = body.windows(2).position(|w| w == b"?>") else {
        return Err(bad("the XML declaration is not closed"));
    };
    let inside = body.get("<?xml".len()..length).unwrap_or_default();
    let Ok(mut rest) = std::str::from_utf8(inside) else {
        return Err(bad("a character that has no place in an XML declaration"));
    };
    let mut encoding = None;
    for (index, wanted) in ["version", "encoding", "standalone"]
        .into_iter()
        .enumerate()
    {
        let Some((value, behind)) = pseudo_attribute(rest, wanted) else {
            if index == 0 {
                return Err(bad("an XML declaration without a version"));
            }
            continue;
        };
        rest = behind;
        match wanted {
            "encoding" if !value.starts_with(|c: char| c.is_ascii_alphabetic()) => {
                return Err(bad("an encoding without a name"));
            }
            "encoding" => encoding = Some(value),
            "standalone" if value != "yes" && value != "no" => {
                return Err(bad("standalone is neither yes nor no"));
            }
            _ => {}
        }
    }
    if !rest.bytes().all(is_space) {
        return Err(bad("an XML declaration with something else in it"));
    }
    Ok((length + 2, encoding))
}

/// ` name = "value"`: the value, and what is behind it.
fn pseudo_attribute<'a>(text: &'a str, name: &str) -> Option<(&'a str, &'a str)> {
    let space = |c: char| u8::try_from(c).is_ok_and(is_space);
    let rest = text.strip_prefix(space)?.trim_start_matches(space);
    let rest = rest.strip_prefix(name)?.trim_start_matches(space);
    let rest = rest.strip_prefix('=')?.trim_start_matches(space);
    let quote = rest.chars().next().filter(|c| matches!(c, '"' | '\''))?;
    let (value, behind) = rest.get(1..)?.split_once(quote)?;
    let fine = |b: u8| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'-' | b'_');
    value.bytes().all(fine).then_some((value, behind))
}
