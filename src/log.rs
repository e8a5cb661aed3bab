//! Writes the log to standard error. If journald reads it, each line begins with its priority, as
//! described in `sd-daemon(3)`, so that `journalctl -p warning` and its colours work.

use std::io::{self, Write};

use rustix::fs::fstat;
use tracing::{Level, Metadata};
use tracing_subscriber::fmt::MakeWriter;

/// Makes writers to standard error.
#[derive(Clone, Copy, Debug)]
pub struct Stderr {
    is_journald: bool,
}

impl Stderr {
    /// Finds out whether journald reads standard error. `stream` is the value of `JOURNAL_STREAM`: device and inode of
    /// the stream that systemd created. Standard error may have been redirected since.
    pub fn of(stream: Option<&str>) -> Self {
        let own = fstat(io::stderr()).ok();
        let own = own.map(|file| format!("{}:{}", file.st_dev, file.st_ino));
        Self {
            is_journald: own.is_some() && own.as_deref() == stream,
        }
    }
}

impl<'a> MakeWriter<'a> for Stderr {
    type Writer = Prefixed;

    fn make_writer(&'a self) -> Prefixed {
        Prefixed("")
    }

    fn make_writer_for(&'a self, metadata: &Metadata<'_>) -> Prefixed {
        Prefixed(match *metadata.level() {
            _ if !self.is_journald => "",
            Level::ERROR => "<3>",
            Level::WARN => "<4>",
            Level::INFO => "<6>",
            _ => "<7>",
        })
    }
}

/// Writes one line after this prefix, without characters that a terminal would take for commands.
#[derive(Debug)]
pub struct Prefixed(&'static str);

impl Write for Prefixed {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        self.write_all(line).map(|()| line.len())
    }

    /// Writes the whole line at once, because other processes may write to the same stream.
    fn write_all(&mut self, line: &[u8]) -> io::Result<()> {
        let line = safe(&String::from_utf8_lossy(line));
        io::stderr().write_all(format!("{}{line}", self.0).as_bytes())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Replaces a character that must not reach a terminal.
const REPLACEMENT: char = '\u{fffd}';

/// Whether a terminal would take the character for a command, or for a change of the writing
/// direction.
fn is_unsafe(c: char) -> bool {
    let turns = matches!(c, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    turns || c.is_control() && c != '\n'
}

/// Escapes unsafe characters in JSON `text` without changing its meaning.
pub(crate) fn plain_json(text: &str) -> String {
    let mut plain = String::with_capacity(text.len());
    for c in text.chars() {
        match is_unsafe(c) {
            true => plain += &format!("\\u{:04x}", u32::from(c)),
            false => plain.push(c),
        }
    }
    plain
}

/// Replaces characters in `text` that a terminal would take for commands or for a change of the writing direction.
/// Names come from the network and may contain any character.
pub(crate) fn plain(text: &str) -> String {
    let safe = |c: char| if is_unsafe(c) { REPLACEMENT } else { c };
    text.chars().map(safe).collect()
}

/// Makes a log line [`plain`] but keeps the formatter's colours. The formatter itself escapes ESC
/// in values.
fn safe(line: &str) -> String {
    let mut parts = line.split('\u{1b}');
    let mut safe = plain(parts.next().unwrap_or_default());
    for part in parts {
        let colour = part
            .strip_prefix('[')
            .map(|colour| colour.trim_start_matches(|c: char| c.is_ascii_digit() || c == ';'));
        let is_colour = colour.is_some_and(|rest| rest.starts_with('m'));
        safe.push(if is_colour { '\u{1b}' } else { REPLACEMENT });
        safe += &plain(part);
    }
    safe
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_give_a_terminal_no_commands_and_turn_no_letters() {
        let shown = plain("a\u{1b}[2J\u{202e}b\u{2066}\nc\u{9b}é");
        assert_eq!(shown, "a\u{fffd}[2J\u{fffd}b\u{fffd}\nc\u{fffd}é");
    }

    #[test]
    fn json_means_the_same_without_such_characters() {
        let value = serde_json::json!({ "a\u{202e}": ["\u{1b}[2J\u{9b}\n\u{7f}é", 1] });
        let json = plain_json(&serde_json::to_string_pretty(&value).unwrap());
        assert!(!json.chars().any(is_unsafe), "{json}");
        assert!(json.contains("a\\u202e") && json.contains("\\u009b\\n\\u007fé"));
        assert_eq!(
            serde_json::from_str::<serde_json::Value>(&json).unwrap(),
            value
        );
    }

    #[test]
    fn a_line_of_the_log_keeps_its_colours_only() {
        let line =
            safe("\u{1b}[2mtime\u{1b}[0m \u{1b}[1;33mWARN\u{1b}[0m /a\u{1b}[2J\u{202e}\rb\n");
        let shown =
            "\u{1b}[2mtime\u{1b}[0m \u{1b}[1;33mWARN\u{1b}[0m /a\u{fffd}[2J\u{fffd}\u{fffd}b\n";
        assert_eq!(line, shown);
    }
}
