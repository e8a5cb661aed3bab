//! Draws a text on the terminal again and again.

use std::{
    io::{self, IsTerminal, Read, Write, stdout},
    sync::Mutex,
    thread,
};

use rustix::termios::{
    LocalModes, OptionalActions, SpecialCodeIndex, Termios, tcgetattr, tcgetwinsize, tcsetattr,
};
use tokio::sync::mpsc;

use crate::printable::Printable;

/// Switches to the alternate screen and hides the cursor.
const ENTER: &str = "\x1b[?1049h\x1b[?25l";
const LEAVE: &str = "\x1b[?25h\x1b[?1049l";
/// Columns and rows of a terminal that does not report its size.
const USUAL: (usize, usize) = (80, 24);

/// The terminal's original settings, until they are restored.
static BEFORE: Mutex<Option<Termios>> = Mutex::new(None);

/// A terminal in raw mode. Dropping this value restores the terminal. A panic also restores it, before the panic's
/// message is printed.
pub(super) struct Terminal(());

impl Terminal {
    /// Takes over the terminal. `None` if standard output is not a terminal.
    pub(super) fn enter() -> Option<Self> {
        if !stdout().is_terminal() {
            return None;
        }
        let before = tcgetattr(stdout()).ok()?;
        let mut raw = before.clone();
        // Ctrl-C remains a signal. Ctrl-Z is off: a stopped program would leave the shell on the alternate screen.
        raw.local_modes
            .remove(LocalModes::ICANON | LocalModes::ECHO);
        raw.special_codes[SpecialCodeIndex::VSUSP] = 0;
        tcsetattr(stdout(), OptionalActions::Now, &raw).ok()?;
        if let Ok(mut kept) = BEFORE.lock() {
            *kept = Some(before);
        }
        let report = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            restore();
            report(panic);
        }));
        put(ENTER);
        Some(Self(()))
    }

    /// Shows `text`, cut to the terminal's size.
    pub(super) fn draw(&self, text: &Printable) {
        self.put_lines(text.as_str().lines());
    }

    /// Shows `lines` and under them `text`.
    pub(super) fn draw_under(&self, lines: &[String], text: &Printable) {
        let lines: Vec<_> = lines.iter().map(|line| Printable::line(line)).collect();
        let lines = lines.iter().map(Printable::as_str).chain([""]);
        self.put_lines(lines.chain(text.as_str().lines()));
    }

    fn put_lines<'a>(&self, lines: impl Iterator<Item = &'a str>) {
        let (columns, rows) = size();
        let lines = lines.take(rows);
        let lines: Vec<String> = lines
            .map(|line| line.chars().take(columns).collect())
            .collect();
        // Clearing each line behind its end, and the rest below, avoids flicker.
        put(&format!("\x1b[H{}\x1b[K\x1b[J", lines.join("\x1b[K\r\n")));
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        restore();
    }
}

fn put(text: &str) {
    let mut out = stdout();
    let _ = out.write_all(text.as_bytes()).and_then(|()| out.flush());
}

fn restore() {
    let before = BEFORE.lock().ok().and_then(|mut before| before.take());
    if let Some(before) = before {
        put(LEAVE);
        let _ = tcsetattr(stdout(), OptionalActions::Now, &before);
    }
}

/// Columns and rows.
pub(super) fn size() -> (usize, usize) {
    match tcgetwinsize(stdout()) {
        Ok(size) if size.ws_col > 0 && size.ws_row > 0 => (size.ws_col.into(), size.ws_row.into()),
        _ => USUAL,
    }
}

/// Receives typed bytes.
pub(super) fn keys() -> mpsc::Receiver<u8> {
    let (to, keys) = mpsc::channel(16);
    thread::spawn(move || {
        for byte in io::stdin().lock().bytes().map_while(Result::ok) {
            if to.blocking_send(byte).is_err() {
                return;
            }
        }
    });
    keys
}
