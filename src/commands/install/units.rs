//! Texts of the systemd units, and of the drop-ins with a robot's own settings.

use std::{collections::BTreeMap, fs, net::SocketAddr, path::Path};

const SERVICE: &str = include_str!("../../../packaging/systemd/rosrescue.service");
const SOCKET: &str = include_str!("../../../packaging/systemd/rosrescue.socket");
/// The first line of every file that `rosrescue install` writes.
pub(super) const MARK: &str = "# Written by `rosrescue install`.";
/// Start of a drop-in line that names a unit disabled by `rosrescue install`.
const DISABLED: &str = "# Disabled: ";

/// Texts of the two units. A user's systemd cannot apply the account and hardening settings.
pub(super) fn units(user: bool) -> [String; 2] {
    let mut service = SERVICE.to_owned();
    if user {
        let common = SERVICE.split_once("\n# From here to [Install]:");
        let (common, rest) = common.unwrap_or((SERVICE, ""));
        let install = rest
            .split_once("\n[Install]")
            .map_or("", |(_, install)| install);
        service = format!("{common}NoNewPrivileges=yes\n\n[Install]{install}")
            .replace("/etc/default/rosrescue", "%h/.config/rosrescue/environment")
            .replace("multi-user.target", "default.target");
    }
    [service, SOCKET.to_owned()].map(|text| format!("{MARK}\n{text}"))
}

/// The settings of one robot.
#[derive(Clone, Debug)]
pub(super) struct UnitSettings<'a> {
    pub(super) program: &'a Path,
    /// `core` or `proxy`, with options.
    pub(super) command: &'a [String],
    /// The user that runs the service. `None` for a user's own systemd.
    pub(super) run_as: Option<&'a str>,
    /// Environment variables of ROS.
    pub(super) settings: &'a BTreeMap<String, String>,
    pub(super) listen: &'a [SocketAddr],
    /// Units that need a master when they start.
    pub(super) before: &'a [String],
    /// Units that rosrescue has replaced.
    pub(super) disabled: &'a [String],
}

impl UnitSettings<'_> {
    /// The drop-in of the service.
    pub(super) fn service(&self) -> String {
        let mut lines = vec![MARK.to_owned()];
        let disabled = self.disabled.iter();
        lines.extend(disabled.map(|unit| format!("{DISABLED}{unit}")));
        if !self.before.is_empty() {
            let before = self.before.join(" ");
            lines.extend([
                "[Unit]".to_owned(),
                "# They run roslaunch, which then finds a master.".to_owned(),
                format!("Before={before}"),
            ]);
        }
        lines.push("[Service]".to_owned());
        if let Some(user) = self.run_as {
            lines.extend(["DynamicUser=no".to_owned(), "StateDirectory=".to_owned()]);
            lines.push(format!("User={user}"));
            // An empty `Environment=` removes all variables of the unit. All but ROS_HOME are set again, because the
            // user has their own ROS_HOME.
            lines.push("Environment=".to_owned());
            let [unit, _] = units(false);
            let variables = unit.lines().filter(|line| {
                line.starts_with("Environment=") && !line.starts_with("Environment=ROS_HOME=")
            });
            lines.extend(variables.map(str::to_owned));
        }
        lines.extend(self.settings.iter().map(|(name, value)| {
            format!("Environment={}", quoted(&format!("{name}={value}"), false))
        }));
        let program = self.program.to_string_lossy();
        let words = [&*program].into_iter();
        let words = words.chain(self.command.iter().map(String::as_str));
        let words: Vec<_> = words.map(|word| quoted(word, true)).collect();
        lines.push("ExecStart=".to_owned());
        lines.push(format!("ExecStart={}\n", words.join(" ")));
        lines.join("\n")
    }

    /// The drop-in of the socket.
    pub(super) fn socket(&self) -> String {
        let addresses = match self.listen {
            [v4, v6] if v4.ip().is_unspecified() && v6.ip().is_unspecified() => {
                vec![v4.port().to_string()]
            }
            all => all.iter().map(ToString::to_string).collect(),
        };
        let lines = addresses
            .iter()
            .map(|address| format!("ListenStream={address}\n"));
        let lines: String = lines.collect();
        format!("{MARK}\n[Socket]\nListenStream=\n{lines}")
    }
}

/// A service as its unit and its drop-in describe it.
#[derive(Debug, Default)]
pub(super) struct InstalledService {
    pub(super) run_as: Option<String>,
    /// Environment variables.
    pub(super) settings: BTreeMap<String, String>,
    /// The program and its arguments.
    pub(super) command: Vec<String>,
}

impl InstalledService {
    /// Reads the unit and `dropin`, which may be empty.
    pub(super) fn read(user: bool, dropin: &str) -> Self {
        let [unit, _] = units(user);
        let mut service = Self::default();
        for line in unit.lines().chain(dropin.lines()) {
            match line.split_once('=') {
                Some(("User", name)) => service.run_as = Some(name.to_owned()),
                Some(("Environment", "")) => service.settings.clear(),
                Some(("Environment", pairs)) => {
                    let pairs = words(pairs, false).into_iter();
                    let pairs = pairs.filter_map(|pair| {
                        let (name, value) = pair.split_once('=')?;
                        Some((name.to_owned(), value.to_owned()))
                    });
                    service.settings.extend(pairs);
                }
                Some(("ExecStart", command)) => service.command = words(command, true),
                _ => {}
            }
        }
        service
    }

    /// Whether both run the same command of the same program, perhaps with other options, as the same user.
    pub(super) fn runs_like(&self, other: &Self) -> bool {
        let [own, others] = [self, other].map(|it| it.command.iter().take(2));
        self.run_as == other.run_as && own.eq(others)
    }
}

