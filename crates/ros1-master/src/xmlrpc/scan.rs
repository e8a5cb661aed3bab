//! Reads XML as expat accepts it, as a sequence of events.
//!
//! CPython reads XML-RPC with expat, so this scanner must refuse everything that expat refuses: if rosrescue
//! decoded a document that the master answers with a fault, it would record a write that never happened.
//! quick-xml finds the markup; this module checks the XML rules that quick-xml does not. It refuses as
//! unsupported what expat accepts but no XML-RPC client writes: a document type and non-ASCII names.

use std::borrow::Cow;

use quick_xml::errors::{Error, IllFormedError};
use quick_xml::escape::{resolve_xml_entity, unescape};
use quick_xml::events::attributes::Attribute;
use quick_xml::events::{BytesEnd, BytesRef, BytesStart, Event as Markup};
use quick_xml::reader::Reader;

use super::error::{
    BAD_MARKUP, BAD_REFERENCE, DecodeError, LATE_DECLARATION, MARKUP_OUTSIDE, NO_ELEMENT,
    NOT_CLOSED, OTHER_END, SECOND_ROOT, TEXT_AFTER_ROOT, TEXT_BEFORE_ROOT,
};

/// One event of the scanner. An empty element causes two events, a start and an end.
pub(super) enum Event<'a> {
    Start(BytesStart<'a>),
    End(BytesEnd<'a>),
    /// A piece of text. Its line ends are already `\n`, unless [`LineEnds::Kept`] was chosen.
    Text(Cow<'a, str>),
    /// A reference, and the character that it stands for.
    Reference(BytesRef<'a>, Cow<'static, str>),
}

/// What to do with line ends in text.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum LineEnds {
    /// Each line end becomes `\n`, as XML requires.
    Normal,
    /// Line ends stay unchanged.
    Kept,
}

/// Reads a document event by event, and checks the rules of XML.
pub(super) struct Scanner<'a> {
    reader: Reader<&'a [u8]>,
    /// Number of open elements.
    open: usize,
    max_open: usize,
    line_ends: LineEnds,
    seen_root: bool,
}

impl<'a> Scanner<'a> {
    /// Starts at the beginning of `text`, all of whose characters must be allowed in XML. `max_open` limits
    /// how many elements may be open at once.
    pub(super) fn new(text: &'a str, max_open: usize, line_ends: LineEnds) -> Self {
        let mut reader = Reader::from_str(text);
        let config = reader.config_mut();
        config.check_comments = true;
        config.expand_empty_elements = true;
        Self {
            reader,
            open: 0,
            max_open,
            line_ends,
            seen_root: false,
        }
    }

    /// Position in the text, in bytes.
    pub(super) fn at(&self) -> usize {
        offset(self.reader.buffer_position())
    }

    /// The next event. `None` at the end of a complete document.
    pub(super) fn next(&mut self) -> Result<Option<Event<'a>>, DecodeError> {
        loop {
            let at = self.at();
            let markup = self.reader.read_event().map_err(|e| self.broken(&e))?;
            let is_outside = self.open == 0;
            let what = match markup {
                Markup::Start(_) if is_outside && self.seen_root => SECOND_ROOT,
                Markup::Start(_) if self.open >= self.max_open => {
                    let limit = self.max_open;
                    return Err(DecodeError::TooDeep { at, limit });
                }
                Markup::Start(tag) => {
                    check_name(tag.name().0, at)?;
                    if !tag.attributes_raw().is_empty() {
                        checked_attributes(&tag, at)?;
                    }
                    self.open += 1;
                    self.seen_root = true;
                    return Ok(Some(Event::Start(tag)));
                }
                Markup::End(tag) => {
                    self.open -= 1;
                    return Ok(Some(Event::End(tag)));
                }
                Markup::Text(text) if is_outside && text.bytes().all(is_space) => continue,
                Markup::Text(_) if is_outside && self.seen_root => TEXT_AFTER_ROOT,
                Markup::Text(_) if is_outside => TEXT_BEFORE_ROOT,
                Markup::CData(_) | Markup::GeneralRef(_) if is_outside => {
                    "text outside of the root element"
                }
                // Searching for one character is much faster, and most encoders write `&gt;`.
                Markup::Text(text) if text.contains('>') && text.contains("]]>") => "]]> in text",
                Markup::Text(text) => {
                    return Ok(Some(Event::Text(match self.line_ends {
                        LineEnds::Normal => text.xml10_content(),
                        LineEnds::Kept => text.into_inner(),
                    })));
                }
                Markup::CData(text) => {
                    return Ok(Some(Event::Text(match self.line_ends {
                        LineEnds::Normal => text.xml10_content(),
                        LineEnds::Kept => text.into_inner(),
                    })));
                }
                Markup::GeneralRef(reference) => match character(&reference) {
                    Some(text) => return Ok(Some(Event::Reference(reference, text))),
                    None => BAD_REFERENCE,
                },
                Markup::Decl(_) if at == 0 => continue,
                Markup::Decl(_) => LATE_DECLARATION,
                Markup::PI(it) if it.target().eq_ignore_ascii_case("xml") => {
                    "an XML declaration in upper case"
                }
                Markup::PI(it) => {
                    check_name(it.target(), at)?;
                    continue;
                }
                Markup::DocType(_) => {
                    let what = "a document type";
                    return Err(DecodeError::Unsupported { at, what });
                }
                Markup::Eof if !is_outside => NOT_CLOSED,
                Markup::Eof if !self.seen_root => NO_ELEMENT,
                Markup::Eof => return Ok(None),
                // quick-xml expands an empty element to a start and an end, so `Empty` never comes.
                Markup::Comment(_) | Markup::Empty(_) => continue,
            };
            return Err(DecodeError::Syntax { at, what });
        }
    }

    /// Converts quick-xml's error and adds the position.
    fn broken(&self, error: &Error) -> DecodeError {
        let what = match error {
            Error::IllFormed(IllFormedError::UnclosedReference) => "a reference without semicolon",
            Error::IllFormed(IllFormedError::DoubleHyphenInComment) => "-- in a comment",
            Error::IllFormed(IllFormedError::MismatchedEndTag { .. }) => OTHER_END,
            Error::IllFormed(_) => "an end tag without an element",
            _ if self.open > 0 => BAD_MARKUP,
            _ => MARKUP_OUTSIDE,
        };
        let at = offset(self.reader.error_position());
        DecodeError::Syntax { at, what }
    }
}

