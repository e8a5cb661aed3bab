//! Where the log goes: to standard error. If that is journald, each line begins with its priority, as
//! `sd-daemon(3)` says, so that `journalctl -p warning` works and colours are right.

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
    /// Finds out who reads it. `stream`: the value of `JOURNAL_STREAM`, device and inode of what systemd has given us;
    /// standard error may have been redirected since.
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

/// Writes one line with this before it.
#[derive(Debug)]
pub struct Prefixed(&'static str);

impl Write for Prefixed {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        self.write_all(line).map(|()| line.len())
    }

    /// All of it at once: other processes may write to the same stream.
    fn write_all(&mut self, line: &[u8]) -> io::Result<()> {
        match self.0 {
            "" => io::stderr().write_all(line),
            prefix => io::stderr().write_all(&[prefix.as_bytes(), line].concat()),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
