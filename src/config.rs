//! Validated configuration from the command line and the environment.

use std::{
    net::{IpAddr, SocketAddr},
    path::{Path, PathBuf},
    time::Duration,
};

use ipnet::IpNet;
use rescue_core::{
    checkpoint::session::RestorePolicy, health::Reap, hide::Hide, lifecycle::Probing,
};
use thiserror::Error;

use crate::{
    cli::{CommonArgs, CoreArgs, ProxyArgs, Reads, ReapNodes, RestoreChoice, SyncPolicy, Writes},
    ros_env::{self, Lookup, MasterUri, UriError},
};

mod addresses;
mod cluster_config;
mod files;

use self::addresses::{advertised_host, listen_addresses, parse_address};
pub use self::cluster_config::{ClusterConfig, ClusterError, ClusterSync, WhenCutOff};

/// Name of the checkpoint of port 11311 in the log folder. The tool of the ROS Rescue paper uses
/// the same name.
pub(crate) const CHECKPOINT_NAME: &str = "latest-chkpt.yaml";

/// Pause between two renewals of the sentinel. A rosmaster's `-t` may be as short as one second, and each renewal costs
/// it 0.8 ms of a core (rosmaster 1.15.15).
const RENEWAL: Duration = Duration::from_millis(400);
/// Shortest pause between two renewals of the sentinel.
const SHORTEST_RENEWAL: Duration = Duration::from_millis(10);

/// A command line that parses but makes no sense. The exit status is 2.
#[derive(Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum UsageError {
    /// `--master` is not a URI.
    #[error("--master: {0}")]
    Master(UriError),
    /// `ROS_MASTER_URI` is not a URI.
    #[error("ROS_MASTER_URI: {0}")]
    MasterUri(UriError),
    /// `ROS_HOSTNAME` or `ROS_IP` is neither a host name nor an address.
    #[error(
        "{variable}: `{given}` is not a host name or an address; write one, as in robot or 10.0.0.7"
    )]
    Host {
        variable: &'static str,
        given: String,
    },
    /// `--listen` is not an address.
    #[error("--listen: `{given}` is not an address; write {form}")]
    Listen {
        given: String,
        /// The accepted forms of the address.
        form: &'static str,
    },
    /// A number of seconds that is not a valid duration.
    #[error("{option}: `{given}` is not a number of seconds between 0 and {most}")]
    Seconds {
        option: &'static str,
        given: f64,
        most: f64,
    },
    /// rosrescue and its master would have the same port on loopback.
    #[error("--master-port {port} is the port that nodes use: the real master needs another one")]
    SamePort { port: u16 },
    /// The cluster options do not fit together.
    #[error(transparent)]
    Cluster(#[from] ClusterError),
}

/// The configuration of `rosrescue core` and `rosrescue proxy`.
#[derive(Clone, Debug)]
pub struct Config {
    /// Addresses to serve. The first is required; the others are served if possible.
    pub listen: Vec<SocketAddr>,
    /// The `ROS_MASTER_URI` that rosrescue announces.
    pub advertised: MasterUri,
    pub master: MasterConfig,
    pub checkpoint: PathBuf,
    /// Whether the user chose the checkpoint. Otherwise the checkpoint's name depends on the served port.
    pub checkpoint_is_given: bool,
    pub restore: RestorePolicy,
    /// Maximum space for kept checkpoints and the log of changes, in bytes.
    pub history: u64,
    /// When the journal is synced to the disk.
    pub sync: SyncPolicy,
    /// Pause between two syncs with [`SyncPolicy::Interval`].
    pub sync_interval: Duration,
    /// How long a call waits if only a master can answer it.
    pub hold: Duration,
    /// How long a write waits for the master before the mirror answers it.
    pub stand_in_after: Duration,
    /// When a master counts as hung.
    pub probing: Probing,
    /// How long the master may take to answer a probe.
    pub probe_timeout: Duration,
    /// How long a node may take to answer the health check.
    pub node_timeout: Duration,
    /// Which dead nodes are unregistered between rescues.
    pub(crate) reap: Reap,
    /// Networks that may call. `None` allows all.
    pub allow: Vec<IpNet>,
    /// Networks that may change state. `None` allows all that may call.
    pub allow_write: Vec<IpNet>,
    /// Pause between two comparisons of the mirror with the master. `None` disables them.
    pub resync_interval: Option<Duration>,
    /// Whether the mirror or the master answers reads while there is a master.
    pub reads: Reads,
    /// Whether the mirror or the master answers writes while there is a master.
    pub writes: Writes,
    /// Maximum number of connections to the master for reads.
    pub master_connections: usize,
    /// Maximum number of connections from clients.
    pub max_connections: usize,
    /// Largest request body in bytes.
    pub max_body: usize,
    /// Parameters whose values the page hides.
    pub hide: Hide,
    /// The cluster of several computers. `None` for a single computer.
    pub cluster: Option<ClusterConfig>,
}

