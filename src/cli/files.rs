//! Options of the commands on checkpoints.

use std::path::PathBuf;

use clap::Args;
use rescue_core::hide::Hide;

use super::{HideArgs, OutputArgs, TargetArgs, When};

/// Where the checkpoints are.
#[derive(Args, Clone, Debug)]
pub struct CheckpointArgs {
    /// The checkpoint in use; older ones are beside it [default: that of the rosrescue on this computer, else
    /// latest-chkpt.yaml in $ROS_LOG_DIR, $ROS_HOME/log or ~/.ros/log; latest-chkpt-PORT.yaml if ROS_MASTER_URI
    /// has a port other than 11311]
    #[arg(long, env = "ROSRESCUE_CHECKPOINT", value_name = "FILE")]
    pub checkpoint: Option<PathBuf>,
}

/// Whether a damaged checkpoint may be read.
#[derive(Args, Clone, Debug)]
pub struct ReadArgs {
    #[command(flatten)]
    pub checkpoint: CheckpointArgs,
    /// Use the readable part of a damaged checkpoint; `rosrescue verify` shows that part
    #[arg(long)]
    pub damaged: bool,
}

/// Options of `rosrescue inspect`.
#[derive(Args, Clone, Debug)]
pub struct InspectArgs {
    /// Checkpoint: a path, or a name or number from `rosrescue history` [default: the one in use]
    #[arg(value_name = "FILE")]
    pub file: Option<PathBuf>,
    /// Show the state at this time instead, from the log of changes. `rosrescue log --help` explains times
    #[arg(
        long,
        value_name = "TIME",
        conflicts_with = "file",
        allow_hyphen_values = true
    )]
    pub at: Option<When>,
    #[command(flatten)]
    pub read: ReadArgs,
    #[command(flatten)]
    pub hide: HideArgs,
    #[command(flatten)]
    pub output: OutputArgs,
}

/// Options of `rosrescue verify`.
#[derive(Args, Clone, Debug)]
pub struct VerifyArgs {
    /// Checkpoint: a path, or a name or number from `rosrescue history`
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    #[command(flatten)]
    pub checkpoint: CheckpointArgs,
    #[command(flatten)]
    pub output: OutputArgs,
}

/// Options of `rosrescue diff`.
#[derive(Args, Clone, Debug)]
pub struct DiffArgs {
    /// Checkpoint: a path, or a name or number from `rosrescue history`
    #[arg(value_name = "A", required_unless_present = "from")]
    pub a: Option<PathBuf>,
    /// Checkpoint to compare with
    #[arg(value_name = "B", required_unless_present_any = ["live", "from"])]
    pub b: Option<PathBuf>,
    /// Compare the states at two times instead, from the log of changes. `rosrescue log --help` explains times
    #[arg(long, value_name = "TIME", allow_hyphen_values = true)]
    #[arg(conflicts_with_all = ["a", "b", "live"])]
    pub from: Option<When>,
    /// The second time
    #[arg(long, value_name = "TIME", allow_hyphen_values = true)]
    #[arg(requires = "from", default_value = "now")]
    pub to: When,
    /// Compare with the running master, on any computer. Subscriptions to parameters are left out, because
    /// a master does not list them
    #[arg(long, conflicts_with = "b")]
    pub live: bool,
    #[command(flatten)]
    pub target: TargetArgs,
    #[command(flatten)]
    pub read: ReadArgs,
    #[command(flatten)]
    pub hide: HideArgs,
    #[command(flatten)]
    pub output: OutputArgs,
}

/// Options of `rosrescue history`.
#[derive(Args, Clone, Debug)]
pub struct HistoryArgs {
    #[command(flatten)]
    pub checkpoint: CheckpointArgs,
    #[command(flatten)]
    pub output: OutputArgs,
}

