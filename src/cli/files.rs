//! Options of the commands on checkpoints.

use std::path::PathBuf;

use clap::Args;

use super::{HideArgs, OutputArgs, TargetArgs};
use crate::hide::Hide;

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
    pub place: CheckpointArgs,
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
    pub place: CheckpointArgs,
    #[command(flatten)]
    pub output: OutputArgs,
}

/// Options of `rosrescue diff`.
#[derive(Args, Clone, Debug)]
pub struct DiffArgs {
    /// Checkpoint: a path, or a name or number from `rosrescue history`
    #[arg(value_name = "A")]
    pub a: PathBuf,
    /// Checkpoint to compare with
    #[arg(value_name = "B", required_unless_present = "live")]
    pub b: Option<PathBuf>,
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
    pub place: CheckpointArgs,
    #[command(flatten)]
    pub output: OutputArgs,
}

/// Options of `rosrescue report`.
#[derive(Args, Clone, Debug)]
pub struct ReportArgs {
    /// Number of the rescue in `rosrescue status` or `rosrescue history` [default: the last one]
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
    /// Checkpoint: a path, or a name or number from `rosrescue history`
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
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
    /// Checkpoint: a path, or a name or number from `rosrescue history`
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// Leave out parameters whose full name matches this regular expression. Case does not matter [default: none]
    #[arg(long, env = "ROSRESCUE_PARAMS_HIDE_VALUES", value_name = "REGEX")]
    pub hide_values: Option<Hide>,
    #[command(flatten)]
    pub read: ReadArgs,
    #[command(flatten)]
    pub output: OutputArgs,
}
