//! Finds systemd units that start a master or roslaunch.

use std::{
    fs,
    path::{Path, PathBuf},
};

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
    /// The unit runs a roscore, or a rosmaster at port 11311.
    Roscore,
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

/// Classifies a unit by the command that it starts. If the command is a script, as with robot_upstart, its text counts.
fn kind_of(unit: &str) -> Option<UnitKind> {
    let mut found = None;
    for line in unit.lines() {
        if line.trim_start().starts_with("ListenStream=11311") {
            found = Some(UnitKind::Rosrescue);
        }
        let Some(command) = line.trim_start().strip_prefix("ExecStart=") else {
            continue;
        };
        let of_command = words(command);
        let script = command.split_whitespace().next().unwrap_or_default();
        let script = script.trim_start_matches(['-', '@', '+', '!', ':']);
        let of_script = || {
            // roslaunch itself is not read: its arguments show what it does.
            let text = match script.ends_with("roslaunch") {
                true => String::new(),
                false => read(Path::new(script)),
            };
            text.starts_with("#!").then(|| words(&text)).flatten()
        };
        found = found.or(of_command).or_else(of_script);
    }
    found
}

/// Classifies a command line.
fn words(text: &str) -> Option<UnitKind> {
    let lines = text
        .lines()
        .filter(|line| !line.trim_start().starts_with('#'));
    let names: Vec<_> = lines
        .flat_map(|line| line.split(|c: char| c.is_whitespace() || "/;'\"()".contains(c)))
        .collect();
    let has = |name: &str| names.contains(&name);
    let port = names
        .iter()
        .position(|name| ["-p", "--port"].contains(name));
    let port = port.and_then(|at| names.get(at + 1));
    let is_elsewhere = port.is_some_and(|port| *port != "11311");
    match () {
        () if has("rosrescue") => Some(UnitKind::Rosrescue),
        () if has("roscore") || has("rosmaster") => (!is_elsewhere).then_some(UnitKind::Roscore),
        // With --wait, roslaunch starts no master.
        () if has("roslaunch") && !has("--wait") => Some(UnitKind::Roslaunch),
        () => None,
    }
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
                unit("core.service", UnitKind::Roscore, true),
                unit("rescue.service", UnitKind::Rosrescue, false),
                unit("robot.service", UnitKind::Roslaunch, false),
            ]
        );
    }
}
