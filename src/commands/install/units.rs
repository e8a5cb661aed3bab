//! The texts of the units, made of `packaging/systemd/*.in`. Pure.

use std::{collections::BTreeMap, fmt::Write, net::SocketAddr, path::Path};

const SERVICE: &str = include_str!("../../../packaging/systemd/rosrescue.service.in");
const SOCKET: &str = include_str!("../../../packaging/systemd/rosrescue.socket.in");
const HARDENING: &str = include_str!("../../../packaging/systemd/hardening.in");

/// What differs from robot to robot.
#[derive(Clone, Debug)]
pub(super) struct Units<'a> {
    pub(super) version: &'a str,
    pub(super) program: &'a Path,
    /// `core` or `proxy`, with options.
    pub(super) service: &'a [String],
    /// Who runs it; none for a service of the user's own systemd.
    pub(super) run_as: Option<&'a str>,
    /// ROS's variables.
    pub(super) settings: &'a BTreeMap<String, String>,
    pub(super) environment: &'a str,
    pub(super) listen: &'a [SocketAddr],
    /// Units that want a master when they start.
    pub(super) before: &'a [String],
}

impl Units<'_> {
    pub(super) fn service(&self) -> String {
        let mut command = quoted(&self.program.to_string_lossy(), true);
        for word in self.service {
            let _ = write!(command, " {}", quoted(word, true));
        }
        let before = match self.before {
            [] => String::new(),
            units => format!(
                "# They start roslaunch, which then finds a master.\nBefore={}",
                units.join(" ")
            ),
        };
        let settings = self.settings.iter().map(|(name, value)| {
            let setting = quoted(&format!("{name}={value}"), false);
            format!("Environment={setting}")
        });
        let settings = match settings.collect::<Vec<_>>() {
            lines if lines.is_empty() => String::new(),
            lines => format!(
                "# As it was in the shell that installed it.\n{}",
                lines.join("\n")
            ),
        };
        fill(
            SERVICE,
            &[
                ("ORIGIN", &self.origin()),
                ("BEFORE", &before),
                (
                    "ACCOUNT",
                    &self
                        .run_as
                        .map(|user| format!("User={user}"))
                        .unwrap_or_default(),
                ),
                ("SETTINGS", &settings),
                ("ENVIRONMENT", self.environment),
                ("COMMAND", &command),
                // A user's systemd may do none of this but the one.
                (
                    "HARDENING",
                    self.run_as
                        .map_or("NoNewPrivileges=yes", |_| HARDENING.trim_end()),
                ),
                (
                    "TARGET",
                    self.run_as
                        .map_or("default.target", |_| "multi-user.target"),
                ),
            ],
        )
    }

    pub(super) fn socket(&self) -> String {
        let everywhere = self
            .listen
            .iter()
            .all(|address| address.ip().is_unspecified());
        let lines: Vec<_> = match self.listen {
            [v4, _] if everywhere => vec![format!("ListenStream={}", v4.port())],
            all => all
                .iter()
                .map(|address| format!("ListenStream={address}"))
                .collect(),
        };
        let lines = lines.join("\n");
        fill(SOCKET, &[("ORIGIN", &self.origin()), ("LISTEN", &lines)])
    }

    fn origin(&self) -> String {
        format!(
            "Written by `rosrescue install` of {}. Changes belong into a drop-in: `systemctl edit`.",
            self.version
        )
    }
}

/// Puts values into the places of `template`. A line that is nothing but a place without a value is left out.
fn fill(template: &str, values: &[(&str, &str)]) -> String {
    let mut text = String::new();
    for line in template.lines() {
        let mut line = line.to_owned();
        let mut vanishes = false;
        for (name, value) in values {
            let place = format!("@{name}@");
            vanishes |= value.is_empty() && line == place;
            line = line.replace(&place, value);
        }
        if !vanishes {
            text.push_str(&line);
            text.push('\n');
        }
    }
    text
}

/// One word of a unit's line. `$` is special in commands only.
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

#[cfg(test)]
mod tests {
    use super::*;

    fn units<'a>(settings: &'a BTreeMap<String, String>, listen: &'a [SocketAddr]) -> Units<'a> {
        Units {
            version: "1.2.3",
            program: Path::new("/usr/local/bin/rosrescue"),
            service: &[],
            run_as: Some("robot"),
            settings,
            environment: "/etc/default/rosrescue",
            listen,
            before: &[],
        }
    }

    #[test]
    fn nothing_of_the_templates_is_left() {
        let settings = [("ROS_IP".to_owned(), "10.0.0.7".to_owned())].into();
        let listen = [
            "0.0.0.0:11311".parse().unwrap(),
            "[::]:11311".parse().unwrap(),
        ];
        let service = [
            "core".to_owned(),
            "--checkpoint".to_owned(),
            "/a b/100%$".to_owned(),
        ];
        let mut units = units(&settings, &listen);
        units.service = &service;
        for text in [units.service(), units.socket()] {
            assert!(!text.contains('@') && !text.contains("\n\n\n"), "{text}");
        }
        let service = units.service();
        for line in [
            "User=robot",
            "Environment=ROS_IP=10.0.0.7",
            "ExecStart=/usr/local/bin/rosrescue core --checkpoint \"/a b/100%%$$\"",
            "ProtectSystem=full",
            "WantedBy=multi-user.target",
        ] {
            assert!(service.lines().any(|it| it == line), "{line}: {service}");
        }
        assert!(units.socket().contains("\nListenStream=11311\n"));
    }

    #[test]
    fn a_users_unit_asks_for_nothing_that_a_user_may_not() {
        let (settings, before) = (BTreeMap::new(), ["robot.service".to_owned()]);
        let listen = ["127.0.0.1:1".parse().unwrap(), "[::1]:1".parse().unwrap()];
        let mut units = units(&settings, &listen);
        units.run_as = None;
        units.before = &before;
        let service = units.service();
        for word in [
            "User=",
            "Protect",
            "Capability",
            "OOMScoreAdjust",
            "multi-user",
        ] {
            assert!(!service.contains(word), "{word}: {service}");
        }
        assert!(service.contains("\nBefore=robot.service\n"), "{service}");
        assert!(
            units
                .socket()
                .contains("\nListenStream=127.0.0.1:1\nListenStream=[::1]:1\n")
        );
    }
}
