//! The commands that do not serve nodes, and their options.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};
use rescue_core::hide::{self, Hide};

use super::{
    ClusterArgs, DiffArgs, HandoverArgs, HistoryArgs, InspectArgs, LogArgs, OptionValue,
    ParamsArgs, ReportArgs, RestoreArgs, TopArgs, VerifyArgs, WaitArgs,
    service::{CompletionsArgs, InstallArgs, ManArgs, UninstallArgs},
};

/// The commands other than `core` and `proxy`.
#[derive(Debug, Subcommand)]
pub enum Tool {
    /// Check the robot's setup for problems
    Check(CheckArgs),
    /// Print a completion script for a shell
    Completions(CompletionsArgs),
    /// Show how two checkpoints differ, two times, or a checkpoint and the running master. Exit status 1 if they differ
    Diff(DiffArgs),
    /// Test the robot: kill the master on purpose, and report what calls, topics and nodes noticed
    Drill(DrillArgs),
    /// With --cluster: make another computer the leader
    Handover(HandoverArgs),
    /// List the past sessions and rescues
    History(HistoryArgs),
    /// Show what a checkpoint contains
    Inspect(InspectArgs),
    /// Install rosrescue as a systemd service that starts at boot
    Install(InstallArgs),
    /// Show what changed, when, and who did it
    Log(LogArgs),
    /// Print the manual page of a command, or write all manual pages into a folder
    Man(ManArgs),
    /// Print the parameters of a checkpoint, for `rosparam load`
    Params(ParamsArgs),
    /// Show the report of a rescue: its cause, duration and result
    Report(ReportArgs),
    /// Set the parameters of the running robot to those of a checkpoint or of an earlier time
    Restore(RestoreArgs),
    /// Show the status of the running rosrescue
    Status(StatusArgs),
    /// Show calls, callers, nodes and rescues live
    Top(TopArgs),
    /// Undo `rosrescue install`
    Uninstall(UninstallArgs),
    /// Check a checkpoint for damage. Exit status 1 if it is damaged
    Verify(VerifyArgs),
    /// Wait until rosrescue answers calls, for start scripts
    Wait(WaitArgs),
}

/// The running rosrescue that a command talks to.
#[derive(Args, Clone, Debug)]
pub struct TargetArgs {
    /// Address of the running rosrescue, http://HOST:PORT [default: ROS_MASTER_URI, else http://localhost:11311]
    #[arg(long, env = "ROSRESCUE_URI", value_name = "URI")]
    pub uri: Option<String>,
}

/// How a command prints its result.
#[derive(Args, Clone, Debug)]
pub struct OutputArgs {
    /// Print the result as one JSON object
    #[arg(long)]
    pub json: bool,
}

/// The parameters whose values are hidden.
#[derive(Args, Clone, Debug)]
pub struct HideArgs {
    /// Hide the values of parameters whose full name matches this regular expression. Case does not matter, and
    /// an empty expression hides nothing
    #[arg(long, env = "ROSRESCUE_HIDE_VALUES", value_name = "REGEX", default_value = hide::DEFAULT)]
    pub hide_values: Hide,
}

/// Options of `rosrescue status`.
#[derive(Args, Clone, Debug)]
pub struct StatusArgs {
    /// The running rosrescue.
    #[command(flatten)]
    pub target: TargetArgs,
    /// How to print the result.
    #[command(flatten)]
    pub output: OutputArgs,
}

/// Options of `rosrescue check`.
#[derive(Args, Clone, Debug)]
pub struct CheckArgs {
    /// The running rosrescue.
    #[command(flatten)]
    pub target: TargetArgs,
    /// Port that nodes use [default: the port of ROS_MASTER_URI, else 11311]
    #[arg(short, long, env = "ROSRESCUE_PORT", value_name = "PORT")]
    #[arg(value_parser = clap::value_parser!(u16).range(1..))]
    pub port: Option<u16>,
    /// The checkpoint file [default: latest-chkpt.yaml in $ROS_LOG_DIR, $ROS_HOME/log or ~/.ros/log;
    /// latest-chkpt-PORT.yaml for a port other than 11311]
    #[arg(long, env = "ROSRESCUE_CHECKPOINT", value_name = "FILE")]
    pub checkpoint: Option<PathBuf>,
    /// The rosmaster program [default: the one on the PATH, else in /opt/ros/*/bin]
    #[arg(long, env = "ROSRESCUE_ROSMASTER", value_name = "FILE")]
    pub rosmaster: Option<PathBuf>,
    /// Check for `proxy` in front of this master, http://HOST:PORT, instead of for `core`
    #[arg(short, long, env = "ROSRESCUE_MASTER", value_name = "URI")]
    pub master: Option<String>,
    /// Check the connections of the running robot instead: ask every subscriber whether it is connected to each
    /// publisher. Exit status 1 if a connection is missing
    #[arg(long)]
    pub live: bool,
    /// Configuration file of `core` or `proxy`: TOML, one `option = value` per line
    #[arg(long, env = "ROSRESCUE_CONFIG", value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// The cluster options of `core`.
    #[command(flatten)]
    pub cluster: ClusterArgs,
    /// How to print the result.
    #[command(flatten)]
    pub output: OutputArgs,
    /// The options of `core` or `proxy`, and where each value comes from.
    #[arg(skip)]
    pub settings: Vec<OptionValue>,
}

/// Options of `rosrescue drill`.
#[derive(Args, Clone, Debug)]
pub struct DrillArgs {
    /// The running rosrescue.
    #[command(flatten)]
    pub target: TargetArgs,
    /// What to kill, with SIGKILL
    #[arg(long, value_enum, default_value_t = Victim::Master)]
    pub kill: Victim,
    /// How many times to kill. The drill waits before a sixth death within a minute, because that would be a crash
    /// loop
    #[arg(long, value_name = "COUNT", default_value_t = 3)]
    #[arg(value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub times: u32,
    /// Make the master hang with SIGSTOP instead of killing it
    #[arg(long, conflicts_with_all = ["kill", "no_kill"])]
    pub hang: bool,
    /// Kill nothing, only watch for --seconds
    #[arg(long, conflicts_with_all = ["kill", "times"])]
    pub no_kill: bool,
    /// How long --no-kill watches, in seconds
    #[arg(long, value_name = "SECONDS", default_value_t = 10)]
    #[arg(value_parser = clap::value_parser!(u32).range(1..=86_400))]
    pub seconds: u32,
    /// Longest time for a rescue before the drill fails, in seconds
    #[arg(long, value_name = "SECONDS", default_value_t = 30)]
    #[arg(value_parser = clap::value_parser!(u32).range(1..=3600))]
    pub limit: u32,
    /// Topic to watch as a subscriber; may be repeated [default: up to five topics that robots drive
    /// by, or those with most messages]
    #[arg(long, value_name = "NAME", value_delimiter = ',')]
    pub topic: Vec<String>,
    /// Do not ask before killing
    #[arg(short, long)]
    pub yes: bool,
    /// How to print the result.
    #[command(flatten)]
    pub output: OutputArgs,
}

/// What a drill kills.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Victim {
    /// The rosmaster
    Master,
    /// rosrescue's worker
    Worker,
    /// Both at the same time
    Both,
}
