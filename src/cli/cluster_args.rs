//! Options of `core` for several computers.

use std::{path::PathBuf, time::Duration};

use clap::{Args, ValueEnum};
use http::uri::Authority;

/// Heading of the options for several computers.
const COMPUTERS: &str = "Options with --cluster";
/// The robot's name in etcd if `--cluster` gives none.
pub(crate) const ROBOT: &str = "robot";
/// Longest name of a robot or a computer. It is part of each key in etcd.
const NAME_MOST: usize = 128;

/// The options for a robot with several computers that can lead.
#[derive(Args, Clone, Debug)]
pub struct ClusterArgs {
    /// Run on several computers: one leads, and another takes over when it dies. Give the etcd members and the
    /// robot's name, as in http://a:2379,http://b:2379,http://c:2379/ROBOT
    #[arg(long, env = "ROSRESCUE_CLUSTER", value_name = "URLS")]
    #[arg(value_parser = members)]
    pub cluster: Option<ClusterArg>,
    /// Address where the other computers reach this one, HOST or HOST:PORT [default: the host and port of the
    /// ROS_MASTER_URI that rosrescue prints]
    #[arg(long, env = "ROSRESCUE_ADVERTISE", value_name = "HOST", help_heading = COMPUTERS)]
    #[arg(requires = "cluster")]
    pub advertise: Option<String>,
    /// Unique name of this computer [default: host name and address, as in arm-10.0.0.2]
    #[arg(long, env = "ROSRESCUE_CLUSTER_NAME", value_name = "NAME", help_heading = COMPUTERS)]
    #[arg(value_parser = name, requires = "cluster")]
    pub cluster_name: Option<String>,
    /// Take over when the leader has been silent for this long, in seconds from 0.5 to 60. Use the same value on
    /// all computers
    #[arg(long, env = "ROSRESCUE_CLUSTER_TTL", value_name = "SECONDS", help_heading = COMPUTERS)]
    #[arg(default_value = "2", value_parser = ttl, requires = "cluster")]
    pub cluster_ttl: Duration,
    /// When the leader answers a write
    #[arg(long, env = "ROSRESCUE_CLUSTER_SYNC", value_enum, requires = "cluster", help_heading = COMPUTERS)]
    #[arg(default_value_t = ClusterSync::Always)]
    pub cluster_sync: ClusterSync,
    /// What to do with writes while this computer is cut off from the others. It still answers reads
    #[arg(long, env = "ROSRESCUE_ALONE", value_enum, requires = "cluster", help_heading = COMPUTERS)]
    #[arg(default_value_t = WhenCutOff::Serve)]
    pub alone: WhenCutOff,
    /// CA certificate of etcd, a PEM file, for https
    #[arg(long, env = "ROSRESCUE_CLUSTER_CA", value_name = "FILE", help_heading = COMPUTERS)]
    #[arg(requires = "cluster")]
    pub cluster_ca: Option<PathBuf>,
    /// Certificate of this computer for etcd, a PEM file
    #[arg(long, env = "ROSRESCUE_CLUSTER_CERT", value_name = "FILE", help_heading = COMPUTERS)]
    #[arg(requires_all = ["cluster_key", "cluster_ca"])]
    pub cluster_cert: Option<PathBuf>,
    /// Private key of this computer's certificate, a PEM file
    #[arg(long, env = "ROSRESCUE_CLUSTER_KEY", value_name = "FILE", help_heading = COMPUTERS)]
    #[arg(requires = "cluster_cert")]
    pub cluster_key: Option<PathBuf>,
    /// User name for etcd
    #[arg(long, env = "ROSRESCUE_CLUSTER_USER", value_name = "NAME", help_heading = COMPUTERS)]
    #[arg(requires_all = ["cluster_password_file", "cluster"])]
    pub cluster_user: Option<String>,
    /// File with the password for etcd in its first line
    #[arg(long, env = "ROSRESCUE_CLUSTER_PASSWORD_FILE", value_name = "FILE", help_heading = COMPUTERS)]
    #[arg(requires = "cluster_user")]
    pub cluster_password_file: Option<PathBuf>,
}

