//! The commands that do not serve nodes, and their options.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum, builder::FalseyValueParser};

use super::{
    ClusterArgs, DiffArgs, HandoverArgs, HistoryArgs, InspectArgs, ParamsArgs, ReportArgs,
    RestoreArgs, TopArgs, VerifyArgs, WaitArgs,
    service::{CompletionsArgs, InstallArgs, ManArgs, UninstallArgs},
};
use crate::hide::{self, Hide};

/// A command that looks at a rosrescue, a checkpoint or this computer.
#[derive(Debug, Subcommand)]
pub enum Tool {
    /// Look for what will trouble the robot, before it drives
    Check(CheckArgs),
    /// Print a completion script for a shell
    Completions(CompletionsArgs),
    /// Say in words how two checkpoints differ, or a checkpoint and the running master. Exit status 1 if they do
    Diff(DiffArgs),
    /// Kill the master on purpose while watching calls, topics and nodes, and give a verdict
    Drill(DrillArgs),
    /// With --cluster: let another computer lead, and wait until it does
    Handover(HandoverArgs),
    /// List the checkpoints that are kept: of the last sessions, and of rescues
    History(HistoryArgs),
    /// Say what a checkpoint holds, also beside a running rosrescue
    Inspect(InspectArgs),
    /// Make a service of systemd of it, which starts with the computer
    Install(InstallArgs),
    /// Print the manual page, or write all of them into a folder
    Man(ManArgs),
    /// Print the parameters of a checkpoint, for `rosparam load`
    Params(ParamsArgs),
    /// Show the report of a rescue: cause, duration, and what was done
    Report(ReportArgs),
    /// Put a checkpoint back into a running rosrescue: its parameters, and the registrations of its nodes that are
    /// alive. First says what it would do
    Restore(RestoreArgs),
    /// Say how the running rosrescue is, in ten lines
    Status(StatusArgs),
    /// Show live what goes on: calls a second, slowest callers, nodes, rescues
    Top(TopArgs),
    /// Take back what `rosrescue install` has done
    Uninstall(UninstallArgs),
    /// Check that a checkpoint is whole. If it is damaged, say what can still be used, with exit status 1
    Verify(VerifyArgs),
    /// Wait until calls are answered, for start scripts
    Wait(WaitArgs),
}

/// Which running rosrescue is meant.
#[derive(Args, Clone, Debug)]
pub struct TargetArgs {
    /// The running rosrescue, http://HOST:PORT [default: ROS_MASTER_URI, else http://localhost:11311]
    #[arg(long, env = "ROSRESCUE_URI", value_name = "URI")]
    pub uri: Option<String>,
}

/// How a command prints its result.
#[derive(Args, Clone, Debug)]
pub struct OutputArgs {
    /// Print the result as one JSON object
    #[arg(long, env = "ROSRESCUE_JSON")]
    #[arg(value_parser = FalseyValueParser::new())]
    pub json: bool,
}

/// Which values of parameters are not shown.
#[derive(Args, Clone, Debug)]
pub struct HideArgs {
    /// Hide the values of parameters whose full name matches this regular expression, which ignores case;
    /// an empty one hides nothing
    #[arg(long, env = "ROSRESCUE_HIDE_VALUES", value_name = "REGEX", default_value = hide::DEFAULT)]
    pub hide_values: Hide,
}

/// Options of `rosrescue status`.
#[derive(Args, Clone, Debug)]
pub struct StatusArgs {
    /// Which one.
    #[command(flatten)]
    pub target: TargetArgs,
    /// In which form.
    #[command(flatten)]
    pub output: OutputArgs,
}

/// Options of `rosrescue check`.
#[derive(Args, Clone, Debug)]
pub struct CheckArgs {
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
    /// Ask the nodes of the running robot instead: is each subscriber connected to each publisher of its
    /// topics? Exit status 1 if a link is missing
    #[arg(long)]
    pub live: bool,
    /// Several computers, as `core` is told of them.
    #[command(flatten)]
    pub cluster: ClusterArgs,
    /// In which form.
    #[command(flatten)]
    pub output: OutputArgs,
}

/// Options of `rosrescue drill`.
#[derive(Args, Clone, Debug)]
pub struct DrillArgs {
    /// Which one.
    #[command(flatten)]
    pub target: TargetArgs,
    /// What is killed: each time with SIGKILL
    #[arg(long, env = "ROSRESCUE_DRILL_KILL", value_enum, default_value_t = Victim::Master)]
    pub kill: Victim,
    /// How often. More than five deaths within a minute are a crash loop, so from the sixth on the
    /// drill waits for the minute to pass
    #[arg(
        long,
        env = "ROSRESCUE_DRILL_TIMES",
        value_name = "COUNT",
        default_value_t = 3
    )]
    #[arg(value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub times: u32,
    /// Stop the master with SIGSTOP instead of killing it, so that it hangs
    #[arg(long, conflicts_with_all = ["kill", "no_kill"])]
    pub hang: bool,
    /// Kill nothing: only watch, for --seconds
    #[arg(long, conflicts_with_all = ["kill", "times"])]
    pub no_kill: bool,
    /// How long --no-kill watches, in seconds
    #[arg(
        long,
        env = "ROSRESCUE_DRILL_SECONDS",
        value_name = "SECONDS",
        default_value_t = 10
    )]
    #[arg(value_parser = clap::value_parser!(u32).range(1..=86_400))]
    pub seconds: u32,
    /// How long a recovery may take before the drill has failed, in seconds
    #[arg(
        long,
        env = "ROSRESCUE_DRILL_LIMIT",
        value_name = "SECONDS",
        default_value_t = 30
    )]
    #[arg(value_parser = clap::value_parser!(u32).range(1..=3600))]
    pub limit: u32,
    /// A topic to watch, as a subscriber; may be repeated [default: up to three that carry messages]
    #[arg(
        long,
        env = "ROSRESCUE_DRILL_TOPIC",
        value_name = "NAME",
        value_delimiter = ','
    )]
    pub topic: Vec<String>,
    /// Do not ask before anything is killed
    #[arg(short, long)]
    pub yes: bool,
    /// In which form.
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
    /// Both at once
    Both,
}
