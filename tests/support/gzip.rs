//! Compression with the gzip program, which every Linux has.

use std::io::Write;
use std::process::{Command, Stdio};
use std::thread;

/// Compresses `bytes`.
#[track_caller]
pub(crate) fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut packer = Command::new("gzip")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .expect("gzip must be installed");
    let mut input = packer.stdin.take().unwrap();
    thread::scope(|scope| {
        scope.spawn(move || input.write_all(bytes).unwrap());
        packer.wait_with_output().unwrap().stdout
    })
}
