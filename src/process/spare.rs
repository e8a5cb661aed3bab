//! A spare rosmaster: a process that has loaded the program and waits to be told its port. It needs a tenth of
//! the time of a new one.

use std::{fs, path::Path, process::Stdio, time::Duration};

use rustix::process::Signal;
use tokio::{
    io::AsyncWriteExt,
    process::{Child, ChildStdin},
};

use super::{Rosmaster, command, listeners, signal_process};
use crate::limit::rarely;

/// A spare that does not listen after this time hangs: another master is started.
const LIMIT: Duration = Duration::from_secs(3);

/// What Python runs: it loads what rosmaster needs, waits for the port, and then runs the installed program as
/// it is. The end of the input means that rosrescue has ended.
const PROGRAM: &str = "\
import runpy, sys
import rosmaster.main, rosgraph.roslogging, rosgraph.xmlrpc, logging.config, logging.handlers
port = sys.stdin.readline().strip()
if not port:
    sys.exit()
del sys.argv[0]
sys.argv += ['-p', port]
runpy.run_path(sys.argv[0], run_name='__main__')
";

/// The interpreter and its arguments in the first line of `program`, if it is a Python script.
pub(crate) fn interpreter(program: &Path) -> Option<Vec<String>> {
    let text = fs::read(program).ok()?;
    let line = text.split(|byte| *byte == b'\n').next()?;
    let words = std::str::from_utf8(line).ok()?.strip_prefix("#!")?;
    let words: Vec<_> = words.split_whitespace().map(str::to_owned).collect();
    let is_python = |word: &String| word.rsplit('/').next()?.strip_prefix("python").map(drop);
    words.last().and_then(is_python).map(|()| words)
}

impl Rosmaster {
    /// Starts a spare, if one is wanted and the program is ROS's own.
    pub(crate) async fn spawn_spare(&self) -> Option<Spare> {
        if !self.config.spare {
            return None;
        }
        let interpreter = self.is_own().then(|| interpreter(&self.program)).flatten();
        let Some(interpreter) = interpreter else {
            rarely!(
                info,
                "no spare rosmaster: only ROS's own program can have one"
            );
            return None;
        };
        let mut words = interpreter.iter();
        let mut command = command(Path::new(words.next()?));
        command.args(words).arg("-c").arg(PROGRAM);
        command.arg(&self.program).arg("--core");
        command.stdin(Stdio::piped());
        // The last words of the present master stay.
        if self.output.file().is_none() {
            self.output.renew().await;
        }
        match self.spawn_as(command).await {
            Ok(child) => Spare::new(child),
            Err(error) => {
                rarely!(warn, %error, "no spare rosmaster: the next one takes longer to start");
                None
            }
        }
    }
}

/// The waiting process. Ends when it is dropped.
#[derive(Debug)]
pub(crate) struct Spare(Option<(Child, ChildStdin)>);

impl Spare {
    /// None if `child` has no input.
    fn new(mut child: Child) -> Option<Self> {
        let input = child.stdin.take()?;
        Some(Self(Some((child, input))))
    }

    /// Makes it a master at `port`. None if it has ended.
    pub(crate) fn go(mut self, port: u16) -> Option<Child> {
        let (mut child, mut input) = self.0.take()?;
        if !matches!(child.try_wait(), Ok(None)) {
            return None;
        }
        let pid = child.id()?;
        tokio::spawn(async move {
            // If it ends meanwhile, that is reported as the end of a master.
            let _ = input.write_all(format!("{port}\n").as_bytes()).await;
            drop(input);
            tokio::time::sleep(LIMIT).await;
            if is_spare(pid) && !listeners::listens(pid, port) {
                rarely!(
                    warn,
                    pid,
                    "the spare rosmaster does not listen, and is ended; another one is started"
                );
                signal_process(pid, Signal::KILL);
            }
        });
        Some(child)
    }
}

impl Drop for Spare {
    fn drop(&mut self) {
        if let Some((child, _)) = &mut self.0 {
            // Also where it hangs and does not read its input.
            let _ = child.start_kill();
        }
    }
}

/// Whether the process `pid` was started as a spare. A remembered pid may belong to another process by now.
fn is_spare(pid: u32) -> bool {
    let command_line = fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
    command_line
        .split(|byte| *byte == 0)
        .any(|argument| argument == PROGRAM.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_python_script_has_a_spare() {
        let folder = tempfile::tempdir().unwrap();
        let program = folder.path().join("rosmaster");
        let of = |text: &str| {
            fs::write(&program, text).unwrap();
            interpreter(&program)
        };
        assert_eq!(of("#!/usr/bin/python3\n1").unwrap(), ["/usr/bin/python3"]);
        assert_eq!(
            of("#! /usr/bin/env python3\n").unwrap(),
            ["/usr/bin/env", "python3"]
        );
        assert_eq!(of("#!/bin/sh\n"), None);
        assert_eq!(of("\x7fELF"), None);
        assert_eq!(interpreter(Path::new("/nowhere")), None);
    }
}
