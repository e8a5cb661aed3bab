//! Options of `core` and `proxy`.

use std::{net::IpAddr, path::PathBuf};

use clap::{Args, ValueEnum, builder::FalseyValueParser};
use ipnet::IpNet;

use super::{cluster::ClusterArgs, tools::HideArgs};

/// Options of `rosrescue core`. The short ones are roscore's.
#[derive(Args, Clone, Debug)]
pub struct CoreArgs {
    /// Port that nodes use [default: the port of ROS_MASTER_URI, else 11311]
    #[arg(short, long, env = "ROSRESCUE_PORT", value_name = "PORT")]
    #[arg(value_parser = clap::value_parser!(u16).range(1..))]
    pub port: Option<u16>,
    /// Print more: rosrescue's own log at level debug, unless --log says otherwise
    #[arg(short, long, env = "ROSRESCUE_VERBOSE")]
    #[arg(value_parser = FalseyValueParser::new())]
    pub verbose: bool,
    /// Threads with which rosmaster notifies nodes. roscore has 3; more keep nodes that cannot be
    /// reached from holding up the others, but each makes writes that notify slower
    #[arg(short = 'w', long, env = "ROSRESCUE_NUMWORKERS", value_name = "COUNT")]
    #[arg(default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub numworkers: u32,
    /// Socket timeout of rosmaster in seconds, for nodes that cannot be reached; 0 for none. It is
    /// probed at least twice in this time, since it closes connections that are idle for longer
    #[arg(short = 't', long, env = "ROSRESCUE_TIMEOUT", value_name = "SECONDS")]
    #[arg(default_value_t = 5.0)]
    pub timeout: f64,
    /// Seconds a started rosmaster may take to listen. One that still uses the processor then is given
    /// more time
    #[arg(long, env = "ROSRESCUE_START_LIMIT", value_name = "SECONDS")]
    #[arg(default_value_t = 30, value_parser = clap::value_parser!(u64).range(1..=3600))]
    pub start_limit: u64,
    /// Port of the rosmaster behind the proxy, on loopback [default: a free one]
    #[arg(long, env = "ROSRESCUE_MASTER_PORT", value_name = "PORT")]
    #[arg(value_parser = clap::value_parser!(u16).range(1..))]
    pub master_port: Option<u16>,
    /// The rosmaster program [default: the one on the PATH, else in /opt/ros/*/bin]
    #[arg(long, env = "ROSRESCUE_ROSMASTER", value_name = "FILE")]
    pub rosmaster: Option<PathBuf>,
    /// Keep a second rosmaster that has loaded its program and takes over when the first one dies: 25 MB
    /// more memory, and the new master is there in a fraction of the time. Not with --rosmaster
    #[arg(long, env = "ROSRESCUE_SPARE_MASTER")]
    #[arg(value_parser = FalseyValueParser::new())]
    pub spare_master: bool,
    /// Do not run rosout
    #[arg(long, env = "ROSRESCUE_NO_ROSOUT")]
    #[arg(value_parser = FalseyValueParser::new())]
    pub no_rosout: bool,
    /// Address to serve, instead of all addresses (loopback only if ROS_IP or ROS_HOSTNAME is)
    #[arg(long, env = "ROSRESCUE_LISTEN", value_name = "ADDR")]
    pub listen: Option<String>,
    /// Of several computers.
    #[command(flatten)]
    pub cluster: ClusterArgs,
    /// What both commands have.
    #[command(flatten)]
    pub common: CommonArgs,
}

/// Options of `rosrescue proxy`.
#[derive(Args, Clone, Debug)]
pub struct ProxyArgs {
    /// The real master, http://HOST:PORT
    #[arg(short, long, env = "ROSRESCUE_MASTER", value_name = "URI")]
    pub master: String,
    /// Address and port to serve, ADDR:PORT, ADDR, :PORT or PORT [default: all addresses, port of
    /// ROS_MASTER_URI, else 11311]
    #[arg(short, long, env = "ROSRESCUE_LISTEN", value_name = "ADDR:PORT")]
    pub listen: Option<String>,
    /// Print more: rosrescue's own log at level debug, unless --log says otherwise
    #[arg(short, long, env = "ROSRESCUE_VERBOSE")]
    #[arg(value_parser = FalseyValueParser::new())]
    pub verbose: bool,
    /// What both commands have.
    #[command(flatten)]
    pub common: CommonArgs,
}