/// When the leader answers a write.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ClusterSync {
    /// After a majority of etcd has stored it: the death of a computer loses no answered write
    Always,
    /// At once. etcd has it 200 ms later: the death of the leader can lose the writes in between
    Interval,
}

/// What a computer does with writes while it is cut off from the others.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum WhenCutOff {
    /// Answer them, and send them to the leader afterwards. Changes by others win
    Serve,
    /// Writes wait, and fail after --hold
    Refuse,
}

/// The parsed value of `--cluster`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ClusterArg {
    /// The etcd endpoints, each `http://HOST:PORT` or `https://HOST:PORT`, all with the same scheme.
    pub endpoints: Vec<String>,
    pub robot: String,
}

/// Parses `http://A:2379,http://B:2379,http://C:2379/ROBOT`. Endpoints without a scheme get that of the first one.
fn members(text: &str) -> Result<ClusterArg, String> {
    let mut first = None;
    let mut robot = ROBOT;
    let mut endpoints = Vec::new();
    let mut given = text.split(',').map(str::trim).peekable();
    while let Some(one) = given.next() {
        let (scheme, rest) = match one.split_once("://") {
            Some((scheme, rest)) => (scheme, rest),
            None => (first.unwrap_or_default(), one),
        };
        if !["http", "https"].contains(&scheme) {
            return Err(format!(
                "`{one}` is not an etcd endpoint: it must begin with http:// or https://"
            ));
        }
        let first = *first.get_or_insert(scheme);
        if scheme != first {
            return Err(format!(
                "`{one}` begins with {scheme}://, but the first endpoint with {first}://; use the same for all"
            ));
        }
        let (authority, path) = rest.split_once('/').unwrap_or((rest, ""));
        if !is_authority(authority) {
            return Err(format!(
                "`{one}` is not an etcd endpoint; write {scheme}://HOST:PORT, as in \
                 {scheme}://10.0.0.7:2379"
            ));
        }
        if !path.is_empty() {
            if given.peek().is_some() {
                return Err(format!(
                    "`{one}`: write the robot's name only after the last endpoint"
                ));
            }
            robot = path.trim_end_matches('/');
        }
        endpoints.push(format!("{scheme}://{authority}"));
    }
    Ok(ClusterArg {
        endpoints,
        robot: name(robot).map_err(|why| format!("`{robot}` is not a valid robot name: {why}"))?,
    })
}

/// Whether `text` is `HOST` or `HOST:PORT`.
fn is_authority(text: &str) -> bool {
    let Ok(authority) = text.parse::<Authority>() else {
        return false;
    };
    let host = authority.host();
    !host.is_empty()
        && match authority.port_u16() {
            Some(port) => port != 0 && text == format!("{host}:{port}"),
            None => text == host,
        }
}

/// Parses the name of a robot or a computer. It must not contain a slash: names are parts of etcd keys.
pub(crate) fn name(text: &str) -> Result<String, &'static str> {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
    match !text.is_empty() && text.len() <= NAME_MOST && text.chars().all(is_plain) {
        true => Ok(text.to_owned()),
        false => Err("write 1 to 128 letters, digits, `-`, `_` and `.`, as in robot-7"),
    }
}

