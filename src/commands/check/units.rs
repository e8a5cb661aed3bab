//! Finds systemd units that start a master or roslaunch.

use std::{
    fs,
    path::{Path, PathBuf},
};

use clap::CommandFactory;

use crate::{cli::Cli, ros_env::DEFAULT_MASTER_PORT};

/// Folders of the system's units. A unit in an earlier folder overrides one in a later folder.
const FOLDERS: [&str; 4] = [
    "/etc/systemd/system",
    "/run/systemd/system",
    "/usr/lib/systemd/system",
    "/lib/systemd/system",
];
/// What to do about a unit that runs roslaunch. That of robot_upstart starts a script.
pub(in crate::commands) const ADD_WAIT: &str = "add --wait to its roslaunch, so that it never starts a master \
                                                (robot_upstart: `rosrun robot_upstart install --wait …`)";
/// What to do about a unit that runs a roscore and nodes.
pub(in crate::commands) const REMOVE_ROSCORE: &str = "remove roscore from it, and let it wait for the master \
                                                      (roslaunch --wait, or `rosrescue wait`)";
/// Programs whose arguments name other programs that they do not start.
const LOOKUPS: [&str; 9] = [
    "echo",
    "grep",
    "killall",
    "logger",
    "pgrep",
    "pidof",
    "pkill",
    "printf",
    "systemctl",
];
/// Largest unit or script that is read, in bytes.
const MOST: u64 = 1 << 20;

/// A unit that starts a part of ROS.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(in crate::commands) struct Unit {
    pub(in crate::commands) name: String,
    pub(in crate::commands) kind: UnitKind,
    pub(in crate::commands) is_enabled: bool,
    /// Whether the unit belongs to a user's systemd.
    pub(in crate::commands) is_users: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::commands) enum UnitKind {
    Rosrescue,
    /// The unit runs a roscore or rosmaster at this port.
    Roscore(u16),
    /// The unit runs a roscore or rosmaster at this port, and nodes.
    RoscoreAndNodes(u16),
    /// The unit runs roslaunch, which starts a master if it finds none.
    Roslaunch,
}

/// All units that start a part of ROS, by name.
pub(super) fn find() -> Vec<Unit> {
    let home = std::env::var_os("HOME");
    let users = home.map(|home| Path::new(&home).join(".config/systemd/user"));
    in_folders(users.as_slice(), true)
}

/// The units in `folders`, and those of the system if `of_computer` is true.
pub(in crate::commands) fn in_folders(folders: &[PathBuf], of_computer: bool) -> Vec<Unit> {
    let computers = FOLDERS.iter().filter(|_| of_computer).map(PathBuf::from);
    let folders: Vec<_> = folders.iter().cloned().chain(computers).collect();
    let mut units = Vec::<Unit>::new();
    for folder in &folders {
        for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
            let name = entry.file_name().to_string_lossy().into_owned();
            let is_unit = name.ends_with(".service") || name.ends_with(".socket");
            if !is_unit || units.iter().any(|unit| unit.name == name) {
                continue;
            }
            if let Some(kind) = kind_of(&read(&entry.path())) {
                units.push(Unit {
                    is_enabled: is_enabled(&folders, &name),
                    is_users: !FOLDERS
                        .iter()
                        .any(|of_computer| folder == Path::new(of_computer)),
                    name,
                    kind,
                });
            }
        }
    }
    units.sort_by(|a, b| a.name.cmp(&b.name));
    units
}

/// The text of a small file.
pub(super) fn read(path: &Path) -> String {
    match fs::metadata(path) {
        Ok(metadata) if metadata.is_file() && metadata.len() < MOST => {
            let text = fs::read(path).unwrap_or_default();
            String::from_utf8_lossy(&text).into_owned()
        }
        // A masked unit leads to /dev/null.
        _ => String::new(),
    }
}

/// Classifies a unit by the commands that it starts. If a command is a script, as with robot_upstart, its text counts.
fn kind_of(unit: &str) -> Option<UnitKind> {
    let unit = unit.replace("\\\n", " ");
    let mut text = String::new();
    for line in unit.lines().map(str::trim_start) {
        if line.starts_with("ListenStream=11311") {
            return Some(UnitKind::Rosrescue);
        }
        let Some((_, command)) = line
            .split_once('=')
            .filter(|it| it.0.starts_with("ExecStart"))
        else {
            continue;
        };
        text.extend([command, "\n"]);
        // roslaunch and roscore are scripts, too. Their names show what they do.
        if started_by(command).is_none() && !command.contains("roslaunch") {
            let script = command.split_whitespace().next().unwrap_or_default();
            let script = read(Path::new(
                script.trim_start_matches(['-', '@', '+', '!', ':']),
            ));
            if script.starts_with("#!") {
                text.push_str(&script);
            }
        }
    }
    started_by(&text)
}

