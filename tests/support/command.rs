//! The commands of rosrescue that do not serve, as a person runs them.

use std::process::Command;

use super::scratch::Scratch;

/// How a command has ended.
#[derive(Debug)]
pub(crate) struct Ran {
    pub(crate) exit: i32,
    pub(crate) stdout: String,
    pub(crate) stderr: String,
}

impl Ran {
    /// What it printed, as JSON.
    #[track_caller]
    pub(crate) fn json(&self) -> serde_json::Value {
        serde_json::from_str(&self.stdout).unwrap_or_else(|error| panic!("{error}: {self:?}"))
    }
}

/// `rosrescue ARGUMENTS`, with `ROS_MASTER_URI` for the port.
pub(crate) fn command(scratch: &Scratch, port: u16, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_rosrescue"));
    scratch.prepare(&mut command);
    command.env("ROS_MASTER_URI", format!("http://127.0.0.1:{port}"));
    command.args(arguments).current_dir(scratch.path(""));
    command
}

/// Runs it to its end.
#[track_caller]
pub(crate) fn run(scratch: &Scratch, port: u16, arguments: &[&str]) -> Ran {
    let output = command(scratch, port, arguments).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    Ran {
        exit: output.status.code().expect("an exit status"),
        stdout: text(output.stdout),
        stderr: text(output.stderr),
    }
}
