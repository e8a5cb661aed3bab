//! ROS environment variables, read as rosgraph and rospkg read them.
//!
//! Sources: `rosgraph/network.py`, `rosgraph/rosenv.py`, `rospkg/environment.py` of Noetic.

use std::{
    net::{IpAddr, Ipv4Addr, Ipv6Addr},
    path::PathBuf,
};

use thiserror::Error;

/// The master's port if `ROS_MASTER_URI` contains none.
pub const DEFAULT_MASTER_PORT: u16 = 11311;

/// Looks up an environment variable. Passed as a parameter, so that tests need not change the environment.
pub type Lookup<'a> = &'a dyn Fn(&str) -> Option<String>;

/// An invalid `ROS_MASTER_URI` or `--master`.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
pub enum UriError {
    /// The address is not of the form `http://HOST:PORT/`.
    #[error(
        "`{uri}` is not the URI of a master; write http://HOST:PORT/, as in http://localhost:11311/"
    )]
    Malformed { uri: String },
}

/// The address of a master.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MasterUri {
    /// Host name or address, without the brackets of IPv6.
    pub host: String,
    pub port: u16,
}

impl MasterUri {
    /// Parses `http://HOST[:PORT][/]`; the default port is 11311.
    pub fn parse(uri: &str) -> Result<Self, UriError> {
        let malformed = || UriError::Malformed {
            uri: uri.to_owned(),
        };
        let rest = uri.trim().strip_prefix("http://").ok_or_else(malformed)?;
        let authority = rest.split('/').next().unwrap_or_default();
        let (host, port) = if let Some(rest) = authority.strip_prefix('[') {
            let (host, port) = rest.split_once(']').ok_or_else(malformed)?;
            let port = match port {
                "" => None,
                _ => Some(port.strip_prefix(':').ok_or_else(malformed)?),
            };
            (host, port)
        } else {
            // rosgraph writes no brackets around an IPv6 address.
            let ipv6 = authority.rsplit_once(':');
            let ipv6 = ipv6.filter(|(host, _)| host.parse::<Ipv6Addr>().is_ok());
            match ipv6.or_else(|| authority.split_once(':')) {
                Some((host, port)) => (host, Some(port)),
                None => (authority, None),
            }
        };
        let port = match port {
            None => DEFAULT_MASTER_PORT,
            Some(port) => port
                .parse()
                .ok()
                .filter(|port| *port != 0)
                .ok_or_else(malformed)?,
        };
        if host.is_empty() || host.contains(['@', ' ', '?', '#']) {
            return Err(malformed());
        }
        Ok(Self {
            host: host.to_owned(),
            port,
        })
    }

    /// Whether `uri`, which can be parsed, contains a port. roscpp refuses one without, and rospy calls port 80.
    pub fn has_port(uri: &str) -> bool {
        let authority = uri.trim().trim_start_matches("http://");
        let authority = authority.split('/').next().unwrap_or_default();
        authority
            .rsplit(']')
            .next()
            .is_some_and(|end| end.contains(':'))
    }

    /// Whether this address, which a node uses as its master, is the master at `own`. `addresses` are the host's
    /// addresses as resolved here. `is_own` recognises this computer's own addresses. A loopback address counts only if
    /// `node_is_here`, because it means the node's own computer.
    pub(crate) fn names(
        &self,
        own: &Self,
        addresses: &[IpAddr],
        node_is_here: bool,
        is_own: impl Fn(IpAddr) -> bool,
    ) -> bool {
        let is_loopback = own.host.parse().as_ref().map_or_else(
            |_| own.host.eq_ignore_ascii_case("localhost"),
            IpAddr::is_loopback,
        );
        let same_name = self.host.eq_ignore_ascii_case(&own.host);
        let mut addresses = addresses.iter();
        self.port == own.port
            && (same_name && (node_is_here || !is_loopback)
                || addresses.any(|at| is_own(*at) && (node_is_here || !at.is_loopback())))
    }

    /// `HOST:PORT`, with brackets around an IPv6 address: the value of an HTTP `Host` header.
    pub fn authority(&self) -> String {
        if self.host.contains(':') {
            format!("[{}]:{}", self.host, self.port)
        } else {
            format!("{}:{}", self.host, self.port)
        }
    }
}

impl std::fmt::Display for MasterUri {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "http://{}/", self.authority())
    }
}

/// The port in `ROS_MASTER_URI`, or 11311.
pub fn master_port(env: Lookup<'_>) -> Result<u16, UriError> {
    match env("ROS_MASTER_URI").filter(|uri| !uri.is_empty()) {
        Some(uri) => Ok(MasterUri::parse(&uri)?.port),
        None => Ok(DEFAULT_MASTER_PORT),
    }
}

/// This computer's own address from `ROS_HOSTNAME`, or else from `ROS_IP`.
pub fn address_override(env: Lookup<'_>) -> Option<String> {
    env("ROS_HOSTNAME")
        .or_else(|| env("ROS_IP"))
        .filter(|address| !address.is_empty())
}

