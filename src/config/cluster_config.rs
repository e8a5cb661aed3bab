//! The configuration of a robot with several computers.

use std::{
    fmt, io,
    net::{IpAddr, Ipv6Addr},
    path::{Path, PathBuf},
    time::Duration,
};

use checkpoint_store::regular_file::read_small;
use hyper::Uri;
use thiserror::Error;

pub use crate::cli::{ClusterSync, WhenCutOff};
use crate::{
    cli::{ClusterArgs, cluster_args::name},
    ros_env::{DEFAULT_MASTER_PORT, MasterUri},
};

/// The cluster configuration of this computer.
#[derive(Clone, PartialEq, Eq)]
pub struct ClusterConfig {
    /// The addresses of the etcd servers, each as `http://HOST:PORT` or `https://HOST:PORT`.
    pub endpoints: Vec<String>,
    /// The robot's name. All its keys in etcd begin with it.
    pub robot: String,
    /// This computer's name, unique within the robot.
    pub name: String,
    /// The host name, if it is part of the computer's name. `None` if the user chose the name.
    pub(super) hostname: Option<String>,
    /// Address at which other computers reach this rosrescue.
    pub advertised: MasterUri,
    /// How long the leader may be silent before another computer takes over.
    pub ttl: Duration,
    /// When the leader answers a write.
    pub sync: ClusterSync,
    /// What to do with writes while this computer is cut off.
    pub alone: WhenCutOff,
    /// PEM file with the certificate of etcd's authority.
    pub ca: Option<PathBuf>,
    pub cert: Option<PathBuf>,
    pub key: Option<PathBuf>,
    /// Name and password of the etcd user.
    pub user: Option<(String, String)>,
}

/// Cluster options that are invalid or do not fit together.
#[derive(Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
pub enum ClusterError {
    /// `--advertise` is not an address.
    #[error(
        "--advertise: `{given}` is not an address; write HOST or HOST:PORT, as in 10.0.0.7 or robot-7:11311"
    )]
    Advertise { given: String },
    /// No computer name can be derived from the host name and the address.
    #[error(
        "no name for this computer can be made from its host name, `{hostname}`, and its address, {address}; \
         give it a unique name with --cluster-name"
    )]
    Name { hostname: String, address: String },
    /// The advertised address is a loopback address, which leads each computer to itself.
    #[error(
        "with --cluster {endpoint} other computers must reach this rosrescue, but {address} leads each computer to itself: set ROS_IP to this computer's address in the network, or use --advertise"
    )]
    Loopback { address: String, endpoint: String },
    /// etcd's certificate cannot be checked.
    #[error(
        "--cluster {endpoint}: https needs the certificate of the authority that signed the certificates of etcd: \
         give its file with --cluster-ca"
    )]
    NoAuthority { endpoint: String },
    /// A certificate is given, but an endpoint does not use https.
    #[error("--cluster-ca needs https, but --cluster has {endpoint}: write https://")]
    NotHttps { endpoint: String },
    /// The password cannot be read.
    #[error("--cluster-password-file: {} cannot be used: {why}", path.display())]
    Password { path: PathBuf, why: String },
}

/// Hides the password.
impl fmt::Debug for ClusterConfig {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ClusterConfig")
            .field("endpoints", &self.endpoints)
            .field("robot", &self.robot)
            .field("name", &self.name)
            .field("advertised", &self.advertised)
            .field("user", &self.user.as_ref().map(|(name, _)| name))
            .finish_non_exhaustive()
    }
}

