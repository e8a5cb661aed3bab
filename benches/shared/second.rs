//! A second rosmaster, started just as rosrescue started its own: what differs is not the master.

use std::{
    fs,
    path::Path,
    process::{Child, Command, Stdio},
};

/// A rosmaster without rosrescue, killed when it is dropped.
#[derive(Debug)]
pub(crate) struct SecondMaster(Child);

impl SecondMaster {
    /// The command line and environment of the rosmaster with this process id, but for the port and
    /// the folder of the log.
    pub(crate) fn command(of: u32, port: u16, log: &Path) -> Command {
        let read = |file: &str| {
            let text =
                fs::read_to_string(format!("/proc/{of}/{file}")).expect("the master's process");
            let words = text.split_terminator('\0').map(str::to_owned);
            words.collect::<Vec<_>>()
        };
        let (mut arguments, environment) = (read("cmdline"), read("environ"));
        let place = arguments.iter().position(|word| word == "-p");
        if let Some(place) = place {
            arguments.drain(place..place + 2);
        }
        arguments.extend(["-p".to_owned(), port.to_string()]);
        let mut command = Command::new(&arguments[0]);
        command
            .args(&arguments[1..])
            .env_clear()
            .envs(environment.iter().filter_map(|pair| pair.split_once('=')))
            .env("ROS_LOG_DIR", log)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null());
        command
    }

    /// Starts it and waits for nothing.
    pub(crate) fn spawn(command: &mut Command) -> Self {
        Self(command.spawn().expect("a second rosmaster"))
    }
}

impl Drop for SecondMaster {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