/// Where the master is, or how to run it.
#[derive(Clone, Debug)]
pub enum MasterConfig {
    /// An external master at this address.
    External(MasterUri),
    /// A master that rosrescue runs.
    Supervised(SupervisedConfig),
}

impl MasterConfig {
    /// Pause between two renewals of the [`Sentinel`](crate::upstream::sentinel::Sentinel). It is shorter for a `--timeout`
    /// of less than 0.8 s, because that master closes idle connections sooner. The `-t` of an external master is unknown.
    pub(crate) fn renewal(&self) -> Duration {
        self.socket_timeout().map_or(RENEWAL, |limit| {
            RENEWAL.min((limit / 2).max(SHORTEST_RENEWAL))
        })
    }

    /// The master's socket timeout; see [`SupervisedConfig::socket_timeout`]. `None` if it has none or it is unknown.
    pub(crate) fn socket_timeout(&self) -> Option<Duration> {
        match self {
            Self::External(_) => None,
            Self::Supervised(supervised) => supervised.socket_timeout(),
        }
    }
}

/// How to run rosmaster and rosout.
#[derive(Clone, Debug)]
pub struct SupervisedConfig {
    /// The master's port. `None` for a free one.
    pub port: Option<u16>,
    /// The rosmaster program. `None` to search for it.
    pub rosmaster: Option<PathBuf>,
    /// Number of notifier threads of the master.
    pub numworkers: u32,
    /// Socket timeout of the master in seconds; 0 for none.
    pub timeout: f64,
    pub rosout: bool,
}

impl SupervisedConfig {
    /// After which time rosmaster gives up a node that does not answer. `None` for never.
    pub(crate) fn socket_timeout(&self) -> Option<Duration> {
        let limit = Duration::try_from_secs_f64(self.timeout).ok();
        limit.filter(|limit| !limit.is_zero())
    }
}

impl Config {
    /// Maximum space for kept checkpoints, in bytes.
    pub fn checkpoint_bytes(&self) -> u64 {
        self.history / 4
    }

    /// Maximum space for the log of changes, in bytes.
    pub fn log_bytes(&self) -> u64 {
        self.history - self.checkpoint_bytes()
    }

    /// The configuration of `rosrescue core` with `args` in the environment `env` on the computer
    /// `hostname`.
    pub fn core(
        args: &CoreArgs,
        env: Lookup<'_>,
        hostname: &str,
        local_address: Option<IpAddr>,
    ) -> Result<Self, UsageError> {
        let port = match args.port {
            Some(port) => port,
            None => ros_env::master_port(env).map_err(UsageError::MasterUri)?,
        };
        if args.master_port == Some(port) {
            return Err(UsageError::SamePort { port });
        }
        let addresses = match &args.listen {
            None => ros_env::bind_addresses(env),
            Some(text) => vec![parse_address(text, "an IP address such as 10.0.0.7 or ::")?],
        };
        let listen: Vec<_> = addresses
            .into_iter()
            .map(|address| SocketAddr::new(address, port))
            .collect();
        let master = MasterConfig::Supervised(SupervisedConfig {
            port: args.master_port,
            rosmaster: args.rosmaster.clone(),
            numworkers: args.numworkers,
            timeout: seconds("--timeout", args.timeout, 3600.0)?.as_secs_f64(),
            rosout: !args.no_rosout,
        });
        let host = advertised_host(&listen, env, hostname, local_address);
        let advertised = MasterUri { host, port };
        let cluster = ClusterConfig::new(&args.cluster, &advertised, hostname)?;
        let mut config = Self::common(&args.common, env, listen, advertised, master)?;
        config.probing.start_limit = Duration::from_secs(args.start_limit);
        Ok(Self { cluster, ..config })
    }

