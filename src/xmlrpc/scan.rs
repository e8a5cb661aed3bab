//! XML as expat takes it, as a row of events.
//!
//! CPython reads XML-RPC with expat, so what expat refuses must be refused: a document that is
//! decoded here although the master faulted it would be a write that never was. What expat takes
//! and no XML-RPC client writes (a document type, names beyond ASCII) is refused as unsupported.

use super::error::DecodeError;

/// How many attributes one element may have before it is refused. XML-RPC knows none; some
/// libraries declare a namespace or two. Bounds the search for a double one.
const MAX_ATTRIBUTES: usize = 16;

/// One event. An empty element is a start and an end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Event<'a> {
    /// A start tag's name, with its prefix.
    Start(&'a str),
    /// An end tag's name, with its prefix.
    End(&'a str),
    /// A piece of text, line ends already made `\n`.
    Text(&'a str),
    /// A character that came as a reference.
    Char(char),
}

/// Walks over a document and checks it on the way.
#[derive(Debug)]
pub(super) struct Scanner<'a> {
    text: &'a str,
    at: usize,
    /// The open elements, outermost first.
    open: Vec<&'a str>,
    max_open: usize,
    seen_root: bool,
    /// An empty element's end is still to be told.
    owes_end: bool,
    in_cdata: bool,
}

impl<'a> Scanner<'a> {
    /// Begins behind the XML declaration, at byte `at` of `text`; `max_open` bounds the open elements.
    pub(super) fn new(text: &'a str, at: usize, max_open: usize) -> Self {
        Self {
            text,
            at,
            open: Vec::new(),
            max_open,
            seen_root: false,
            owes_end: false,
            in_cdata: false,
        }
    }

    /// How many bytes have been read.
    pub(super) fn at(&self) -> usize {
        self.at
    }

    /// The next event; nothing at the end of a whole document.
    pub(super) fn next(&mut self) -> Result<Option<Event<'a>>, DecodeError> {
        if std::mem::take(&mut self.owes_end) {
            return Ok(self.open.pop().map(Event::End));
        }
        loop {
            if self.in_cdata {
                return self.characters().map(Some);
            }
            if self.open.is_empty() {
                self.skip_space();
                if self.peek().is_none() && self.seen_root {
                    return Ok(None);
                }
            }
            match self.peek() {
                None if self.seen_root => return Err(self.syntax("an element is not closed")),
                None => return Err(self.syntax("there is no element")),
                Some(b'<') => {}
                Some(_) if self.open.is_empty() => {
                    return Err(self.syntax("text outside of the root element"));
                }
                Some(b'&') => {
                    self.at += 1;
                    return self.reference().map(|c| Some(Event::Char(c)));
                }
                Some(_) => return self.characters().map(Some),
            }
            self.at += 1;
            match self.peek() {
                Some(b'/') => {
                    self.at += 1;
                    return self.end_tag().map(Some);
                }
                Some(b'?') => {
                    self.at += 1;
                    self.processing_instruction()?;
                }
                Some(b'!') => {
                    self.at += 1;
                    self.declaration()?;
                }
                _ => return self.start_tag().map(Some),
            }
        }
    }

    fn peek(&self) -> Option<u8> {
        self.text.as_bytes().get(self.at).copied()
    }

    fn rest(&self) -> &'a str {
        self.text.get(self.at..).unwrap_or_default()
    }

    /// Steps over `token` if it comes next.
    fn eat(&mut self, token: &str) -> bool {
        let comes = self.rest().as_bytes().starts_with(token.as_bytes());
        if comes {
            self.at += token.len();
        }
        comes
    }

    /// Steps over white space; tells whether there was any.
    fn skip_space(&mut self) -> bool {
        let from = self.at;
        while self.peek().is_some_and(is_space) {
            self.at += 1;
        }
        self.at > from
    }

    fn syntax(&self, what: &'static str) -> DecodeError {
        DecodeError::Syntax { at: self.at, what }
    }

    fn unsupported(&self, what: &'static str) -> DecodeError {
        DecodeError::Unsupported { at: self.at, what }
    }

    /// Text up to the next markup, line end or end of a CDATA section.
    fn characters(&mut self) -> Result<Event<'a>, DecodeError> {
        let rest = self.rest();
        let bytes = rest.as_bytes();
        let mut end = 0;
        loop {
            let tail = bytes.get(end..).unwrap_or_default();
            let Some(step) = tail.iter().position(|&b| !is_plain(b)) else {
                end = bytes.len();
                break;
            };
            end += step;
            let tail = tail.get(step..).unwrap_or_default();
            match tail {
                [b'<' | b'&', ..] if !self.in_cdata => break,
                [b'<' | b'&', ..] => {}
                [b'\r', ..] if end > 0 => break,
                [b'\r', b'\n', ..] => {
                    self.at += 2;
                    return Ok(Event::Text("\n"));
                }
                [b'\r', ..] => {
                    self.at += 1;
                    return Ok(Event::Text("\n"));
                }
                [b']', b']', b'>', ..] if self.in_cdata => {
                    let piece = rest.get(..end).unwrap_or_default();
                    self.at += end + 3;
                    self.in_cdata = false;
                    return Ok(Event::Text(piece));
                }
                [b']', b']', b'>', ..] => {
                    self.at += end;
                    return Err(self.syntax("]]> in text"));
                }
                [b']', ..] => {}
                _ if is_forbidden(tail) => {
                    self.at += end;
                    return Err(self.syntax("a character that XML does not have"));
                }
                _ => {}
            }
            end += 1;
        }
        if self.in_cdata && end == bytes.len() {
            return Err(self.syntax("a CDATA section is not closed"));
        }
        self.at += end;
        Ok(Event::Text(rest.get(..end).unwrap_or_default()))
    }

    /// Behind `&`.
    fn reference(&mut self) -> Result<char, DecodeError> {
        let rest = self.rest();
        let end = rest
            .bytes()
            .position(|b| !b.is_ascii_alphanumeric() && b != b'#');
        let Some(length) = end.filter(|&end| rest.as_bytes().get(end) == Some(&b';')) else {
            return Err(self.syntax("a reference without its semicolon"));
        };
        let name = rest.get(..length).unwrap_or_default();
        let character = match name {
            "lt" => Some('<'),
            "gt" => Some('>'),
            "amp" => Some('&'),
            "apos" => Some('\''),
            "quot" => Some('"'),
            _ => name.strip_prefix('#').and_then(numbered),
        };
        let Some(character) = character else {
            return Err(self.syntax("a reference to nothing"));
        };
        self.at += length + 1;
        Ok(character)
    }

    /// A name in ASCII.
    fn name(&mut self) -> Result<&'a str, DecodeError> {
        let rest = self.rest();
        let length = rest.bytes().position(|b| !is_name(b)).unwrap_or(rest.len());
        let name = rest.get(..length).unwrap_or_default();
        if rest.as_bytes().get(length).is_some_and(|b| !b.is_ascii()) {
            return Err(self.unsupported("a name beyond ASCII"));
        }
        if name
            .bytes()
            .next()
            .is_none_or(|b| b.is_ascii_digit() || b == b'-' || b == b'.')
        {
            return Err(self.syntax("a name is missing"));
        }
        self.at += length;
        Ok(name)
    }

    /// Behind `<`.
    fn start_tag(&mut self) -> Result<Event<'a>, DecodeError> {
        if self.open.is_empty() && self.seen_root {
            return Err(self.syntax("a second root element"));
        }
        if self.open.len() >= self.max_open {
            return Err(DecodeError::TooDeep {
                at: self.at,
                limit: self.max_open,
            });
        }
        let name = self.name()?;
        if self.peek() != Some(b'>') {
            self.attributes()?;
        }
        if self.eat("/>") {
            self.owes_end = true;
        } else if !self.eat(">") {
            return Err(self.syntax("a start tag is not closed"));
        }
        self.seen_root = true;
        self.open.push(name);
        Ok(Event::Start(name))
    }

    /// Reads attributes only to know that they are well-formed: XML-RPC has none.
    fn attributes(&mut self) -> Result<(), DecodeError> {
        let mut names: Vec<&str> = Vec::new();
        loop {
            let spaced = self.skip_space();
            if matches!(self.peek(), Some(b'>' | b'/') | None) {
                return Ok(());
            }
            if !spaced {
                return Err(self.syntax("no space before an attribute"));
            }
            let name = self.name()?;
            if names.contains(&name) {
                return Err(self.syntax("the same attribute twice"));
            }
            if names.len() >= MAX_ATTRIBUTES {
                return Err(self.unsupported("an element with so many attributes"));
            }
            names.push(name);
            self.skip_space();
            if !self.eat("=") {
                return Err(self.syntax("an attribute without a value"));
            }
            self.skip_space();
            let Some(quote @ (b'"' | b'\'')) = self.peek() else {
                return Err(self.syntax("an attribute without quotes"));
            };
            self.at += 1;
            loop {
                match self.peek() {
                    None | Some(b'<') => return Err(self.syntax("an attribute is not closed")),
                    Some(b'&') => {
                        self.at += 1;
                        self.reference()?;
                    }
                    Some(b) if b == quote => break,
                    Some(_) if is_forbidden(self.rest().as_bytes()) => {
                        return Err(self.syntax("a character that XML does not have"));
                    }
                    Some(_) => self.step(),
                }
            }
            self.at += 1;
        }
    }

    /// Over one whole character, so that `at` stays on a boundary.
    fn step(&mut self) {
        self.at += self.rest().chars().next().map_or(0, char::len_utf8);
    }

    /// Behind `</`.
    fn end_tag(&mut self) -> Result<Event<'a>, DecodeError> {
        let name = self.name()?;
        self.skip_space();
        if !self.eat(">") {
            return Err(self.syntax("an end tag is not closed"));
        }
        match self.open.pop() {
            Some(open) if open == name => Ok(Event::End(name)),
            _ => Err(self.syntax("an end tag that closes another element")),
        }
    }

    /// Behind `<?`.
    fn processing_instruction(&mut self) -> Result<(), DecodeError> {
        let target = self.name()?;
        if target.eq_ignore_ascii_case("xml") {
            return Err(self.syntax("an XML declaration that is not at the start"));
        }
        if self.eat("?>") {
            return Ok(());
        }
        if !self.skip_space() {
            return Err(self.syntax("no space in a processing instruction"));
        }
        self.skip_to("?>", "a processing instruction is not closed")
    }

    /// Behind `<!`: a comment, the start of a CDATA section, or what is refused.
    fn declaration(&mut self) -> Result<(), DecodeError> {
        if self.eat("--") {
            self.skip_to("--", "a comment is not closed")?;
            return if self.eat(">") {
                Ok(())
            } else {
                Err(self.syntax("-- in a comment"))
            };
        }
        if !self.open.is_empty() && self.eat("[CDATA[") {
            self.in_cdata = true;
            return Ok(());
        }
        if !self.seen_root && self.eat("DOCTYPE") {
            return Err(self.unsupported("a document type"));
        }
        Err(self.syntax("markup that has no place here"))
    }

    /// Over everything up to and with `end`.
    fn skip_to(&mut self, end: &'static str, or: &'static str) -> Result<(), DecodeError> {
        let rest = self.rest();
        let Some(length) = rest.find(end) else {
            return Err(self.syntax(or));
        };
        let inside = rest.as_bytes().get(..length).unwrap_or_default();
        if inside.windows(3).any(is_forbidden) || inside.iter().any(|&b| is_control(b)) {
            return Err(self.syntax("a character that XML does not have"));
        }
        self.at += length + end.len();
        Ok(())
    }
}