impl ClusterConfig {
    /// Builds the cluster configuration of the computer `hostname`, whose rosrescue is reached at `usual`. `None`
    /// without `--cluster`. Reads the password file.
    pub(crate) fn new(
        args: &ClusterArgs,
        usual: &MasterUri,
        hostname: &str,
    ) -> Result<Option<Self>, ClusterError> {
        let Some(members) = &args.cluster else {
            return Ok(None);
        };
        let endpoint = || members.endpoints.first().cloned().unwrap_or_default();
        match (&args.cluster_ca, endpoint().starts_with("https://")) {
            (None, true) => {
                return Err(ClusterError::NoAuthority {
                    endpoint: endpoint(),
                });
            }
            (Some(_), false) => {
                return Err(ClusterError::NotHttps {
                    endpoint: endpoint(),
                });
            }
            _ => {}
        }
        let advertised = match &args.advertise {
            Some(given) => advertised(given, usual.port)?,
            None => usual.clone(),
        };
        let mut far = members.endpoints.iter();
        let far = far.find(|endpoint| !is_at(endpoint, is_loopback));
        if let Some(endpoint) = far.filter(|_| is_loopback(&advertised.host)) {
            return Err(ClusterError::Loopback {
                address: advertised.host,
                endpoint: endpoint.clone(),
            });
        }
        let own_name = match &args.cluster_name {
            Some(given) => given.clone(),
            None => default_name(hostname, &advertised).ok_or_else(|| ClusterError::Name {
                hostname: hostname.to_owned(),
                address: advertised.host.clone(),
            })?,
        };
        let user = match (&args.cluster_user, &args.cluster_password_file) {
            (Some(user), Some(file)) => Some((user.clone(), password(file)?)),
            _ => None,
        };
        Ok(Some(Self {
            endpoints: own_first(&members.endpoints, &advertised.host),
            robot: members.robot.clone(),
            name: own_name,
            hostname: match args.cluster_name {
                Some(_) => None,
                None => Some(hostname.to_owned()),
            },
            advertised,
            ttl: args.cluster_ttl,
            sync: args.cluster_sync,
            alone: args.alone,
            ca: args.cluster_ca.clone(),
            cert: args.cluster_cert.clone(),
            key: args.cluster_key.clone(),
            user,
        }))
    }

    /// Replaces the default address `before` by `now`, unless the user has set another one.
    pub(super) fn follow(&mut self, before: &MasterUri, now: &MasterUri) {
        if self.advertised.host == before.host {
            self.advertised.host.clone_from(&now.host);
        }
        if self.advertised.port == before.port {
            self.advertised.port = now.port;
        }
        let hostname = self.hostname.as_deref();
        let made = hostname.and_then(|hostname| default_name(hostname, &self.advertised));
        if let Some(made) = made {
            self.name = made;
        }
    }
}

/// The default name of the computer `hostname` that is reached at `advertised`, such as `arm-10.0.0.2`.
///
/// The address is part of the name because copies of a disk share the host name and `/etc/machine-id`. An advertised
/// host name is used alone. A port other than 11311 is appended.
fn default_name(hostname: &str, advertised: &MasterUri) -> Option<String> {
    let host = &advertised.host;
    let is_address = host.parse::<IpAddr>().is_ok() || host == "localhost";
    let tells = name(hostname)
        .ok()
        .filter(|hostname| is_address && hostname != "localhost");
    let port = match advertised.port {
        DEFAULT_MASTER_PORT => None,
        port => Some(port.to_string()),
    };
    let parts = [tells, Some(host.replace(':', "-")), port];
    let parts: Vec<_> = parts.into_iter().flatten().collect();
    name(&parts.join("-")).ok()
}

/// Whether `host` is a loopback address or name.
fn is_loopback(host: &str) -> bool {
    let address = host.trim_start_matches('[').trim_end_matches(']');
    match address.parse::<IpAddr>() {
        Ok(address) => address.is_loopback(),
        Err(_) => host == "localhost",
    }
}

/// The endpoints, with those on this computer, `own`, first: a cut between this computer and another one then does not
/// interrupt the watch, unless the other one runs etcd's leader.
fn own_first(endpoints: &[String], own: &str) -> Vec<String> {
    let is_own = |host: &str| is_loopback(host) || host.trim_matches(['[', ']']) == own;
    let mut endpoints = endpoints.to_vec();
    endpoints.sort_by_key(|endpoint| !is_at(endpoint, is_own));
    endpoints
}

/// Whether the endpoint's host is one that `is_it` accepts.
fn is_at(endpoint: &str, is_it: impl Fn(&str) -> bool) -> bool {
    let uri = endpoint.parse::<Uri>();
    uri.is_ok_and(|uri| uri.host().is_some_and(is_it))
}

