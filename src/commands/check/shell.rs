//! Finds ROS's variables in the files that every new shell reads.

use std::{
    fs,
    path::{Path, PathBuf},
};

/// A variable that a file sets to a fixed value.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct ShellSetting {
    pub(super) file: PathBuf,
    /// Line number, counted from 1.
    pub(super) line: usize,
    pub(super) variable: &'static str,
    pub(super) value: String,
}

const VARIABLES: [&str; 3] = ["ROS_MASTER_URI", "ROS_IP", "ROS_HOSTNAME"];

/// The settings in the files of `shell` in the folder `home`: the last one of each variable.
pub(super) fn settings(home: &Path, shell: &str) -> Vec<ShellSetting> {
    let files: &[&str] = match shell.ends_with("zsh") {
        true => &[".zshrc"],
        false => &[".profile", ".bash_profile", ".bashrc"],
    };
    let found = files.iter().map(|name| home.join(name)).flat_map(|file| {
        let text = fs::read_to_string(&file).unwrap_or_default();
        read(&file, &text)
    });
    let found: Vec<_> = found.collect();
    let last = |variable| found.iter().rfind(|it| it.variable == variable).cloned();
    VARIABLES.into_iter().filter_map(last).collect()
}

fn read(file: &Path, text: &str) -> Vec<ShellSetting> {
    let settings = text.lines().zip(1..).filter_map(|(text, line)| {
        let text = text.trim();
        let assignment = text.strip_prefix("export ").unwrap_or(text).trim_start();
        let (name, value) = assignment.split_once('=')?;
        let variable = VARIABLES.into_iter().find(|variable| *variable == name)?;
        let value = match value.chars().next() {
            Some(quote @ ('"' | '\'')) => value.get(1..)?.split(quote).next()?,
            _ => value.split([' ', ';', '\t', '#']).next()?,
        };
        // The value of a command or of another variable is unknown here.
        let is_fixed = !value.is_empty() && !value.contains(['$', '`']);
        is_fixed.then(|| ShellSetting {
            file: file.to_owned(),
            line,
            variable,
            value: value.to_owned(),
        })
    });
    settings.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_fixed_value_of_each_variable_counts() {
        let folder = tempfile::tempdir().unwrap();
        let text = "# export ROS_IP=1.1.1.1\nexport ROS_IP=10.0.0.1\n  export ROS_IP='10.0.0.2' # old\n\
             ROS_MASTER_URI=\"http://base:11311\"\nexport ROS_HOSTNAME=$(hostname)\nexport ROS_IPV6=on\n";
        fs::write(folder.path().join(".bashrc"), text).unwrap();
        let found = settings(folder.path(), "/bin/bash");
        let found: Vec<_> = found
            .iter()
            .map(|it| (it.variable, &*it.value, it.line))
            .collect();
        let expected = [
            ("ROS_MASTER_URI", "http://base:11311", 4),
            ("ROS_IP", "10.0.0.2", 3),
        ];
        assert_eq!(found, expected);
        assert_eq!(settings(folder.path(), "/bin/zsh"), []);
    }
}