    /// The configuration of `rosrescue proxy` with `args` in the environment `env` on the computer `hostname`.
    pub fn proxy(
        args: &ProxyArgs,
        env: Lookup<'_>,
        hostname: &str,
        local_address: Option<IpAddr>,
    ) -> Result<Self, UsageError> {
        let master = MasterUri::parse(&args.master).map_err(UsageError::Master)?;
        let listen = listen_addresses(args.listen.as_deref(), env)?;
        let port = listen
            .first()
            .map_or(ros_env::DEFAULT_MASTER_PORT, SocketAddr::port);
        let host = advertised_host(&listen, env, hostname, local_address);
        let advertised = MasterUri { host, port };
        Self::common(
            &args.common,
            env,
            listen,
            advertised,
            MasterConfig::External(master),
        )
    }

    pub fn port_option(&self) -> &'static str {
        match self.master {
            MasterConfig::Supervised(_) => "-p",
            MasterConfig::External(_) => "--listen",
        }
    }

    /// Adapts the configuration to the served `port`, which the system chooses if port 0 was configured.
    pub fn serve_on(&mut self, port: u16) {
        self.advertised.port = port;
        if !self.checkpoint_is_given {
            self.checkpoint.set_file_name(checkpoint_name(port));
        }
    }

    /// Serves `addresses`, which another process has bound, instead of the configured ones.
    pub fn serve_at(&mut self, addresses: Vec<SocketAddr>, env: Lookup<'_>) {
        let before = self.advertised.clone();
        let single = addresses.first().filter(|address| {
            !address.ip().is_unspecified() && ros_env::address_override(env).is_none()
        });
        if let Some(served) = single {
            self.advertised.host = served.ip().to_string();
        }
        if let Some(first) = addresses.first() {
            self.serve_on(first.port());
        }
        if let Some(cluster) = &mut self.cluster {
            cluster.follow(&before, &self.advertised);
        }
        self.listen = addresses;
    }

    fn common(
        args: &CommonArgs,
        env: Lookup<'_>,
        listen: Vec<SocketAddr>,
        advertised: MasterUri,
        master: MasterConfig,
    ) -> Result<Self, UsageError> {
        if let Some((variable, given)) = ros_env::bad_override(env) {
            return Err(UsageError::Host { variable, given });
        }
        let reads = args.reads.unwrap_or(match master {
            // Only rosrescue knows the port of its own master, so no client changes that master directly.
            MasterConfig::Supervised(_) => Reads::Mirror,
            MasterConfig::External(_) => Reads::Master,
        });
        Ok(Self {
            checkpoint: checkpoint_path(args.checkpoint.as_deref(), advertised.port, env),
            checkpoint_is_given: args.checkpoint.is_some(),
            listen,
            advertised,
            master,
            reads,
            writes: args.writes.unwrap_or(Writes::Master),
            restore: match args.restore {
                RestoreChoice::Auto => RestorePolicy::Auto,
                RestoreChoice::Always => RestorePolicy::Always,
                RestoreChoice::Never => RestorePolicy::Never,
            },
            history: args.history << 20,
            sync: args.sync,
            sync_interval: Duration::from_millis(args.sync_interval),
            hold: seconds("--hold", args.hold, 3600.0)?,
            stand_in_after: Duration::from_millis(args.stand_in_after),
            probing: Probing {
                interval: Duration::from_millis(args.probe_interval),
                count: args.probe_count,
                // `proxy` starts no master, so no start can take too long.
                start_limit: Duration::MAX,
            },
            probe_timeout: Duration::from_millis(args.probe_timeout),
            node_timeout: Duration::from_millis(args.node_timeout),
            reap: match args.reap {
                ReapNodes::Report => Reap::Report,
                ReapNodes::Local => Reap::Local,
                ReapNodes::All => Reap::All,
            },
            allow: args.allow.clone(),
            allow_write: args.allow_write.clone(),
            resync_interval: Some(seconds(
                "--resync-interval",
                args.resync_interval,
                86_400.0,
            )?)
            .filter(|interval| !interval.is_zero()),
            master_connections: usize_of(args.master_connections),
            max_connections: usize_of(args.max_connections),
            max_body: usize::try_from(args.max_body << 20).unwrap_or(usize::MAX),
            hide: args.hide.hide_values.clone(),
            cluster: None,
        })
    }
}

