//! Options of `core` and `proxy`.

use std::{net::IpAddr, path::PathBuf};

use clap::{Args, ValueEnum, builder::FalseyValueParser};
use ipnet::IpNet;

use super::{cluster_args::ClusterArgs, tools::HideArgs};

/// Heading of the options that few robots need.
const ADVANCED: &str = "Advanced options";

/// Options of `rosrescue core`. The options with a short form are roscore's.
#[derive(Args, Clone, Debug)]
pub struct CoreArgs {
    /// Port that nodes use [default: the port of ROS_MASTER_URI, else 11311]
    #[arg(short, long, env = "ROSRESCUE_PORT", value_name = "PORT")]
    #[arg(value_parser = clap::value_parser!(u16).range(1..))]
    pub port: Option<u16>,
    /// Log more: rosrescue's own messages at level debug, unless --log says otherwise
    #[arg(short, long, env = "ROSRESCUE_VERBOSE")]
    #[arg(value_parser = FalseyValueParser::new())]
    pub verbose: bool,
    /// Number of rosmaster threads that notify nodes. roscore has 3. With more threads, an unreachable
    /// node delays other nodes less
    #[arg(short = 'w', long, env = "ROSRESCUE_NUMWORKERS", value_name = "COUNT", help_heading = ADVANCED)]
    #[arg(default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub numworkers: u32,
    /// Socket timeout of rosmaster for unreachable nodes, in seconds; 0 for none
    #[arg(short = 't', long, env = "ROSRESCUE_TIMEOUT", value_name = "SECONDS", help_heading = ADVANCED)]
    #[arg(default_value_t = 5.0)]
    pub timeout: f64,
    /// Longest time until a started rosmaster listens, in seconds. A rosmaster that is still busy gets more
    #[arg(
        long,
        env = "ROSRESCUE_START_LIMIT",
        value_name = "SECONDS",
        hide = true
    )]
    #[arg(default_value_t = 30, value_parser = clap::value_parser!(u64).range(1..=3600))]
    pub start_limit: u64,
    /// Port of the rosmaster behind rosrescue, on loopback [default: a free one]
    #[arg(long, env = "ROSRESCUE_MASTER_PORT", value_name = "PORT", hide = true)]
    #[arg(value_parser = clap::value_parser!(u16).range(1..))]
    pub master_port: Option<u16>,
    /// The rosmaster program [default: the one on the PATH, else in /opt/ros/*/bin]
    #[arg(long, env = "ROSRESCUE_ROSMASTER", value_name = "FILE", help_heading = ADVANCED)]
    pub rosmaster: Option<PathBuf>,
    /// Do not run rosout
    #[arg(long, env = "ROSRESCUE_NO_ROSOUT")]
    #[arg(value_parser = FalseyValueParser::new())]
    pub no_rosout: bool,
    /// Address to listen on [default: all addresses; loopback if ROS_IP or ROS_HOSTNAME is loopback]
    #[arg(long, env = "ROSRESCUE_LISTEN", value_name = "ADDR")]
    pub listen: Option<String>,
    /// The options for several computers.
    #[command(flatten)]
    pub cluster: ClusterArgs,
    /// The options that `core` and `proxy` share.
    #[command(flatten)]
    pub common: CommonArgs,
}

/// Options of `rosrescue proxy`.
#[derive(Args, Clone, Debug)]
pub struct ProxyArgs {
    /// Address of the real master, http://HOST:PORT
    #[arg(short, long, env = "ROSRESCUE_MASTER", value_name = "URI")]
    pub master: String,
    /// Address and port to listen on: ADDR:PORT, ADDR, :PORT or PORT [default: all addresses, port of
    /// ROS_MASTER_URI, else 11311]
    #[arg(short, long, env = "ROSRESCUE_LISTEN", value_name = "ADDR:PORT")]
    pub listen: Option<String>,
    /// Log more: rosrescue's own messages at level debug, unless --log says otherwise
    #[arg(short, long, env = "ROSRESCUE_VERBOSE")]
    #[arg(value_parser = FalseyValueParser::new())]
    pub verbose: bool,
    /// The options that `core` and `proxy` share.
    #[command(flatten)]
    pub common: CommonArgs,
}

