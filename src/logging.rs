//! Writes the log to standard error. If journald reads it, each line begins with its priority, as
//! described in `sd-daemon(3)`, so that `journalctl -p warning` and its colours work.
//!
//! A thread of its own writes. A terminal that was stopped with Ctrl-S, a pipe that nobody reads or a disk that hangs
//! must hold up no call.

use std::io::{self, Write};

use rustix::fs::fstat;
use tracing::{Level, Metadata};
use tracing_appender::non_blocking::{NonBlocking, NonBlockingBuilder, WorkerGuard};
use tracing_subscriber::fmt::MakeWriter;

use crate::printable::plain;

/// Number of lines that wait if standard error cannot be written to. Later ones are lost.
const WAITING: usize = 10_000;

/// Makes writers to standard error.
#[derive(Clone, Debug)]
pub struct Stderr {
    lines: NonBlocking,
    is_journald: bool,
}

impl Stderr {
    /// Finds out whether journald reads standard error. `stream` is the value of `JOURNAL_STREAM`: device and inode of
    /// the stream that systemd created. Standard error may have been redirected since.
    ///
    /// When the guard is dropped, the lines that wait are written, for at most a second.
    pub fn start(stream: Option<&str>) -> (Self, WorkerGuard) {
        let builder = NonBlockingBuilder::default().buffered_lines_limit(WAITING);
        let (lines, guard) = builder.thread_name("log").finish(io::stderr());
        let own = fstat(io::stderr()).ok();
        let own = own.map(|file| format!("{}:{}", file.st_dev, file.st_ino));
        let is_journald = own.is_some() && own.as_deref() == stream;
        (Self { lines, is_journald }, guard)
    }

    fn prefixed(&self, prefix: &'static str) -> Prefixed {
        let lines = self.lines.clone();
        Prefixed { prefix, lines }
    }
}

impl<'a> MakeWriter<'a> for Stderr {
    type Writer = Prefixed;

    fn make_writer(&'a self) -> Prefixed {
        self.prefixed("")
    }

    fn make_writer_for(&'a self, metadata: &Metadata<'_>) -> Prefixed {
        self.prefixed(match *metadata.level() {
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
pub struct Prefixed {
    prefix: &'static str,
    lines: NonBlocking,
}

impl Write for Prefixed {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        self.write_all(line).map(|()| line.len())
    }

    /// Writes the whole line at once, because other processes may write to the same stream.
    fn write_all(&mut self, line: &[u8]) -> io::Result<()> {
        let line = safe(&String::from_utf8_lossy(line));
        self.lines
            .write_all(format!("{}{line}", self.prefix).as_bytes())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Makes a log line [`plain`] but keeps the formatter's colours and the end of the line. The formatter itself escapes ESC
/// in values.
fn safe(line: &str) -> String {
    let (line, end) = match line.strip_suffix('\n') {
        Some(line) => (line, "\n"),
        None => (line, ""),
    };
    let mut parts = line.split('\u{1b}');
    let mut safe = plain(parts.next().unwrap_or_default());
    for part in parts {
        let colour = part
            .strip_prefix('[')
            .map(|colour| colour.trim_start_matches(|c: char| c.is_ascii_digit() || c == ';'));
        let is_colour = colour.is_some_and(|rest| rest.starts_with('m'));
        safe.push(if is_colour { '\u{1b}' } else { '\u{fffd}' });
        safe += &plain(part);
    }
    safe + end
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_of_the_log_keeps_its_colours_only() {
        let line =
            safe("\u{1b}[2mtime\u{1b}[0m \u{1b}[1;33mWARN\u{1b}[0m /a\u{1b}[2J\u{202e}\r\nb\n");
        let shown = "\u{1b}[2mtime\u{1b}[0m \u{1b}[1;33mWARN\u{1b}[0m /a\u{fffd}[2J\u{fffd}\u{fffd}\u{fffd}b\n";
        assert_eq!(line, shown);
    }
}