fn ttl(text: &str) -> Result<Duration, &'static str> {
    let seconds = text.parse().ok();
    let seconds = seconds.filter(|seconds| (0.5..=60.0).contains(seconds));
    let ttl = seconds.and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    ttl.ok_or("write a number of seconds from 0.5 to 60")
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::cli::{Cli, Command};

    #[test]
    fn members_and_the_name_of_the_robot() {
        for (text, endpoints, robot) in [
            ("http://a:2379", &["http://a:2379"][..], "robot"),
            ("http://a:2379/", &["http://a:2379"], "robot"),
            (
                "http://a:2379,http://b:2379,http://c:2379/r-7",
                &["http://a:2379", "http://b:2379", "http://c:2379"],
                "r-7",
            ),
            (
                "https://a:2379, b , [fd00::1]:2380/r/",
                &["https://a:2379", "https://b", "https://[fd00::1]:2380"],
                "r",
            ),
        ] {
            let expected = ClusterArg {
                endpoints: endpoints.iter().map(|url| (*url).to_owned()).collect(),
                robot: robot.to_owned(),
            };
            assert_eq!(members(text), Ok(expected), "{text}");
        }
    }

    #[test]
    fn what_are_no_members_is_said_with_the_operand() {
        for (text, said) in [
            ("", "`` is not an etcd endpoint: it must begin with"),
            ("a:2379,http://b:2379", "`a:2379` is not an etcd endpoint"),
            ("ftp://a:2379", "`ftp://a:2379` is not an etcd endpoint"),
            (
                "http://",
                "`http://` is not an etcd endpoint; write http://HOST:PORT",
            ),
            ("http://:2379", "`http://:2379` is not an etcd endpoint"),
            ("http://a:0", "`http://a:0` is not an etcd endpoint"),
            ("http://a:70000", "`http://a:70000` is not an etcd endpoint"),
            ("http://u:p@a:2379", "is not an etcd endpoint"),
            ("http://::1:2379", "is not an etcd endpoint"),
            ("http://a:2379,", "`` is not an etcd endpoint"),
            (
                "https://a:1,http://b:1",
                "`http://b:1` begins with http://, but the first endpoint with https://",
            ),
            (
                "http://a:1/r,http://b:1",
                "`http://a:1/r`: write the robot's name only after the last",
            ),
            ("http://a:1/fleet/r", "`fleet/r` is not a valid robot name"),
            ("http://a:1/r 7", "`r 7` is not a valid robot name"),
            ("http://a:1/r?x", "`r?x` is not a valid robot name"),
        ] {
            let error = members(text).expect_err(text);
            assert!(error.contains(said), "{error}");
        }
    }

    #[test]
    fn a_time_to_live_is_long_enough_for_etcd_and_short_enough_for_a_robot() {
        assert_eq!(ttl("0.5"), Ok(Duration::from_millis(500)));
        assert_eq!(ttl("60"), Ok(Duration::from_secs(60)));
        for text in ["", "0.4", "60.1", "-1", "nan", "inf", "2s"] {
            assert!(ttl(text).is_err(), "{text}");
        }
    }

    #[test]
    fn options_that_need_another_option_say_so() {
        let said = |args: &[&str]| {
            let args = [&["rosrescue", "core"], args].concat();
            Cli::try_parse_from(args).expect_err("refused").to_string()
        };
        let with = |args: &[&'static str]| [&["--cluster", "https://a"], args].concat();
        for (option, value) in [
            ("--advertise", "a"),
            ("--cluster-name", "a"),
            ("--cluster-ttl", "2"),
            ("--cluster-sync", "always"),
            ("--alone", "serve"),
            ("--cluster-ca", "f"),
        ] {
            let error = said(&[option, value]);
            assert!(error.contains("--cluster <URLS>"), "{error}");
        }
        for (args, missing) in [
            (&["--cluster-cert", "f"][..], "--cluster-key <FILE>"),
            (&["--cluster-key", "f"], "--cluster-cert <FILE>"),
            (
                &["--cluster-cert", "f", "--cluster-key", "f"],
                "--cluster-ca <FILE>",
            ),
            (&["--cluster-user", "u"], "--cluster-password-file <FILE>"),
            (&["--cluster-password-file", "f"], "--cluster-user <NAME>"),
        ] {
            let error = said(&with(args));
            assert!(error.contains(missing), "{error}");
        }
        let error = said(&with(&["--cluster-name", "a/b"]));
        assert!(error.contains("'a/b'"), "{error}");
    }

    #[test]
    fn without_a_word_it_is_as_safe_and_as_useful_as_it_can_be() {
        let cli = Cli::parse_from(["rosrescue", "core", "--cluster", "http://a"]);
        let Some(Command::Core(args)) = cli.command else {
            panic!("{cli:?}");
        };
        assert_eq!(args.cluster.cluster_ttl, Duration::from_secs(2));
        assert_eq!(args.cluster.cluster_sync, ClusterSync::Always);
        assert_eq!(args.cluster.alone, WhenCutOff::Serve);
    }
}