/// The ports of the socket unit with the drop-ins in `folder`, also those that others have written.
pub(super) fn ports(folder: &Path) -> Vec<u16> {
    let dropins = fs::read_dir(folder).into_iter().flatten().flatten();
    let texts = dropins.filter_map(|dropin| fs::read_to_string(dropin.path()).ok());
    let ports: Vec<_> = texts.flat_map(|text| ports_in(&text)).collect();
    match ports.is_empty() {
        true => ports_in(SOCKET),
        false => ports,
    }
}

/// The ports of a socket unit or a drop-in.
fn ports_in(unit: &str) -> Vec<u16> {
    let lines = unit.lines();
    let addresses = lines.filter_map(|line| line.strip_prefix("ListenStream="));
    let ports = addresses.map(|address| address.rsplit(':').next().unwrap_or_default().parse());
    ports.filter_map(Result::ok).collect()
}

/// The units that were disabled when this drop-in was written.
pub(super) fn disabled(dropin: &str) -> Vec<String> {
    let units = dropin
        .lines()
        .filter_map(|line| line.strip_prefix(DISABLED));
    units.map(str::to_owned).collect()
}

/// Quotes one word for a unit file. `$` is special only if it is part of a command.
fn quoted(word: &str, command: bool) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "_-+./:=,@".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        return word.to_owned();
    }
    let mut text = String::from('"');
    for letter in word.chars() {
        match letter {
            '"' | '\\' => text.extend(['\\', letter]),
            '%' => text.push_str("%%"),
            '$' if command => text.push_str("$$"),
            _ => text.push(letter),
        }
    }
    text.push('"');
    text
}

/// The words of a line in which each is [`quoted`].
fn words(line: &str, command: bool) -> Vec<String> {
    let (mut words, mut word) = (Vec::new(), String::new());
    let (mut letters, mut is_inside) = (line.chars(), false);
    while let Some(letter) = letters.next() {
        match letter {
            '"' => is_inside = !is_inside,
            ' ' if !is_inside => words.push(std::mem::take(&mut word)),
            '\\' | '%' => word.extend(letters.next()),
            '$' if command => word.extend(letters.next()),
            _ => word.push(letter),
        }
    }
    words.push(word);
    words
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn drop_ins_fit_the_units_to_a_robot() {
        let settings = [("ROS_IP".to_owned(), "10.0.0.7".to_owned())].into();
        let words = |words: &[&str]| {
            words
                .iter()
                .map(|&word| word.to_owned())
                .collect::<Vec<_>>()
        };
        let robot = UnitSettings {
            program: Path::new("/usr/local/bin/rosrescue"),
            command: &words(&["core", "--checkpoint", "/a b/100%$"]),
            run_as: Some("robot"),
            settings: &settings,
            listen: &["0.0.0.0:11411", "[::]:11411"].map(|address| address.parse().unwrap()),
            before: &words(&["robot.service"]),
            disabled: &words(&["roscore.service"]),
        };
        let service = robot.service();
        for line in [
            "Before=robot.service",
            "User=robot",
            "Environment=",
            "Environment=GLIBC_TUNABLES=glibc.malloc.arena_max=1:glibc.malloc.mmap_threshold=131072:glibc.malloc.trim_threshold=131072",
            "Environment=ROS_IP=10.0.0.7",
            "ExecStart=/usr/local/bin/rosrescue core --checkpoint \"/a b/100%%$$\"",
        ] {
            assert!(service.lines().any(|it| it == line), "{line}: {service}");
        }
        assert!(!service.contains("ROS_HOME"), "{service}");
        assert_eq!(disabled(&service), ["roscore.service"]);
        let read = InstalledService::read(false, &service);
        assert_eq!(read.run_as.as_deref(), Some("robot"));
        assert_eq!(read.settings["ROS_IP"], "10.0.0.7");
        assert!(!read.settings.contains_key("ROS_HOME"), "{read:?}");
        assert_eq!(
            read.command,
            words(&[
                "/usr/local/bin/rosrescue",
                "core",
                "--checkpoint",
                "/a b/100%$"
            ])
        );
        let packaged = InstalledService::read(false, "");
        assert_eq!(packaged.settings["ROS_HOME"], "/var/lib/rosrescue");
        assert!(
            robot
                .socket()
                .ends_with("\nListenStream=\nListenStream=11411\n")
        );
        assert_eq!(ports_in(&robot.socket()), [11411]);
        assert_eq!(ports(Path::new("/nowhere")), [11311]);
        let robot = UnitSettings {
            listen: &["127.0.0.1:1", "[::1]:1"].map(|address| address.parse().unwrap()),
            ..robot
        };
        let socket = robot.socket();
        assert!(socket.ends_with("\nListenStream=127.0.0.1:1\nListenStream=[::1]:1\n"));
        assert_eq!(ports_in(&socket), [1, 1]);
    }

    #[test]
    fn a_users_unit_asks_only_for_what_a_user_may_do() {
        let [service, _] = units(true);
        for word in [
            "User=",
            "Protect",
            "Capability",
            "OOMScoreAdjust",
            "Nice",
            "multi-user",
            "/etc/",
        ] {
            assert!(!service.contains(word), "{word}: {service}");
        }
        for word in [
            "\nOOMPolicy=continue\n",
            "\nWantedBy=default.target\n",
            "=-%h/.config/rosrescue/environment",
        ] {
            assert!(service.contains(word), "{word}: {service}");
        }
    }
}