/// Options that `core` and `proxy` share.
#[derive(Args, Clone, Debug)]
pub struct CommonArgs {
    /// Configuration file: TOML, one `option = value` per line. The environment and the command line override it
    #[arg(long, env = "ROSRESCUE_CONFIG", value_name = "FILE", help_heading = ADVANCED)]
    pub config: Option<PathBuf>,
    /// File that records the state of the master [default: latest-chkpt.yaml in $ROS_LOG_DIR, $ROS_HOME/log or
    /// ~/.ros/log; latest-chkpt-PORT.yaml for a port other than 11311]
    #[arg(long, env = "ROSRESCUE_CHECKPOINT", value_name = "FILE")]
    pub checkpoint: Option<PathBuf>,
    /// Whether a start restores the checkpoint
    #[arg(long, env = "ROSRESCUE_RESTORE", value_enum, default_value_t = RestoreChoice::Auto)]
    pub restore: RestoreChoice,
    /// Maximum space for the past, in MiB. A quarter is for the last 5 sessions and 20 rescues, the rest for the log
    #[arg(
        long,
        env = "ROSRESCUE_HISTORY",
        value_name = "MIB",
        default_value_t = 64,
        hide = true
    )]
    #[arg(value_parser = clap::value_parser!(u64).range(..=1 << 20))]
    pub history: u64,
    /// When to force recorded changes to the disk. They survive kill -9 in any case
    #[arg(long, env = "ROSRESCUE_SYNC", value_enum, default_value_t = SyncPolicy::Interval)]
    pub sync: SyncPolicy,
    /// How often `--sync interval` forces the journal to the disk, in milliseconds
    #[arg(
        long,
        env = "ROSRESCUE_SYNC_INTERVAL",
        value_name = "MS",
        default_value_t = 200,
        hide = true
    )]
    #[arg(value_parser = clap::value_parser!(u64).range(1..=60_000))]
    pub sync_interval: u64,
    /// Longest wait, in seconds, for a call that only a master can answer. Then its connection is closed
    #[arg(
        long,
        env = "ROSRESCUE_HOLD",
        allow_negative_numbers = true,
        value_name = "SECONDS",
        default_value_t = 8.0,
        help_heading = ADVANCED
    )]
    pub hold: f64,
    /// Pause between two probes of the master, in milliseconds
    #[arg(
        long,
        env = "ROSRESCUE_PROBE_INTERVAL",
        value_name = "MS",
        default_value_t = 1000,
        hide = true
    )]
    #[arg(value_parser = clap::value_parser!(u64).range(10..=3_600_000))]
    pub probe_interval: u64,
    /// Longest time for the master to answer a probe, in milliseconds
    #[arg(
        long,
        env = "ROSRESCUE_PROBE_TIMEOUT",
        value_name = "MS",
        default_value_t = 500,
        hide = true
    )]
    #[arg(value_parser = clap::value_parser!(u64).range(10..=3_600_000))]
    pub probe_timeout: u64,
    /// Number of unanswered probes in a row after which the master counts as hung. rosrescue kills it only if
    /// its process shows that it hangs
    #[arg(
        long,
        env = "ROSRESCUE_PROBE_COUNT",
        value_name = "COUNT",
        default_value_t = 3,
        hide = true
    )]
    #[arg(value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub probe_count: u32,
    /// How long a write waits for the master before rosrescue answers it, in milliseconds. The time grows while
    /// the master is often late
    #[arg(
        long,
        env = "ROSRESCUE_STAND_IN_AFTER",
        value_name = "MS",
        default_value_t = 100,
        hide = true
    )]
    #[arg(value_parser = clap::value_parser!(u64).range(10..=3_600_000))]
    pub stand_in_after: u64,
    /// Longest time for a node to answer a notification or a health check, in milliseconds
    #[arg(
        long,
        env = "ROSRESCUE_NODE_TIMEOUT",
        value_name = "MS",
        default_value_t = 3000,
        hide = true
    )]
    #[arg(value_parser = clap::value_parser!(u64).range(10..=600_000))]
    pub node_timeout: u64,
    /// Which dead nodes to unregister between rescues
    #[arg(long, env = "ROSRESCUE_REAP", value_name = "NODES", value_enum, default_value_t = ReapNodes::Report)]
    pub reap: ReapNodes,
    /// Networks and addresses that may call, as in 10.0.0.0/24 or fd00::/64. This computer always may
    /// [default: all]
    #[arg(
        long,
        env = "ROSRESCUE_ALLOW",
        value_name = "NET",
        value_delimiter = ','
    )]
    #[arg(value_parser = network)]
    pub allow: Vec<IpNet>,
    /// Networks and addresses that may make changes; all others can only read. Include every computer with nodes
    /// [default: all that may call]
    #[arg(
        long,
        env = "ROSRESCUE_ALLOW_WRITE",
        value_name = "NET",
        value_delimiter = ','
    )]
    #[arg(value_parser = network)]
    pub allow_write: Vec<IpNet>,
    /// How often to check whether someone changed the master directly, in seconds; 0 for only when in doubt
    #[arg(
        long,
        env = "ROSRESCUE_RESYNC_INTERVAL",
        value_name = "SECONDS",
        default_value_t = 0.0,
        hide = true
    )]
    #[arg(allow_negative_numbers = true)]
    pub resync_interval: f64,
    /// Who answers reads while there is a master. The mirror, rosrescue's own copy, is several times faster.
    /// Choose the master if programs call it directly [default: mirror for core, master for proxy]
    #[arg(long, env = "ROSRESCUE_READS", value_enum, hide = true)]
    pub reads: Option<Reads>,
    /// Who answers writes while there is a master: the mirror, as soon as the disk has them, or the master within
    /// 100 ms [default: master]
    #[arg(long, env = "ROSRESCUE_WRITES", value_enum, hide = true)]
    pub writes: Option<Writes>,
    /// Number of connections to the master for reads
    #[arg(
        long,
        env = "ROSRESCUE_MASTER_CONNECTIONS",
        value_name = "COUNT",
        default_value_t = 4,
        hide = true
    )]
    #[arg(value_parser = clap::value_parser!(u32).range(1..=64))]
    pub master_connections: u32,
    /// Maximum number of client connections; further clients wait. Half of the connections, 2000 at most, may be idle
    #[arg(
        long,
        env = "ROSRESCUE_MAX_CONNECTIONS",
        value_name = "COUNT",
        default_value_t = 10_000,
        hide = true
    )]
    #[arg(value_parser = clap::value_parser!(u32).range(2..=1_000_000))]
    pub max_connections: u32,
    /// Largest request body, in MiB
    #[arg(
        long,
        env = "ROSRESCUE_MAX_BODY",
        value_name = "MIB",
        default_value_t = 64,
        hide = true
    )]
    #[arg(value_parser = clap::value_parser!(u64).range(1..=1024))]
    pub max_body: u64,
    /// The parameters whose values are hidden, on pages and in logs.
    #[command(flatten)]
    pub hide: HideArgs,
    /// Run without the guardian process, which keeps the port open and restarts rosrescue. With a systemd socket
    /// unit there is none anyway
    #[arg(long, env = "ROSRESCUE_NO_GUARDIAN")]
    #[arg(value_parser = FalseyValueParser::new())]
    pub no_guardian: bool,
    /// What is logged, and how.
    #[command(flatten)]
    pub logging: LoggingArgs,
}