/// Path of the checkpoint of the rosrescue at `port`: `given` on the command line, or the default.
pub(crate) fn checkpoint_path(given: Option<&Path>, port: u16, env: Lookup<'_>) -> PathBuf {
    given.map_or_else(
        || ros_env::log_dir(env).join(checkpoint_name(port)),
        Path::to_owned,
    )
}

/// Name of the default checkpoint of this port.
fn checkpoint_name(port: u16) -> String {
    match port {
        ros_env::DEFAULT_MASTER_PORT => CHECKPOINT_NAME.to_owned(),
        _ => format!("latest-chkpt-{port}.yaml"),
    }
}

fn usize_of(number: u32) -> usize {
    usize::try_from(number).unwrap_or(usize::MAX)
}

fn seconds(option: &'static str, given: f64, most: f64) -> Result<Duration, UsageError> {
    let error = UsageError::Seconds {
        option,
        given,
        most,
    };
    if !(0.0..=most).contains(&given) {
        return Err(error);
    }
    Duration::try_from_secs_f64(given).map_err(|_| error)
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::cli::{Cli, Command};

    fn config(args: &[&str]) -> Result<Config, UsageError> {
        let env = |name: &str| match name {
            "ROS_MASTER_URI" => Some("http://robot:12345/".to_owned()),
            "HOME" => Some("/home/r".to_owned()),
            _ => None,
        };
        let cli = Cli::parse_from(std::iter::once(&"rosrescue").chain(args));
        match cli.command {
            Some(Command::Proxy(args)) => Config::proxy(&args, &env, "robot", None),
            Some(Command::Core(args)) => Config::core(&args, &env, "robot", None),
            _ => Config::core(&cli.core, &env, "robot", None),
        }
    }

    #[test]
    fn core_takes_its_port_from_ros_master_uri() {
        let config = config(&[]).unwrap();
        assert_eq!(config.advertised.to_string(), "http://robot:12345/");
        assert!(config.listen.iter().all(|address| address.port() == 12_345));
        assert_eq!(
            config.checkpoint,
            PathBuf::from("/home/r/.ros/log/latest-chkpt-12345.yaml")
        );
    }

    #[test]
    fn each_port_has_a_checkpoint_of_its_own() {
        let mut any = config(&["proxy", "--master", "http://m:1", "--listen", "0"]).unwrap();
        any.serve_on(40_000);
        assert!(any.checkpoint.ends_with("log/latest-chkpt-40000.yaml"));
        any.serve_on(11_311);
        assert!(any.checkpoint.ends_with("log/latest-chkpt.yaml"));
        let mut given = config(&["core", "--checkpoint", "/c.yaml"]).unwrap();
        given.serve_on(40_000);
        assert_eq!(given.checkpoint, PathBuf::from("/c.yaml"));
    }

    #[test]
    fn listen_takes_an_address_or_a_port() {
        for (given, first) in [
            ("127.0.0.1:4000", "127.0.0.1:4000"),
            ("[::1]:4000", "[::1]:4000"),
            (":4000", "0.0.0.0:4000"),
            ("4000", "0.0.0.0:4000"),
            ("localhost:0", "127.0.0.1:0"),
            ("127.0.0.3", "127.0.0.3:12345"),
            ("::1", "[::1]:12345"),
        ] {
            let config = config(&["proxy", "--master", "http://m:1", "--listen", given]).unwrap();
            assert_eq!(config.listen.first().unwrap().to_string(), first, "{given}");
        }
    }

    #[test]
    fn the_address_that_is_served_is_the_one_that_is_said() {
        let core = |given| config(&["core", "--listen", given]).unwrap().advertised;
        assert_eq!(core("192.0.2.2").to_string(), "http://192.0.2.2:12345/");
        assert_eq!(core("::1").to_string(), "http://[::1]:12345/");
        for all in ["0.0.0.0", "::"] {
            assert_eq!(core(all).to_string(), "http://robot:12345/");
        }
        let given = ["--listen", "127.0.0.3:4000"];
        let proxy = ["proxy", "--master", "http://m:1"];
        let proxy = config(&[&proxy[..], &given].concat()).unwrap().advertised;
        assert_eq!(proxy.to_string(), "http://127.0.0.3:4000/");
        // The environment comes first, because a NAT may be in front of this computer.
        let cli = Cli::parse_from(["rosrescue", "--listen", "192.0.2.2", "-p", "1"]);
        let env = |name: &str| (name == "ROS_IP").then(|| "10.0.0.7".to_owned());
        let config = Config::core(&cli.core, &env, "robot", None).unwrap();
        assert_eq!(config.advertised.to_string(), "http://10.0.0.7:1/");
    }

    #[test]
    fn inherited_sockets_are_advertised_as_they_are_bound() {
        let served = |address: &str, ip: Option<&str>| {
            let cli = Cli::parse_from(["rosrescue", "-p", "12000"]);
            let env = |name: &str| ip.filter(|_| name == "ROS_IP").map(str::to_owned);
            let mut config = Config::core(&cli.core, &env, "robot", None).unwrap();
            config.serve_at(vec![address.parse().unwrap()], &env);
            config.advertised.to_string()
        };
        assert_eq!(served("[::]:4000", None), "http://robot:4000/");
        assert_eq!(served("10.0.0.7:4000", None), "http://10.0.0.7:4000/");
        let behind_nat = served("10.0.0.7:4000", Some("192.0.2.1"));
        assert_eq!(behind_nat, "http://192.0.2.1:4000/");
    }

    #[test]
    fn the_sentinel_is_renewed_before_the_master_closes_it() {
        for (timeout, expected) in [("5", 400), ("0.5", 250), ("0.001", 10), ("0", 400)] {
            let renewal = config(&["-t", timeout]).unwrap().master.renewal();
            assert_eq!(renewal, Duration::from_millis(expected), "{timeout}");
        }
        let proxy = config(&["proxy", "--master", "http://m:1"]).unwrap();
        assert_eq!(proxy.master.renewal(), Duration::from_millis(400));
    }

    #[test]
    fn what_cannot_be_meant_is_refused_with_its_operand() {
        for (args, said) in [
            (&["proxy", "--master", "m:1"][..], "`m:1`"),
            (
                &["proxy", "--master", "http://m:1", "--listen", "here"],
                "`here`",
            ),
            (&["core", "--master-port", "12345"], "12345"),
            (&["core", "--hold", "-1"], "`-1`"),
            (&["core", "--timeout", "nan"], "`NaN`"),
            (&["core", "--listen", "robot"], "`robot`"),
        ] {
            let error = config(args).map(|_| ()).expect_err("refused").to_string();
            assert!(error.contains(said), "{error}");
        }
    }
}