/// Name and value of the variable that [`address_override`] reads, if its value is neither a host name nor an address.
/// `None` if it is valid or unset.
pub fn bad_override(env: Lookup<'_>) -> Option<(&'static str, String)> {
    let host = address_override(env)?;
    // The scope of an address such as fe80::1%eth0 is not checked.
    let bare = host.split('%').next().unwrap_or_default();
    let is_name = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
    if host.chars().all(is_name) || bare.parse::<IpAddr>().is_ok() && !host.contains(['/', ' ']) {
        return None;
    }
    let variable = match env("ROS_HOSTNAME") {
        Some(_) => "ROS_HOSTNAME",
        None => "ROS_IP",
    };
    Some((variable, host))
}

/// The addresses to listen on, chosen as a master does: all addresses, or loopback if this computer's own address is a
/// loopback address. The first address is required. Others may be left out if the computer lacks their address family.
pub fn bind_addresses(env: Lookup<'_>) -> Vec<IpAddr> {
    match address_override(env) {
        Some(address) if address.starts_with("127.") => {
            let v4 = address.parse().unwrap_or(IpAddr::V4(Ipv4Addr::LOCALHOST));
            vec![v4, IpAddr::V6(Ipv6Addr::LOCALHOST)]
        }
        Some(address) if address == "localhost" || address == "::1" => {
            vec![
                IpAddr::V4(Ipv4Addr::LOCALHOST),
                IpAddr::V6(Ipv6Addr::LOCALHOST),
            ]
        }
        _ => vec![
            IpAddr::V4(Ipv4Addr::UNSPECIFIED),
            IpAddr::V6(Ipv6Addr::UNSPECIFIED),
        ],
    }
}

/// The announced host of this computer, chosen as rosgraph does. It is the [`address_override`], else the host name
/// unless that is a loopback name, else `local_address`.
pub fn advertised_host(env: Lookup<'_>, hostname: &str, local_address: Option<IpAddr>) -> String {
    if let Some(address) = address_override(env) {
        return address;
    }
    if !hostname.is_empty() && hostname != "localhost" && !hostname.starts_with("127.") {
        return hostname.to_owned();
    }
    local_address
        .unwrap_or(IpAddr::V4(Ipv4Addr::LOCALHOST))
        .to_string()
}

/// The folder `$ROS_HOME`, or `~/.ros`. As in Python, `~` is `$HOME`, else the user's home folder in `/etc/passwd`:
/// systemd sets no `HOME` for a system service without `User=`.
pub fn ros_home(env: Lookup<'_>) -> PathBuf {
    match env("ROS_HOME").filter(|home| !home.is_empty()) {
        Some(home) => PathBuf::from(home),
        None => {
            let home = env("HOME").map(PathBuf::from).or_else(std::env::home_dir);
            home.unwrap_or_else(|| PathBuf::from("/")).join(".ros")
        }
    }
}

