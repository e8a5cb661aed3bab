//! Units of others that start a master or roslaunch. Pure.

use serde::Serialize;

/// A unit that has to do with a master.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(super) struct Found {
    pub(super) unit: String,
    pub(super) path: String,
    pub(super) kind: Kind,
    /// Of the user's own systemd.
    pub(super) of_user: bool,
    pub(super) enabled: bool,
    pub(super) active: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Kind {
    /// Runs roscore or rosmaster.
    Master,
    /// Runs roslaunch, which starts a master if it finds none, unless it is told to wait.
    Launch { waits: bool },
}

/// The commands of a unit's text.
pub(super) fn commands(unit: &str) -> Vec<String> {
    let joined = unit.replace("\\\n", " ");
    let lines = joined.lines().map(str::trim);
    let keys = ["ExecStart", "ExecStartPre", "ExecStartPost"];
    lines
        .filter_map(|line| line.split_once('='))
        .filter(|(key, _)| keys.contains(&key.trim()))
        .map(|(_, command)| {
            command
                .trim()
                .trim_start_matches(['-', '@', '+', '!', ':'])
                .to_owned()
        })
        .collect()
}

/// What `text`, a command or a script, starts. A master at another port than `port` is nobody's rival.
pub(super) fn kind(text: &str, port: u16) -> Option<Kind> {
    let code = text
        .lines()
        .filter(|line| !line.trim_start().starts_with('#'));
    let code: Vec<_> = code.collect();
    let code = code.join("\n");
    let split = |c: char| c.is_whitespace() || "'\"`;&|()$=".contains(c);
    let words: Vec<_> = code.split(split).filter(|word| !word.is_empty()).collect();
    let named = |name: &str| {
        words
            .iter()
            .position(|word| word.rsplit('/').next() == Some(name))
    };
    if let Some(at) = named("roscore").or_else(|| named("rosmaster")) {
        let mut after = words.iter().skip(at);
        let other = after.any(|word| ["-p", "--port"].contains(word))
            && after
                .next()
                .and_then(|given| given.parse().ok())
                .is_some_and(|given: u16| given != port);
        return (!other).then_some(Kind::Master);
    }
    named("roslaunch").map(|_| Kind::Launch {
        waits: words.contains(&"--wait"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_of_a_unit() {
        let unit = "[Service]\nExecStart=-/bin/bash -c 'source a && \\\n exec roscore'\n ExecStartPre = +/bin/true\nExecStop=/bin/false\n";
        assert_eq!(
            commands(unit),
            ["/bin/bash -c 'source a &&   exec roscore'", "/bin/true"]
        );
    }

    #[test]
    fn what_starts_a_master_is_known() {
        for (text, expected) in [
            ("/opt/ros/noetic/bin/roscore", Some(Kind::Master)),
            (
                "/bin/bash -c 'source /opt/ros/noetic/setup.bash; roscore'",
                Some(Kind::Master),
            ),
            ("roscore -p 11311", Some(Kind::Master)),
            ("exec rosmaster --core -p 11312 -w 16", None),
            (
                "/usr/bin/roslaunch robot base.launch",
                Some(Kind::Launch { waits: false }),
            ),
            (
                "#!/bin/bash\n# not roscore\nsetuidgid robot roslaunch $LAUNCH --wait &\nPID=$!",
                Some(Kind::Launch { waits: true }),
            ),
            ("/usr/sbin/sshd -D", None),
            ("/usr/bin/prosmaster", None),
        ] {
            assert_eq!(kind(text, 11311), expected, "{text}");
        }
    }
}