/// Classifies a command line or a script.
fn started_by(text: &str) -> Option<UnitKind> {
    let text = text.replace("\\\n", " ");
    let lines = text
        .lines()
        .filter(|line| !line.trim_start().starts_with('#'));
    let commands = lines.flat_map(|line| line.split([';', '&', '|']));
    let commands = commands.map(|command| {
        let words = command.split(|c: char| c.is_whitespace() || "/'\"()".contains(c));
        words.filter(|word| !word.is_empty()).collect::<Vec<_>>()
    });
    let names_only = |words: &Vec<&str>| {
        let is_lookup = words.iter().any(|word| LOOKUPS.contains(word));
        is_lookup || words.iter().take(2).any(|word| *word == "which")
    };
    let commands: Vec<_> = commands.filter(|words| !names_only(words)).collect();
    // The words after the program in each command that has it.
    let after = |program: &'static str| {
        let commands = commands.iter();
        commands.filter_map(move |words| {
            let at = words.iter().rposition(|word| *word == program)?;
            words.get(at + 1..)
        })
    };
    // `rosrescue wait` and the like are no service.
    let cli = Cli::command();
    let is_tool = |word: &&str| {
        let mut all = cli.get_subcommands().map(clap::Command::get_name);
        !["core", "proxy"].contains(word) && all.any(|name| name == *word)
    };
    if after("rosrescue").any(|words| !words.first().is_some_and(is_tool)) {
        return Some(UnitKind::Rosrescue);
    }
    let mut masters = after("roscore").chain(after("rosmaster"));
    let runs_nodes = ["roslaunch", "rosrun"].map(|program| after(program).next().is_some());
    match (masters.next().and_then(port), runs_nodes) {
        (Some(port), [false, false]) => Some(UnitKind::Roscore(port)),
        (Some(port), _) => Some(UnitKind::RoscoreAndNodes(port)),
        // With --wait, roslaunch starts no master.
        (None, _) => after("roslaunch")
            .any(|words| !words.contains(&"--wait"))
            .then_some(UnitKind::Roslaunch),
    }
}

/// The port in the arguments of a roscore or rosmaster. `None` if it is not a number, as with a variable.
fn port(arguments: &[&str]) -> Option<u16> {
    let mut words = arguments.iter();
    while let Some(word) = words.next() {
        let value = match *word {
            "-p" | "--port" => words.next().copied(),
            _ => word
                .strip_prefix("--port=")
                .or_else(|| word.strip_prefix("-p")),
        };
        if let Some(value) = value {
            return value.parse().ok();
        }
    }
    Some(DEFAULT_MASTER_PORT)
}

fn is_enabled(folders: &[PathBuf], name: &str) -> bool {
    folders.iter().any(|folder| {
        let entries = fs::read_dir(folder).into_iter().flatten().flatten();
        let mut wants = entries.map(|entry| entry.path()).filter(|path| {
            let end = path.extension().unwrap_or_default();
            end == "wants" || end == "requires"
        });
        wants.any(|wants| wants.join(name).symlink_metadata().is_ok())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_are_known_by_what_they_start() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let script = path("robot-start");
        fs::write(
            &script,
            "#!/bin/bash\n# roscore is not started here\nroslaunch /tmp/x.launch &\n",
        )
        .unwrap();
        let start = format!("[Service]\nExecStart={}\n", script.display());
        for (name, text) in [
            (
                "core.service",
                "ExecStart=/bin/sh -c '. /opt/ros/noetic/setup.sh; roscore'",
            ),
            ("rescue.service", "ExecStart=/usr/local/bin/rosrescue core"),
            ("robot.service", &start),
            (
                "waits.service",
                "ExecStart=/usr/bin/roslaunch --wait a b.launch",
            ),
            ("other.service", "ExecStart=/usr/bin/other roscored"),
            ("behind.service", "ExecStart=rosmaster --core -p 11312"),
            (
                "both.service",
                "ExecStart=/bin/bash -c 'mkdir -p /var/log/robot; \\\n roscore -p11411 & roslaunch --wait a b.launch'",
            ),
            (
                "looks.service",
                "ExecStart=/bin/sh -c 'until pgrep roscore; do sleep 1; done; roslaunch --wait a b.launch'",
            ),
            (
                "echo.service",
                "ExecStart=/bin/sh -c 'echo Waiting for roscore; if which roscore; then rosrun a b; fi'",
            ),
            (
                "found.service",
                "ExecStart=/bin/sh -c 'exec $(which roslaunch) a b.launch'",
            ),
            (
                "launched.service",
                "ExecStart=/bin/sh -c 'roslaunch rosrescue core.launch'",
            ),
            (
                "own.service",
                "ExecStart=/opt/rosrescue/bin/rosrescue $OPTIONS",
            ),
            (
                "two.service",
                "ExecStart=/opt/ros/noetic/bin/roscore\nExecStartPost=/bin/sh -c 'rosrun a b'",
            ),
            (
                "waiting.service",
                "ExecStart=/bin/sh -c 'rosrescue wait && roslaunch --wait a b.launch'",
            ),
            ("notes.txt", "ExecStart=roscore"),
        ] {
            fs::write(path(name), text).unwrap();
        }
        fs::create_dir(path("multi-user.target.wants")).unwrap();
        let link = path("multi-user.target.wants/core.service");
        std::os::unix::fs::symlink(path("core.service"), link).unwrap();
        let unit = |name: &str, kind, is_enabled| Unit {
            name: name.to_owned(),
            kind,
            is_enabled,
            is_users: true,
        };
        assert_eq!(
            in_folders(&[folder.path().to_owned()], false),
            [
                unit("behind.service", UnitKind::Roscore(11312), false),
                unit("both.service", UnitKind::RoscoreAndNodes(11411), false),
                unit("core.service", UnitKind::Roscore(11311), true),
                unit("found.service", UnitKind::Roslaunch, false),
                unit("launched.service", UnitKind::Rosrescue, false),
                unit("own.service", UnitKind::Rosrescue, false),
                unit("rescue.service", UnitKind::Rosrescue, false),
                unit("robot.service", UnitKind::Roslaunch, false),
                unit("two.service", UnitKind::RoscoreAndNodes(11311), false),
            ]
        );
    }
}