/// The folder `$ROS_LOG_DIR`, or `log` in [`ros_home`].
pub fn log_dir(env: Lookup<'_>) -> PathBuf {
    match env("ROS_LOG_DIR").filter(|dir| !dir.is_empty()) {
        Some(dir) => PathBuf::from(dir),
        None => ros_home(env).join("log"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn uri(host: &str, port: u16) -> MasterUri {
        MasterUri {
            host: host.to_owned(),
            port,
        }
    }

    fn env<'a>(pairs: &'a [(&'a str, &'a str)]) -> impl Fn(&str) -> Option<String> + 'a {
        |name| {
            pairs
                .iter()
                .find(|(key, _)| *key == name)
                .map(|(_, value)| (*value).to_owned())
        }
    }

    #[test]
    fn uris() {
        for (text, expected) in [
            ("http://localhost:11311", uri("localhost", 11311)),
            ("http://10.0.0.7:4242/", uri("10.0.0.7", 4242)),
            ("http://robot", uri("robot", 11311)),
            ("http://[::1]:5/RPC2", uri("::1", 5)),
            ("http://[fe80::1]", uri("fe80::1", 11311)),
            ("http://fd00::7:41234/", uri("fd00::7", 41234)),
        ] {
            assert_eq!(MasterUri::parse(text), Ok(expected), "{text}");
        }
        for text in [
            "",
            "localhost:11311",
            "https://a:1",
            "http://",
            "http://a:0",
            "http://a:b",
            "http://a:70000",
            "http://[::1",
            "http://u@a:1",
        ] {
            assert_eq!(
                MasterUri::parse(text),
                Err(UriError::Malformed {
                    uri: text.to_owned()
                }),
                "{text}"
            );
        }
        assert_eq!(uri("::1", 5).to_string(), "http://[::1]:5/");
        for (text, has) in [
            ("http://robot:11311/", true),
            ("http://[::1]:5/RPC2", true),
            ("http://robot", false),
            ("http://[fe80::1]/", false),
        ] {
            assert_eq!(MasterUri::has_port(text), has, "{text}");
        }
    }

    #[test]
    fn a_node_names_its_master_by_any_name_of_ours() {
        let parse = |uri: &str| MasterUri::parse(uri).unwrap();
        let here = ["127.0.0.1", "10.0.0.1", "10.1.0.1"].map(|at| at.parse::<IpAddr>().unwrap());
        let is_own = |at: IpAddr| at.is_loopback() || here.contains(&at);
        let names_us = |named: &str, at: &[&str], own: &str, node_is_here| {
            let at: Vec<IpAddr> = at.iter().map(|at| at.parse().unwrap()).collect();
            parse(named).names(&parse(own), &at, node_is_here, is_own)
        };
        let own = "http://robot:11311/";
        for (named, at) in [
            ("http://10.0.0.1:11311", "10.0.0.1"),
            ("http://10.1.0.1:11311/", "10.1.0.1"),
            ("http://robot.local:11311", "10.0.0.1"),
            ("http://ROBOT", "127.0.1.1"),
        ] {
            assert!(names_us(named, &[at], own, true), "{named}");
            assert!(names_us(named, &[at], own, false), "{named}");
        }
        // A loopback address means the node's own computer.
        for named in ["http://localhost:11311", "http://127.0.0.1:11311"] {
            assert!(names_us(named, &["127.0.0.1"], own, true));
            assert!(!names_us(named, &["127.0.0.1"], own, false));
            assert!(!names_us(named, &["127.0.0.1"], named, false));
        }
        for (named, at) in [
            ("http://10.0.0.1:11312", "10.0.0.1"),
            ("http://10.0.0.2:11311", "10.0.0.2"),
            ("http://other:11311", "10.0.0.2"),
        ] {
            assert!(!names_us(named, &[at], own, true), "{named}");
        }
        assert!(!names_us("http://nowhere:11311", &[], own, true));
    }

    #[test]
    fn the_port_comes_from_ros_master_uri() {
        assert_eq!(master_port(&env(&[])), Ok(11311));
        assert_eq!(
            master_port(&env(&[("ROS_MASTER_URI", "http://other:1234/")])),
            Ok(1234)
        );
        assert!(master_port(&env(&[("ROS_MASTER_URI", "nonsense")])).is_err());
    }

    #[test]
    fn an_override_is_a_name_or_an_address() {
        for good in [
            "robot",
            "robot-7.local",
            "my_robot",
            "10.0.0.7",
            "::1",
            "fe80::1%eth0",
            "",
        ] {
            assert_eq!(
                bad_override(&env(&[("ROS_HOSTNAME", good)])),
                None,
                "{good}"
            );
        }
        for bad in [
            "bad host",
            "a/b",
            "http://robot",
            "robot:11311",
            "[::1]",
            "a@b",
            "::1% /",
        ] {
            let found = bad_override(&env(&[("ROS_IP", bad)]));
            assert_eq!(found, Some(("ROS_IP", bad.to_owned())));
        }
    }

    #[test]
    fn a_loopback_override_binds_loopback_only() {
        let any = bind_addresses(&env(&[("ROS_IP", "10.0.0.7")]));
        assert!(any.iter().all(IpAddr::is_unspecified));
        for own in ["localhost", "127.0.0.1", "127.0.1.1", "::1"] {
            let bound = bind_addresses(&env(&[("ROS_HOSTNAME", own), ("ROS_IP", "10.0.0.7")]));
            assert!(bound.iter().all(IpAddr::is_loopback), "{own}");
        }
    }

    #[test]
    fn the_advertised_host_is_rosgraphs_choice() {
        let local = Some(IpAddr::V4(Ipv4Addr::new(10, 0, 0, 7)));
        assert_eq!(
            advertised_host(&env(&[("ROS_IP", "1.2.3.4")]), "robot", local),
            "1.2.3.4"
        );
        assert_eq!(advertised_host(&env(&[]), "robot", local), "robot");
        assert_eq!(advertised_host(&env(&[]), "localhost", local), "10.0.0.7");
        assert_eq!(advertised_host(&env(&[]), "", None), "127.0.0.1");
    }

    #[test]
    fn the_log_folder_is_rospkgs_choice() {
        assert_eq!(
            log_dir(&env(&[("HOME", "/home/r")])),
            PathBuf::from("/home/r/.ros/log")
        );
        assert_eq!(
            log_dir(&env(&[("ROS_HOME", "/h")])),
            PathBuf::from("/h/log")
        );
        assert_eq!(
            log_dir(&env(&[("ROS_HOME", "/h"), ("ROS_LOG_DIR", "/l")])),
            PathBuf::from("/l")
        );
        let home = std::env::home_dir().unwrap();
        assert_eq!(log_dir(&env(&[])), home.join(".ros/log"), "without HOME");
    }
}
