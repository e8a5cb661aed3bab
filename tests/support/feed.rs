//! Programs that read their standard input.

use std::io::Write;
use std::process::{Command, Output, Stdio};
use std::thread;

/// Runs `command` with `bytes` as its input.
#[track_caller]
pub(crate) fn feed(command: &mut Command, bytes: &[u8]) -> Output {
    let mut child = command
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap_or_else(|error| panic!("{command:?}: {error}"));
    let mut input = child.stdin.take().unwrap();
    thread::scope(|scope| {
        scope.spawn(move || input.write_all(bytes).unwrap());
        child.wait_with_output().unwrap()
    })
}

/// Compresses `bytes` with the gzip program, which every Linux has.
#[track_caller]
pub(crate) fn gzip(bytes: &[u8]) -> Vec<u8> {
    feed(&mut Command::new("gzip"), bytes).stdout
}