fn offset(position: u64) -> usize {
    usize::try_from(position).unwrap_or(usize::MAX)
}

/// The character that a reference stands for. `None` if it is unknown.
fn character(reference: &BytesRef<'_>) -> Option<Cow<'static, str>> {
    match reference.resolve_char_ref().ok()? {
        Some(character) => is_in_xml(character).then(|| character.to_string().into()),
        None => resolve_xml_entity(reference).map(Cow::Borrowed),
    }
}

/// The attributes of a tag or declaration at byte `at`, checked for well-formedness.
pub(super) fn checked_attributes<'t>(
    tag: &'t BytesStart<'_>,
    at: usize,
) -> Result<Vec<Attribute<'t>>, DecodeError> {
    let bad = |what| DecodeError::Syntax { at, what };
    let raw = tag.attributes_raw();
    let check = |attribute: Attribute<'t>| {
        let name = attribute.key.0;
        check_name(name, at)?;
        // quick-xml accepts an attribute that directly follows the value of another one. `name` and the byte
        // before it both lie in `raw`.
        let start = name.as_ptr().addr().wrapping_sub(raw.as_ptr().addr());
        let before = raw.as_bytes().get(..start).and_then(<[u8]>::last);
        if !before.is_some_and(|&byte| is_space(byte)) {
            return Err(bad("no space before an attribute"));
        }
        let value = unescape(&attribute.value).ok();
        let is_fine = value.is_some_and(|value| value.chars().all(is_in_xml));
        if !is_fine || attribute.value.contains('<') {
            return Err(bad("an attribute with < or an unknown reference"));
        }
        Ok(attribute)
    };
    tag.attributes()
        .map(|it| {
            check(it.map_err(|_| bad("an attribute that lacks = or quotes, or is repeated"))?)
        })
        .collect()
}

/// Checks that a name is not empty, and is ASCII.
fn check_name(name: &str, at: usize) -> Result<(), DecodeError> {
    let is_inner = |b: u8| b.is_ascii_digit() || b == b'-' || b == b'.';
    let is_name = |b: u8| b.is_ascii_alphabetic() || b == b'_' || b == b':' || is_inner(b);
    if !name.is_ascii() {
        let what = "a non-ASCII name";
        return Err(DecodeError::Unsupported { at, what });
    }
    if name.bytes().next().is_none_or(is_inner) || !name.bytes().all(is_name) {
        let what = "a name is missing";
        return Err(DecodeError::Syntax { at, what });
    }
    Ok(())
}

fn is_space(byte: u8) -> bool {
    matches!(byte, b' ' | b'\t' | b'\n' | b'\r')
}

/// Whether XML 1.0 allows this character. Like expat, this excludes only the non-characters of the first plane.
pub(super) fn is_in_xml(character: char) -> bool {
    matches!(character, '\t' | '\n' | '\r' | ' '..='\u{fffd}' | '\u{10000}'..)
}
