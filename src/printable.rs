//! Text from elsewhere, made safe to print.
//!
//! Names, addresses and values come from the network and may contain any character. A line break in a name would forge a
//! line, a control character would command the terminal, and others change the direction of writing or are invisible.
//! Commands print only a [`Printable`], and only this module makes one: it replaces such characters in each line of
//! text, and escapes them in JSON.

use std::fmt;

use serde::Serialize;

/// Stands for a character that must not be printed.
const REPLACEMENT: char = '\u{fffd}';

/// Whether the character breaks a line, commands a terminal, changes the direction of writing, or is invisible.
pub(crate) fn is_unsafe(c: char) -> bool {
    c.is_control()
        || matches!(
            c,
            '\u{ad}'
            | '\u{61c}'
            | '\u{180e}'
            // Zero-width characters and marks of direction, separators of lines and paragraphs, embeddings.
            | '\u{200b}'..='\u{200f}'
            | '\u{2028}'..='\u{202e}'
            // Invisible operators, isolates, deprecated formatting.
            | '\u{2060}'..='\u{206f}'
            | '\u{feff}'
            | '\u{fff9}'..='\u{fffb}'
            // Tags.
            | '\u{e0000}'..='\u{e007f}'
        )
}

/// `text` as a part of one line. Replaces unsafe characters, also line breaks.
pub(crate) fn plain(text: &str) -> String {
    let safe = |c: char| if is_unsafe(c) { REPLACEMENT } else { c };
    text.chars().map(safe).collect()
}

/// Escapes unsafe characters in JSON `text` without changing its meaning. Keeps the line breaks between values.
pub(crate) fn plain_json(text: String) -> String {
    if text.bytes().all(|byte| byte < 0x7f) {
        // JSON itself escapes the first control characters.
        return text;
    }
    let mut plain = String::with_capacity(text.len());
    for c in text.chars() {
        match is_unsafe(c) && c != '\n' {
            true => {
                for unit in c.encode_utf16(&mut [0; 2]) {
                    plain += &format!("\\u{unit:04x}");
                }
            }
            false => plain.push(c),
        }
    }
    plain
}

/// Text that is safe to print.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Printable(String);

impl Printable {
    /// One line.
    pub(crate) fn line(text: &str) -> Self {
        Self(plain(text))
    }

    /// The lines of `result`.
    pub(crate) fn lines(result: &impl Lines) -> Self {
        let mut page = Page::default();
        // Writing to a page cannot fail.
        let _ = result.lines(&mut page);
        page.finish()
    }

    /// JSON, on several lines if `pretty`.
    ///
    /// # Errors
    ///
    /// If `value` cannot be written as JSON.
    pub(crate) fn json(value: &impl Serialize, pretty: bool) -> serde_json::Result<Self> {
        let text = match pretty {
            true => serde_json::to_string_pretty(value),
            false => serde_json::to_string(value),
        };
        Ok(Self(plain_json(text?)))
    }

    /// Text of the program itself that contains nothing from elsewhere, such as a manual page.
    pub(crate) fn trusted(text: String) -> Self {
        Self(text)
    }

    pub(crate) fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for Printable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// A result that is printed as lines.
pub(crate) trait Lines {
    fn lines(&self, page: &mut Page) -> fmt::Result;
}

/// Lines of text. `write!` adds to a line, and [`line!`] ends it. Both make their text [`plain`], so nothing in it can
/// begin another line.
#[derive(Clone, Debug, Default)]
pub(crate) struct Page(String);

impl Page {
    #[expect(
        clippy::unnecessary_wraps,
        reason = "`write!` and `?` work as with a formatter"
    )]
    pub(crate) fn write_fmt(&mut self, text: fmt::Arguments<'_>) -> fmt::Result {
        self.0 += &plain(&text.to_string());
        Ok(())
    }

    /// Adds to the line and ends it.
    pub(crate) fn end_line(&mut self, text: fmt::Arguments<'_>) -> fmt::Result {
        self.write_fmt(text)?;
        self.0.push('\n');
        Ok(())
    }

    /// Adds the lines of another page.
    pub(crate) fn append(&mut self, page: &Self) {
        self.0 += &page.0;
    }

    /// The number of lines.
    pub(crate) fn count(&self) -> usize {
        self.0.lines().count()
    }

    fn finish(self) -> Printable {
        Printable(self.0)
    }
}

/// Adds the text to a [`Page`] and ends the line, like `writeln!`.
macro_rules! line {
    ($page:expr $(,)?) => {
        $page.end_line(format_args!(""))
    };
    ($page:expr, $($text:tt)*) => {
        $page.end_line(format_args!($($text)*))
    };
}
pub(crate) use line;

/// Implements `Display` for types that are [`Lines`].
macro_rules! display_lines {
    ($($kind:ty),*) => {
        $(
            impl std::fmt::Display for $kind {
                fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                    write!(f, "{}", $crate::printable::Printable::lines(self))
                }
            }
        )*
    };
}
pub(crate) use display_lines;

#[cfg(test)]
mod tests {
    use super::*;

    /// A name that looks like a line of the log, with every kind of unsafe character.
    const NAME: &str = "/cam\r\n2026-11-27  /operator  set /estop\u{1b}[2J\u{9b}\u{85}\u{202e}\u{2066}\u{200b}\u{feff}\u{2028}\u{2029}\u{7f}é";

    struct Node;

    impl Lines for Node {
        fn lines(&self, page: &mut Page) -> fmt::Result {
            write!(page, "node {NAME}")?;
            line!(page, " at {}", NAME)?;
            line!(page)?;
            line!(page, "end")
        }
    }
    display_lines!(Node);

    #[test]
    fn a_name_gives_a_terminal_no_commands_and_begins_no_line() {
        let text = Printable::lines(&Node);
        assert_eq!(text.as_str(), Node.to_string());
        let lines: Vec<_> = text.as_str().lines().collect();
        assert!(matches!(lines[..], [_, "", "end"]), "{lines:?}");
        let line = Printable::line(NAME);
        for text in [lines[0], line.as_str()] {
            assert!(!text.chars().any(is_unsafe), "{text:?}");
            assert!(text.ends_with("\u{fffd}é"), "{text:?}");
        }
        assert_eq!(Printable::line("a\nb").as_str(), "a\u{fffd}b");
    }

    #[test]
    fn json_means_the_same_without_such_characters() {
        let value = serde_json::json!({ NAME: [NAME, "\u{e0041}", 1] });
        for pretty in [false, true] {
            let json = Printable::json(&value, pretty).unwrap();
            let is_bare = |c: char| is_unsafe(c) && !(pretty && c == '\n');
            assert!(!json.as_str().chars().any(is_bare), "{json}");
            let read: serde_json::Value = serde_json::from_str(json.as_str()).unwrap();
            assert_eq!(read, value);
        }
    }
}