/// Parses `HOST:PORT`, or `HOST`, to which it adds `port`.
fn advertised(given: &str, port: u16) -> Result<MasterUri, ClusterError> {
    let given_host = match given.parse::<Ipv6Addr>() {
        Ok(address) => format!("[{address}]"),
        Err(_) => given.to_owned(),
    };
    let uris = [
        format!("http://{given_host}:{port}"),
        format!("http://{given_host}"),
    ];
    let mut uris = uris.iter().filter(|_| !given.contains('/'));
    uris.find_map(|uri| MasterUri::parse(uri).ok())
        .ok_or_else(|| ClusterError::Advertise {
            given: given.to_owned(),
        })
}

fn password(file: &Path) -> Result<String, ClusterError> {
    let read = read_small(file).and_then(|text| match text.lines().next() {
        None | Some("") => Err(io::Error::other("its first line is empty")),
        Some(line) => Ok(line.to_owned()),
    });
    read.map_err(|error| ClusterError::Password {
        path: file.to_owned(),
        why: error.to_string(),
    })
}

#[cfg(test)]
mod tests {
    use std::fs;

    use clap::Parser;

    use super::*;
    use crate::{
        cli::Cli,
        config::{Config, UsageError},
    };

    fn config(args: &[&str], hostname: &str) -> Result<Config, UsageError> {
        let args = ["rosrescue", "-p", "12000"].iter().chain(args);
        let env = |name: &str| (name == "ROS_IP").then(|| "10.0.0.7".to_owned());
        Config::core(&Cli::parse_from(args).core, &env, hostname, None)
    }

    fn cluster(args: &[&str]) -> Result<ClusterConfig, String> {
        let args = [&["--cluster", "http://a:2379,b:2379/r"], args].concat();
        let config = config(&args, "pc-1").map_err(|error| error.to_string())?;
        Ok(config.cluster.expect("a cluster"))
    }

    #[test]
    fn a_computers_default_name_has_its_host_name_and_address() {
        assert_eq!(config(&[], "pc-1").unwrap().cluster, None);
        let one = cluster(&[]).unwrap();
        assert_eq!(one.endpoints, ["http://a:2379", "http://b:2379"]);
        assert_eq!(one.robot, "r");
        assert_eq!(one.name, "pc-1-10.0.0.7-12000");
        assert_eq!(one.advertised.to_string(), "http://10.0.0.7:12000/");
        let named = cluster(&["--cluster-name", "left"]).unwrap();
        assert_eq!(named.name, "left");
    }

    #[test]
    fn the_etcd_of_this_computer_is_asked_first() {
        let given = [
            "http://10.0.0.1:2379",
            "http://10.0.0.2:2379",
            "http://[fd00::2]:2379",
        ];
        let given = given.map(str::to_owned);
        for (own, first) in [
            ("10.0.0.1", 0),
            ("10.0.0.2", 1),
            ("fd00::2", 2),
            ("10.0.0.3", 0),
        ] {
            let ordered = own_first(&given, own);
            assert_eq!((&ordered[0], ordered.len()), (&given[first], 3), "{own}");
        }
    }

    #[test]
    fn copies_of_a_computer_have_names_of_their_own() {
        let made = |hostname, host: &str, port| {
            let host = host.to_owned();
            default_name(hostname, &MasterUri { host, port })
        };
        for (hostname, host, port, expected) in [
            ("robot", "10.0.0.1", 11311, "robot-10.0.0.1"),
            ("robot", "10.0.0.2", 11311, "robot-10.0.0.2"),
            ("robot", "10.0.0.2", 11312, "robot-10.0.0.2-11312"),
            ("robot", "fd00::2", 11311, "robot-fd00--2"),
            // Other computers use that name to find this computer.
            ("robot", "robot", 11311, "robot"),
            ("robot-0", "robot-0.fleet", 11311, "robot-0.fleet"),
            ("localhost", "10.0.0.1", 11311, "10.0.0.1"),
            ("a b", "10.0.0.1", 11311, "10.0.0.1"),
            ("robot", "localhost", 11312, "robot-localhost-11312"),
        ] {
            let name = made(hostname, host, port);
            assert_eq!(name.as_deref(), Some(expected), "{hostname} {host}");
        }
        let error = config(&["--cluster", "http://a", "--advertise", "ä"], "ö").map(|_| ());
        let error = error.expect_err("refused").to_string();
        assert!(
            error.contains("`ö`") && error.contains("--cluster-name"),
            "{error}"
        );
    }