/// Options of both commands.
#[derive(Args, Clone, Debug)]
pub struct CommonArgs {
    /// The checkpoint file [default: latest-chkpt.yaml in $ROS_LOG_DIR, $ROS_HOME/log or ~/.ros/log;
    /// latest-chkpt-PORT.yaml for a port other than 11311]
    #[arg(long, env = "ROSRESCUE_CHECKPOINT", value_name = "FILE")]
    pub checkpoint: Option<PathBuf>,
    /// When to restore the state of the checkpoint at the start of rosrescue
    #[arg(long, env = "ROSRESCUE_RESTORE", value_enum, default_value_t = RestoreChoice::Auto)]
    pub restore: RestoreChoice,
    /// Most space for the checkpoints that are kept: of the last five sessions, and of the last twenty rescues,
    /// in MiB; 0 for the last session alone. `rosrescue history` lists them
    #[arg(
        long,
        env = "ROSRESCUE_HISTORY",
        value_name = "MIB",
        default_value_t = 16
    )]
    #[arg(value_parser = clap::value_parser!(u64).range(..=1 << 20))]
    pub history: u64,
    /// When the journal is forced to the disk; it survives kill -9 in any case
    #[arg(long, env = "ROSRESCUE_SYNC", value_enum, default_value_t = SyncPolicy::Interval)]
    pub sync: SyncPolicy,
    /// How often `--sync interval` does so, in milliseconds
    #[arg(
        long,
        env = "ROSRESCUE_SYNC_INTERVAL",
        value_name = "MS",
        default_value_t = 200
    )]
    #[arg(value_parser = clap::value_parser!(u64).range(1..=60_000))]
    pub sync_interval: u64,
    /// How long a call that only a master can answer, such as one that cannot be decoded, waits for one
    /// to come back before its connection is closed, in seconds
    #[arg(
        long,
        env = "ROSRESCUE_HOLD",
        allow_negative_numbers = true,
        value_name = "SECONDS",
        default_value_t = 8.0
    )]
    pub hold: f64,
    /// Pause between two probes of the master, in milliseconds
    #[arg(
        long,
        env = "ROSRESCUE_PROBE_INTERVAL",
        value_name = "MS",
        default_value_t = 1000
    )]
    #[arg(value_parser = clap::value_parser!(u64).range(10..=3_600_000))]
    pub probe_interval: u64,
    /// Time in which the master must answer a probe, in milliseconds
    #[arg(
        long,
        env = "ROSRESCUE_PROBE_TIMEOUT",
        value_name = "MS",
        default_value_t = 500
    )]
    #[arg(value_parser = clap::value_parser!(u64).range(10..=3_600_000))]
    pub probe_timeout: u64,
    /// Number of unanswered probes in a row after which the master is taken for hung. rosrescue kills
    /// it only if its process shows that it hangs
    #[arg(
        long,
        env = "ROSRESCUE_PROBE_COUNT",
        value_name = "COUNT",
        default_value_t = 3
    )]
    #[arg(value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub probe_count: u32,
    /// Time a write waits for the master before rosrescue answers it, in milliseconds. It grows while
    /// the master is late again and again
    #[arg(
        long,
        env = "ROSRESCUE_STAND_IN_AFTER",
        value_name = "MS",
        default_value_t = 100
    )]
    #[arg(value_parser = clap::value_parser!(u64).range(10..=3_600_000))]
    pub stand_in_after: u64,
    /// Time in which a node must answer a notification or the health check, in milliseconds
    #[arg(
        long,
        alias = "census-timeout",
        env = "ROSRESCUE_NODE_TIMEOUT",
        value_name = "MS",
        default_value_t = 3000
    )]
    #[arg(value_parser = clap::value_parser!(u64).range(10..=600_000))]
    pub node_timeout: u64,
    /// Take out nodes that have died, so that they do not stay registered for ever: every node is asked so
    /// often whether it lives, in seconds, and any other node registered with the port of a node that registers
    /// is taken out first. 0 for only after a recovery, as ROS has it
    #[arg(
        long,
        env = "ROSRESCUE_REAP_DEAD_NODES",
        value_name = "SECONDS",
        default_value_t = 0.0
    )]
    #[arg(allow_negative_numbers = true)]
    pub reap_dead_nodes: f64,
    /// Networks and addresses that may call, as in 10.0.0.0/24 or fd00::/64; all others are refused but
    /// this computer, which always may [default: everybody]
    #[arg(
        long,
        env = "ROSRESCUE_ALLOW",
        value_name = "NET",
        value_delimiter = ','
    )]
    #[arg(value_parser = network)]
    pub allow: Vec<IpNet>,
    /// Networks and addresses that may change anything; of others that may call only reads are taken. Every
    /// node changes something when it starts [default: everybody who may call]
    #[arg(
        long,
        env = "ROSRESCUE_ALLOW_WRITE",
        value_name = "NET",
        value_delimiter = ','
    )]
    #[arg(value_parser = network)]
    pub allow_write: Vec<IpNet>,
    /// How often the mirror is compared with the master, for writes that reached it past the proxy,
    /// in seconds; 0 for never (it is compared at each connect and after each doubt anyway)
    #[arg(
        long,
        env = "ROSRESCUE_RESYNC_INTERVAL",
        value_name = "SECONDS",
        default_value_t = 0.0
    )]
    #[arg(allow_negative_numbers = true)]
    pub resync_interval: f64,
    /// Who answers calls that only read while there is a master. The mirror is several times faster and
    /// sees every write that was acknowledged; what it would not answer to the byte as the master does is
    /// forwarded. Choose the master where somebody calls it past rosrescue
    /// [default: mirror for core, master for proxy]
    #[arg(long, env = "ROSRESCUE_READS", value_enum)]
    pub reads: Option<Reads>,
    /// Connections to the master for calls that only read
    #[arg(
        long,
        env = "ROSRESCUE_MASTER_CONNECTIONS",
        value_name = "COUNT",
        default_value_t = 4
    )]
    #[arg(value_parser = clap::value_parser!(u32).range(1..=64))]
    pub master_connections: u32,
    /// Connections that clients may hold at the same time; more wait. Half of them may be idle, but
    /// no more than 2000: the one that has been idle for longest gives way. A low `ulimit -n` leaves
    /// fewer, but always 16 if so many are given
    #[arg(
        long,
        env = "ROSRESCUE_MAX_CONNECTIONS",
        value_name = "COUNT",
        default_value_t = 10_000
    )]
    #[arg(value_parser = clap::value_parser!(u32).range(2..=1_000_000))]
    pub max_connections: u32,
    /// Largest request body, in MiB
    #[arg(
        long,
        env = "ROSRESCUE_MAX_BODY",
        value_name = "MIB",
        default_value_t = 64
    )]
    #[arg(value_parser = clap::value_parser!(u64).range(1..=1024))]
    pub max_body: u64,
    /// Of what the page shows.
    #[command(flatten)]
    pub hide: HideArgs,
    /// Run as a single process, without a guardian that keeps the port and starts rosrescue again
    /// when it dies: for a debugger, or under a supervisor that does so. A socket unit of systemd
    /// takes the guardian's place by itself
    #[arg(long, env = "ROSRESCUE_NO_GUARDIAN")]
    #[arg(value_parser = FalseyValueParser::new())]
    pub no_guardian: bool,
    /// Form of the log on stderr
    #[arg(long, env = "ROSRESCUE_LOG_FORMAT", value_enum, default_value_t = LogFormat::Text)]
    pub log_format: LogFormat,
    /// What to log, in the syntax of tracing's EnvFilter [default: warn,rosrescue=info]
    #[arg(long, env = "ROSRESCUE_LOG", value_name = "FILTER")]
    pub log: Option<String>,
}

/// A network, or the one of a single address. An IPv4 network written as IPv6 (`::ffff:10.0.0.0/120`) is an
/// IPv4 network.
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

/// Whether a checkpoint is restored at start.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum RestoreChoice {
    /// If the session goes on: same boot and no orderly stop, or a registered node still lives
    Auto,
    /// Always
    Always,
    /// Never: the old file is kept under another name
    Never,
}

/// When the journal is forced to the disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum SyncPolicy {
    /// Before a call is answered: survives a power cut whole
    Always,
    /// Every --sync-interval: a power cut may cost that much
    Interval,
    /// When the system likes
    Never,
}

/// Who answers reads.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Reads {
    /// The mirror
    Mirror,
    /// The master, as long as there is one
    Master,
}

/// Form of the log.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// A line a message
    Text,
    /// A JSON object a message
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
