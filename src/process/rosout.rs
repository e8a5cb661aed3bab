//! rosout, the node that collects the log messages of all nodes.

use std::{
    ffi::OsString,
    io,
    path::{Path, PathBuf},
    process::Stdio,
};

use tokio::process::{Child, Command};

use super::{
    Output, PidFile, command, find_program, is_program, orphan, pid_file::Last, ros_paths, runs,
    start,
};

#[derive(Debug)]
pub(crate) struct Rosout {
    program: PathBuf,
    /// Variables with the paths of its ROS.
    paths: Vec<(&'static str, OsString)>,
    /// Stderr of the last rosout.
    output: Output,
    /// PID file of the last rosout.
    pid_file: PidFile,
    /// The checkpoint's path, which marks the rosouts of this rosrescue in their environment.
    owner: OsString,
}

impl Rosout {
    /// Finds the rosout program. `None` if it is not installed. Its stderr goes to a file next to `checkpoint`. May block
    /// on a slow disk.
    pub(crate) fn find(checkpoint: &Path) -> Option<Self> {
        let rosmaster = find_program("rosmaster", &["bin"]);
        let program = (rosmaster.as_deref().and_then(of_ros_with))
            .or_else(|| find_program("rosout", &["lib/rosout"]))
            // An overlay may have a rosmaster only.
            .or_else(|| of_ros_with(Path::new("/usr/bin/rosmaster")))?;
        Some(Self {
            paths: ros_paths(&program, 3),
            program,
            output: Output::beside(checkpoint, ".rosout-output.log"),
            pid_file: PidFile::beside(checkpoint, "rosout"),
            owner: orphan::owner(checkpoint),
        })
    }

    /// Finds the rosout that an earlier rosrescue with this checkpoint left running. It may not
    /// have registered yet. Blocks for long if all processes must be searched.
    pub(crate) fn find_orphan(&self) -> Option<u32> {
        match self.pid_file.last() {
            Last::Running { pid, .. } => Some(pid).filter(|pid| orphan::is_in_our_network(*pid)),
            Last::Ended => None,
            Last::Unknown => {
                let mut all = orphan::find(&self.owner).into_iter();
                let found = all.find(|pid| runs(*pid, "rosout"))?;
                self.pid_file.write(found, 0);
                Some(found)
            }
        }
    }

    /// Starts rosout as a node of the master at `uri`. It outlives rosrescue: dropping the child
    /// does not end it.
    pub(crate) async fn spawn(&self, uri: &str) -> io::Result<Child> {
        self.output.renew().await;
        let stderr = self.output.file().map_or_else(Stdio::null, Stdio::from);
        let mut command = self.command(uri);
        command.stderr(stderr);
        self.pid_file.clear().await;
        let child = start(command, 0)?;
        if let Some(pid) = child.id() {
            // rosout chooses its ports itself.
            self.pid_file.write(pid, 0);
        }
        Ok(child)
    }

    fn command(&self, uri: &str) -> Command {
        let mut command = command(&self.program);
        command.arg("__name:=rosout").env("ROS_MASTER_URI", uri);
        command.env(orphan::OWNER, &self.owner);
        command.envs(self.paths.iter().cloned());
        command
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .process_group(0);
        command
    }

    /// The last output of the last rosout.
    pub(crate) async fn last_words(&self) -> String {
        self.output.tail().await
    }
}

/// The rosout of the ROS installation that contains `rosmaster`. Only there is the one of a ROS that was built from
/// source or that conda has installed.
fn of_ros_with(rosmaster: &Path) -> Option<PathBuf> {
    let program = rosmaster.ancestors().nth(2)?.join("lib/rosout/rosout");
    is_program(&program).then_some(program)
}

#[cfg(test)]
mod tests {
    use std::ffi::OsStr;

    use super::*;

    #[test]
    fn a_rosout_in_opt_finds_its_libraries() {
        let program = PathBuf::from("/opt/ros/noetic/lib/rosout/rosout");
        let rosout = Rosout {
            paths: ros_paths(&program, 3),
            program,
            output: Output::beside(Path::new(""), ""),
            pid_file: PidFile::beside(Path::new(""), "rosout"),
            owner: OsString::new(),
        };
        let command = rosout.command("http://localhost:1/");
        let mut set = command.as_std().get_envs();
        let (_, paths) = set
            .find(|(name, _)| *name == OsStr::new("LD_LIBRARY_PATH"))
            .unwrap();
        let last = std::env::split_paths(paths.unwrap()).last();
        assert_eq!(last.unwrap(), Path::new("/opt/ros/noetic/lib"));
    }
}
