//! ROS's programs: finds them, and prepares the commands that run them.

use std::{
    ffi::{OsStr, OsString},
    path::{Path, PathBuf},
    process::Stdio,
    time::Duration,
};

use tokio::process::Command;

use crate::guardian::handover;

/// The PATH that systemd gives to services.
pub(crate) const SERVICE_PATH: &str =
    "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin";

/// Where ROS installs programs that are not on the PATH.
const ROS_PREFIXES: &str = "/opt/ros";

/// The interpreter and its arguments in the first line of `program`, if it is a Python script.
pub(crate) fn interpreter(program: &Path) -> Option<Vec<String>> {
    let text = std::fs::read(program).ok()?;
    let line = text.split(|byte| *byte == b'\n').next()?;
    let words = std::str::from_utf8(line).ok()?.strip_prefix("#!")?;
    let words: Vec<_> = words.split_whitespace().map(str::to_owned).collect();
    let is_python = |word: &String| word.rsplit('/').next()?.strip_prefix("python").map(drop);
    words.last().and_then(is_python).map(|()| words)
}

/// A command that runs `python` without output, with the paths of the ROS installation that
/// contains `program`.
pub(crate) fn python(python: &Path, program: &Path) -> Command {
    let mut command = command(python);
    command.envs(ros_paths(program, 2));
    command.stdin(Stdio::null()).kill_on_drop(true);
    command
}

/// A command that runs `program` without the variables that are meant for rosrescue alone.
pub(super) fn command(program: &Path) -> Command {
    let mut command = Command::new(program);
    handover::keep_from(command.as_std_mut());
    command
}

/// The variables with the paths of the ROS installation in `/opt/ros` that contains `program`. ROS's programs need these
/// paths to find modules and libraries. A shell has them from `setup.bash`, a service does not. `depth` is the number of
/// folders between the installation and the program. Reads folders, so it may block.
pub(super) fn ros_paths(program: &Path, depth: usize) -> Vec<(&'static str, OsString)> {
    let Some(prefix) = program
        .ancestors()
        .nth(depth)
        .filter(|p| p.starts_with(ROS_PREFIXES))
    else {
        return Vec::new();
    };
    let libraries = prefix.join("lib");
    let modules = python_folders(&libraries);
    let all = [
        ("PYTHONPATH", modules),
        ("LD_LIBRARY_PATH", vec![libraries]),
    ];
    let joined = all.into_iter().filter_map(|(variable, folders)| {
        let own = std::env::var_os(variable).unwrap_or_default();
        // An overlay of the shell comes first, as for roscore.
        let paths = std::env::split_paths(&own).chain(folders);
        let paths = paths.filter(|path| !path.as_os_str().is_empty());
        Some((variable, std::env::join_paths(paths).ok()?))
    });
    joined.collect()
}

/// Names the ROS installation in `/opt/ros` that contains `rosmaster`, as its `setup.bash` does, unless the environment
/// names one. A service has no shell, and without these variables `rosversion` knows neither ROS nor its packages.
fn name_ros(command: &mut Command, rosmaster: &Path) {
    let prefix = rosmaster.ancestors().nth(2);
    let Some(prefix) = prefix.filter(|prefix| prefix.starts_with(ROS_PREFIXES)) else {
        return;
    };
    let distribution = prefix.file_name().unwrap_or_default().to_owned();
    for (variable, value) in [
        ("ROS_DISTRO", distribution),
        ("ROS_PACKAGE_PATH", prefix.join("share").into()),
    ] {
        if std::env::var_os(variable).is_none() {
            command.env(variable, value);
        }
    }
}

/// The folders of Python modules in `lib` of a ROS installation: `python2.7/dist-packages` in ROS's packages up to
/// Melodic, `python3/dist-packages` in Noetic's, `site-packages` on some other systems.
fn python_folders(lib: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(lib).into_iter().flatten().flatten();
    let pythons =
        entries.filter(|entry| entry.file_name().as_encoded_bytes().starts_with(b"python"));
    let folders = pythons.flat_map(|python| {
        ["dist-packages", "site-packages"].map(|folder| python.path().join(folder))
    });
    let mut folders: Vec<_> = folders.filter(|folder| folder.is_dir()).collect();
    folders.sort();
    folders
}