    #[test]
    fn an_address_that_only_this_computer_reaches_is_for_etcd_on_this_computer_alone() {
        let at = |cluster, host| {
            config(&["--cluster", cluster, "--advertise", host], "pc-1").map_err(|e| e.to_string())
        };
        for host in ["127.0.0.1", "127.0.1.1", "localhost", "::1"] {
            let error = at("http://127.0.0.1:2379,http://10.0.0.2:2379", host);
            let error = error.map(|_| ()).expect_err("refused");
            assert!(error.contains("http://10.0.0.2:2379"), "{error}");
            assert!(error.contains("ROS_IP"), "{error}");
            let near = at("http://127.0.0.1:1,http://localhost:2,http://[::1]:3", host);
            assert!(near.is_ok(), "{near:?}");
        }
        assert!(at("http://10.0.0.2:2379", "pc-1").is_ok());
    }

    #[test]
    fn other_computers_reach_it_at_the_advertised_address() {
        for (given, uri) in [
            ("pc-1.local", "http://pc-1.local:12000/"),
            ("pc-1:5", "http://pc-1:5/"),
            ("fd00::1", "http://[fd00::1]:12000/"),
            ("[fd00::1]:5", "http://[fd00::1]:5/"),
        ] {
            let said = cluster(&["--advertise", given]).unwrap().advertised;
            assert_eq!(said.to_string(), uri);
        }
        for given in ["", "http://a", "a/b", "a:b", "a:0", ":5", "a b"] {
            let error = cluster(&["--advertise", given]).expect_err("refused");
            assert!(error.contains(&format!("`{given}`")), "{error}");
        }
    }

    #[test]
    fn sockets_of_systemd_change_the_address_that_is_not_given() {
        for (given, uri) in [
            (&[][..], "http://10.0.0.7:4000/"),
            (&["--advertise", "b"], "http://b:4000/"),
            (&["--advertise", "b:5"], "http://b:5/"),
        ] {
            let args = [&["--cluster", "http://a"], given].concat();
            let mut config = config(&args, "pc-1").unwrap();
            config.serve_at(vec!["[::]:4000".parse().unwrap()], &|name| {
                (name == "ROS_IP").then(|| "10.0.0.7".to_owned())
            });
            let cluster = config.cluster.unwrap();
            assert_eq!(cluster.advertised.to_string(), uri);
            let port = if uri.contains(":4000") { "-4000" } else { "-5" };
            assert!(cluster.name.ends_with(port), "{}", cluster.name);
        }
    }

    #[test]
    fn https_and_the_authority_go_together() {
        let error = config(&["--cluster", "https://a"], "pc-1").map(|_| ());
        let error = error.expect_err("refused").to_string();
        assert!(error.contains("https://a") && error.contains("--cluster-ca"));
        let error = cluster(&["--cluster-ca", "f"]).expect_err("refused");
        assert!(error.contains("http://a:2379"), "{error}");
        let both = ["--cluster", "https://a", "--cluster-ca", "f"];
        let both = config(&both, "pc-1").unwrap().cluster.unwrap();
        assert_eq!(both.ca, Some(PathBuf::from("f")));
    }

    #[test]
    fn the_password_is_the_first_line_and_is_not_shown() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("password");
        let path = file.to_str().unwrap();
        let args = ["--cluster-user", "ros", "--cluster-password-file", path];
        for (text, why) in [
            (None, "No such file"),
            (Some(""), "its first line is empty"),
            (Some("\nx"), "empty"),
        ] {
            if let Some(text) = text {
                fs::write(&file, text).unwrap();
            }
            let error = cluster(&args).expect_err("refused");
            assert!(error.contains(path) && error.contains(why), "{error}");
        }
        fs::write(&file, "se cret\n").unwrap();
        let one = cluster(&args).unwrap();
        assert_eq!(one.user, Some(("ros".to_owned(), "se cret".to_owned())));
        assert!(!format!("{one:?}").contains("cret"));
    }
}