/// Options of `rosrescue log`.
#[derive(Args, Clone, Debug)]
pub struct LogArgs {
    /// Only changes of this parameter, or of parameters in this namespace. May be given several times
    #[arg(long, value_name = "NAME")]
    pub param: Vec<String>,
    /// Only changes of this topic. May be given several times
    #[arg(long, value_name = "NAME")]
    pub topic: Vec<String>,
    /// Only changes of this service. May be given several times
    #[arg(long, value_name = "NAME")]
    pub service: Vec<String>,
    /// Only changes by or of this node. May be given several times
    #[arg(long, value_name = "NAME")]
    pub node: Vec<String>,
    /// Only changes at this time or later, such as 14:03, 2026-11-26T14:03:05, -5min, -2h or -3d. Times are in UTC;
    /// without a date, 14:03 is the last one [default: all]
    #[arg(long, value_name = "TIME", allow_hyphen_values = true)]
    pub since: Option<When>,
    /// Only changes at this time or earlier
    #[arg(long, value_name = "TIME", allow_hyphen_values = true)]
    pub until: Option<When>,
    /// Show this many of the newest changes; 0 for all
    #[arg(short = 'n', long, value_name = "COUNT", default_value_t = 1000)]
    pub lines: usize,
    /// Continue with new changes until Ctrl-C
    #[arg(short, long)]
    pub follow: bool,
    /// Print one JSON object per line
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub checkpoint: CheckpointArgs,
    #[command(flatten)]
    pub hide: HideArgs,
}

/// Options of `rosrescue report`.
#[derive(Args, Clone, Debug)]
pub struct ReportArgs {
    /// Number of the rescue in `rosrescue status` or `rosrescue history` [default: the last one]
    #[arg(value_name = "NUMBER")]
    pub number: Option<u64>,
    /// Ask the rosrescue at this address, http://HOST:PORT, instead of reading files. It has the last 20 reports
    /// of its session
    #[arg(long, value_name = "URI")]
    pub uri: Option<String>,
    #[command(flatten)]
    pub checkpoint: CheckpointArgs,
    #[command(flatten)]
    pub output: OutputArgs,
}

/// Where a state comes from.
#[derive(Args, Clone, Debug)]
pub struct StateArgs {
    /// Checkpoint: a path, or a name or number from `rosrescue history`
    #[arg(value_name = "FILE", required_unless_present = "at")]
    pub file: Option<PathBuf>,
    /// Use the state at this time instead, from the log of changes. `rosrescue log --help` explains times
    #[arg(
        long,
        value_name = "TIME",
        conflicts_with = "file",
        allow_hyphen_values = true
    )]
    pub at: Option<When>,
}

/// Options of `rosrescue restore`.
#[derive(Args, Clone, Debug)]
pub struct RestoreArgs {
    #[command(flatten)]
    pub state: StateArgs,
    /// Set only this parameter, or the parameters in this namespace. May be given several times
    #[arg(long, value_name = "NAME")]
    pub param: Vec<String>,
    /// Only show the changes
    #[arg(long)]
    pub plan: bool,
    /// Do not ask. Required without a terminal
    #[arg(short, long, conflicts_with = "plan")]
    pub yes: bool,
    /// Also delete the parameters that are not in the checkpoint
    #[arg(long)]
    pub exact: bool,
    #[command(flatten)]
    pub target: TargetArgs,
    #[command(flatten)]
    pub read: ReadArgs,
    #[command(flatten)]
    pub hide: HideArgs,
    #[command(flatten)]
    pub output: OutputArgs,
}

/// Options of `rosrescue params`.
#[derive(Args, Clone, Debug)]
pub struct ParamsArgs {
    #[command(flatten)]
    pub state: StateArgs,
    /// Leave out parameters whose full name matches this regular expression. Case does not matter [default: none]
    #[arg(long, value_name = "REGEX")]
    pub hide_values: Option<Hide>,
    #[command(flatten)]
    pub read: ReadArgs,
    #[command(flatten)]
    pub output: OutputArgs,
}