/// The output of `program`, if it ends within `limit`, in the form that roslaunch's `command=` would use.
pub(crate) async fn output_of(
    program: &str,
    arguments: &[&str],
    limit: Duration,
) -> Option<String> {
    let mut command = command(&find_program(program, &["bin"])?);
    if let Some(rosmaster) = find_program("rosmaster", &["bin"]) {
        name_ros(&mut command, &rosmaster);
    }
    command
        .args(arguments)
        .stdin(Stdio::null())
        .stderr(Stdio::null())
        .kill_on_drop(true);
    let output = tokio::time::timeout(limit, command.output())
        .await
        .ok()?
        .ok()?;
    output
        .status
        .success()
        .then(|| String::from_utf8_lossy(&output.stdout).into_owned())
}

/// Finds a program on the PATH, or else in one of `folders` of a ROS installation.
pub(crate) fn find_program(name: &str, folders: &[&str]) -> Option<PathBuf> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    find_program_on(&path, name, folders)
}

pub(super) fn find_program_on(path: &OsStr, name: &str, folders: &[&str]) -> Option<PathBuf> {
    let on_path = std::env::split_paths(path)
        .map(|folder| folder.join(name))
        .find(|p| is_program(p));
    on_path.or_else(|| {
        let mut distributions: Vec<_> = std::fs::read_dir(ROS_PREFIXES)
            .ok()?
            .flatten()
            .map(|entry| entry.path())
            .collect();
        // Newer distributions have later names (kinetic, melodic, noetic), so the last name is tried first.
        distributions.sort();
        let candidates = distributions.iter().rev();
        let mut programs =
            candidates.flat_map(|prefix| folders.iter().map(|f| prefix.join(f).join(name)));
        programs.find(|path| is_program(path))
    })
}

pub(super) fn is_program(path: &Path) -> bool {
    use std::os::unix::fs::PermissionsExt;
    path.metadata()
        .is_ok_and(|meta| meta.is_file() && meta.permissions().mode() & 0o111 != 0)
}

#[cfg(test)]
mod tests {
    use std::{collections::HashMap, ffi::OsString};

    use super::*;

    #[test]
    fn the_modules_of_each_python_are_found() {
        let prefix = tempfile::tempdir().unwrap();
        assert!(python_folders(prefix.path()).is_empty());
        let folders = ["python2.7/dist-packages", "python3/dist-packages"];
        let folders = folders.map(|folder| prefix.path().join(folder));
        for folder in folders.iter().chain([&prefix.path().join("python3.8")]) {
            std::fs::create_dir_all(folder).unwrap();
        }
        assert_eq!(python_folders(prefix.path()), folders);
    }

    /// The variables that `prepare` sets.
    fn variables(prepare: impl FnOnce(&mut Command)) -> HashMap<OsString, OsString> {
        let mut command = Command::new("program");
        prepare(&mut command);
        let set = command.as_std().get_envs();
        let set = set.filter_map(|(name, value)| Some((name.to_owned(), value?.to_owned())));
        set.collect()
    }

    #[test]
    fn a_ros_in_opt_is_named_unless_the_shell_names_one() {
        let named = |program: &str| variables(|command| name_ros(command, Path::new(program)));
        let set = named("/opt/ros/melodic/bin/rosmaster");
        for (variable, value) in [
            ("ROS_DISTRO", "melodic"),
            ("ROS_PACKAGE_PATH", "/opt/ros/melodic/share"),
        ] {
            let is_ours = std::env::var_os(variable).is_none();
            let expected = is_ours.then(|| OsString::from(value));
            assert_eq!(set.get(OsStr::new(variable)), expected.as_ref());
        }
        assert!(named("/usr/bin/rosmaster").is_empty());
    }

    #[test]
    fn a_ros_in_opt_gets_its_own_paths() {
        let set = ros_paths(Path::new("/opt/ros/noetic/bin/rosmaster"), 2);
        let (_, libraries) = set
            .iter()
            .find(|(name, _)| *name == "LD_LIBRARY_PATH")
            .unwrap();
        let last = std::env::split_paths(libraries).last();
        assert_eq!(last.unwrap(), Path::new("/opt/ros/noetic/lib"));
        assert!(ros_paths(Path::new("/usr/bin/rosmaster"), 2).is_empty());
    }
}
