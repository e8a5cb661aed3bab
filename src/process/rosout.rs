//! rosout, the node that collects the log.

use std::{
    ffi::OsString,
    io,
    path::{Path, PathBuf},
    process::Stdio,
};

use tokio::process::{Child, Command};

use super::{
    add_ros_paths, beside, command, create, find_program, is_program, orphan, runs, tail_of,
};

#[derive(Debug)]
pub(crate) struct Rosout {
    program: PathBuf,
    /// Stderr of the last one.
    output: PathBuf,
    /// Their owner: the checkpoint.
    owner: OsString,
}

impl Rosout {
    /// Finds the program, if there is one. Its stderr goes to a file next to `checkpoint`.
    pub(crate) fn find(checkpoint: &Path) -> Option<Self> {
        let program = find_program("rosout", &["lib/rosout"]).or_else(|| {
            Some(PathBuf::from("/usr/lib/rosout/rosout")).filter(|path| is_program(path))
        })?;
        Some(Self {
            program,
            output: beside(checkpoint, ".rosout-output.log"),
            owner: orphan::owner(checkpoint),
        })
    }

    /// The rosout that an earlier rosrescue with this checkpoint left running. It may not have registered
    /// yet.
    pub(crate) fn left_behind(&self) -> Option<u32> {
        let mut all = orphan::find(&self.owner).into_iter();
        all.find(|pid| runs(*pid, "rosout"))
    }

    /// Starts one as a node of the master at `uri`. It outlives rosrescue: dropping the child does not end
    /// it.
    pub(crate) fn spawn(&self, uri: &str) -> io::Result<Child> {
        let stderr = create(&self.output).map_or_else(|_| Stdio::null(), Stdio::from);
        self.command(uri).stderr(stderr).spawn()
    }

    fn command(&self, uri: &str) -> Command {
        let mut command = command(&self.program);
        command.arg("__name:=rosout").env("ROS_MASTER_URI", uri);
        command.env(orphan::OWNER, &self.owner);
        add_ros_paths(&mut command, &self.program, 3);
        command
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .process_group(0);
        command
    }

    /// The last output of the last one.
    pub(crate) fn last_words(&self) -> String {
        tail_of(&self.output)
    }
}

#[cfg(test)]
mod tests {
    use std::ffi::OsStr;

    use super::*;

    #[test]
    fn a_rosout_in_opt_finds_its_libraries() {
        let rosout = Rosout {
            program: PathBuf::from("/opt/ros/noetic/lib/rosout/rosout"),
            output: PathBuf::new(),
            owner: OsString::new(),
        };
        let command = rosout.command("http://localhost:1/");
        let mut set = command.as_std().get_envs();
        let (_, paths) = set
            .find(|(name, _)| *name == OsStr::new("LD_LIBRARY_PATH"))
            .unwrap();
        let first = std::env::split_paths(paths.unwrap()).next();
        assert_eq!(first.unwrap(), Path::new("/opt/ros/noetic/lib"));
    }
}