/// Options for the log on stderr.
#[derive(Args, Clone, Debug)]
pub struct LoggingArgs {
    /// Format of the log on stderr
    #[arg(long, env = "ROSRESCUE_LOG_FORMAT", value_enum, default_value_t = LogFormat::Text)]
    pub log_format: LogFormat,
    /// What to log: a level, or MODULE=LEVEL, separated by commas [default: warn,rosrescue=info]
    #[arg(long, env = "ROSRESCUE_LOG", value_name = "FILTER")]
    pub log: Option<String>,
}

/// Parses a network, or an address as a network of one. An IPv4 network written as IPv6 (`::ffff:10.0.0.0/120`) becomes
/// an IPv4 network.
fn network(text: &str) -> Result<IpNet, &'static str> {
    let net = text.parse::<IpNet>();
    let net = net.or_else(|_| text.parse::<IpAddr>().map(IpNet::from));
    let net =
        net.map_err(|_| "write a network or an address, as in 10.0.0.0/24, 10.0.0.7 or fd00::/64")?;
    let mapped = match net {
        IpNet::V6(net) => net
            .addr()
            .to_ipv4_mapped()
            .zip(net.prefix_len().checked_sub(96)),
        IpNet::V4(_) => None,
    };
    let mapped = mapped.and_then(|(address, length)| IpNet::new(address.into(), length).ok());
    Ok(mapped.unwrap_or(net))
}

/// When a checkpoint is restored at the start.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum RestoreChoice {
    /// After a crash or kill without a reboot, or if a registered node still answers
    Auto,
    /// Always
    Always,
    /// Not at a first start. The old file stays under another name
    Never,
}

/// When rosrescue forces the journal to the disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum SyncPolicy {
    /// Before each answer: a power cut loses nothing
    Always,
    /// Every 200 ms: a power cut loses at most that
    Interval,
    /// Leave it to the operating system
    Never,
}

/// The dead nodes that rosrescue unregisters between rescues.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ReapNodes {
    /// None. The log says which nodes `local` would have unregistered
    Report,
    /// Nodes of this computer, within 2 s after their process has ended
    Local,
    /// Also nodes that fail a health check
    All,
}

/// The side that answers reads.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Reads {
    /// The mirror
    Mirror,
    /// The master while it is available
    Master,
}

/// The side that answers writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Writes {
    /// The mirror, where it knows the master's answer
    Mirror,
    /// The master while it is available
    Master,
}

/// Format of the log.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// One line per message
    Text,
    /// One JSON object per message
    Json,
}

#[cfg(test)]
mod tests {
    use super::network;

    #[test]
    fn a_network_is_written_in_many_ways() {
        for (text, is) in [
            ("10.0.0.0/24", "10.0.0.0/24"),
            ("10.0.0.7", "10.0.0.7/32"),
            ("fd00::/64", "fd00::/64"),
            ("::1", "::1/128"),
            ("::ffff:10.0.0.0/120", "10.0.0.0/24"),
            ("::ffff:10.0.0.7", "10.0.0.7/32"),
            ("::/0", "::/0"),
        ] {
            assert_eq!(network(text).map(|net| net.to_string()), Ok(is.to_owned()));
        }
        for text in [
            "",
            "robot",
            "10.0.0.0/33",
            "10.0.0",
            "10.0.0.1-9",
            "fd00::/129",
            "*",
        ] {
            assert!(network(text).is_err(), "{text}");
        }
    }
}
