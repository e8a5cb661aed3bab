//! Options of the commands on checkpoints.

use std::path::PathBuf;

use clap::Args;

use super::{HideArgs, OutputArgs, TargetArgs};
use crate::hide::Hide;

/// Where checkpoints are.
#[derive(Args, Clone, Debug)]
pub struct CheckpointArgs {
    /// The checkpoint in use, beside which others are kept [default: that of the rosrescue that runs on this
    /// computer, else latest-chkpt.yaml in $ROS_LOG_DIR, $ROS_HOME/log or ~/.ros/log;
    /// latest-chkpt-PORT.yaml if ROS_MASTER_URI has a port other than 11311]
    #[arg(long, env = "ROSRESCUE_CHECKPOINT", value_name = "FILE")]
    pub checkpoint: Option<PathBuf>,
}

/// How a checkpoint is read.
#[derive(Args, Clone, Debug)]
pub struct ReadArgs {
    #[command(flatten)]
    pub place: CheckpointArgs,
    /// Use what is left of a damaged checkpoint; `rosrescue verify` says what that is
    #[arg(long)]
    pub damaged: bool,
}

/// Options of `rosrescue inspect`.
#[derive(Args, Clone, Debug)]
pub struct InspectArgs {
    /// A checkpoint: its path, or its name or number in `rosrescue history` [default: the one in use]
    #[arg(value_name = "FILE")]
    pub file: Option<PathBuf>,
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
    /// A checkpoint: its path, or its name or number in `rosrescue history`
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    #[command(flatten)]
    pub place: CheckpointArgs,
    #[command(flatten)]
    pub output: OutputArgs,
}

/// Options of `rosrescue diff`.
#[derive(Args, Clone, Debug)]
pub struct DiffArgs {
    /// A checkpoint: its path, or its name or number in `rosrescue history`
    #[arg(value_name = "A")]
    pub a: PathBuf,
    /// The one to compare it with
    #[arg(value_name = "B", required_unless_present = "live")]
    pub b: Option<PathBuf>,
    /// Compare it with the running master, read by ordinary calls to rosrescue, on whatever computer: nodes and
    /// their addresses, publishers, subscribers, services, types and parameters. Who watches parameters cannot be
    /// read from a master
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
    pub place: CheckpointArgs,
    #[command(flatten)]
    pub output: OutputArgs,
}

/// Options of `rosrescue report`.
#[derive(Args, Clone, Debug)]
pub struct ReportArgs {
    /// The number of the rescue, as in `rosrescue status` and `rosrescue history` [default: the last one]
    #[arg(value_name = "NUMBER")]
    pub number: Option<u64>,
    #[command(flatten)]
    pub place: CheckpointArgs,
    #[command(flatten)]
    pub output: OutputArgs,
}

/// Options of `rosrescue restore`.
#[derive(Args, Clone, Debug)]
pub struct RestoreArgs {
    /// A checkpoint: its path, or its name or number in `rosrescue history`
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// Only say what would be done
    #[arg(long)]
    pub plan: bool,
    /// Do not ask. Without a terminal nothing is done otherwise
    #[arg(short, long, conflicts_with = "plan")]
    pub yes: bool,
    /// Also delete the parameters that the checkpoint does not have
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
    /// A checkpoint: its path, or its name or number in `rosrescue history`
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// Leave out parameters whose full name matches this regular expression, which ignores case [default: none]
    #[arg(long, env = "ROSRESCUE_PARAMS_HIDE_VALUES", value_name = "REGEX")]
    pub hide_values: Option<Hide>,
    #[command(flatten)]
    pub read: ReadArgs,
    #[command(flatten)]
    pub output: OutputArgs,
}
