//! A second rosmaster, started exactly as rosrescue has started its own, so that no difference is due to the
//! master.

use std::{
    fs,
    path::Path,
    process::{Child, Command, Stdio},
};

const LOG_CONFIG: &str = "ROS_PYTHON_LOG_CONFIG_FILE";

/// A rosmaster without rosrescue, killed when it is dropped.
#[derive(Debug)]
pub(crate) struct SecondMaster(Child);

impl SecondMaster {
    /// The command line and environment of the rosmaster with process id `of`, except for the port and the
    /// folder of its log.
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
        let pairs = environment.iter().filter_map(|pair| pair.split_once('='));
        let pairs: Vec<_> = pairs.collect();
        command
            .args(&arguments[1..])
            .env_clear()
            .envs(pairs.iter().copied())
            .env("ROS_LOG_DIR", log)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null());
        // Without its logging configuration rosmaster would log nothing and be faster than on any robot. The
        // configuration of rosrescue's own rosmaster is a file that only its child inherits.
        let own = pairs.iter().find(|(name, _)| *name == LOG_CONFIG);
        if let Some(file) = own.and_then(|(_, path)| path.strip_prefix("/proc/self/fd/")) {
            let text = fs::read(format!("/proc/{of}/fd/{file}")).expect("a logging configuration");
            let copy = log.join("second-logging.conf");
            fs::create_dir_all(log).expect("the folder of the log");
            fs::write(&copy, text).expect("a copy of it");
            command.env(LOG_CONFIG, copy);
        }
        command
    }

    /// Starts it without waiting.
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