/// The character with the number behind `&#`.
fn numbered(number: &str) -> Option<char> {
    let (digits, radix) = match number.strip_prefix('x') {
        Some(hex) => (hex, 16),
        None => (number, 10),
    };
    // `from_str_radix` takes a sign, XML does not.
    if !digits.bytes().all(|b| b.is_ascii_hexdigit()) {
        return None;
    }
    let character = char::from_u32(u32::from_str_radix(digits, radix).ok()?)?;
    let forbidden = matches!(character, '\0'..='\u{1f}' if !matches!(character, '\t' | '\n' | '\r'))
        || matches!(character, '\u{fffe}' | '\u{ffff}');
    (!forbidden).then_some(character)
}

pub(super) fn is_space(byte: u8) -> bool {
    matches!(byte, b' ' | b'\t' | b'\n' | b'\r')
}

fn is_name(byte: u8) -> bool {
    byte.is_ascii_alphanumeric() || matches!(byte, b'_' | b':' | b'-' | b'.')
}

fn is_control(byte: u8) -> bool {
    byte < 0x20 && !is_space(byte)
}

/// Text that needs no second look. 0xEF begins U+FFFE and U+FFFF, among others.
fn is_plain(byte: u8) -> bool {
    !matches!(byte, b'<' | b'&' | b']' | 0xef | b'\0'..=0x08 | 0x0b..=0x1f)
}

/// Whether UTF-8 text begins with a character that is not in XML 1.0. Expat knows only the first
/// plane's two non-characters.
fn is_forbidden(text: &[u8]) -> bool {
    match text {
        [0xef, 0xbf, 0xbe | 0xbf, ..] => true,
        [first, ..] => is_control(*first),
        [] => false,
    }
}
