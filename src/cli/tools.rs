//! The commands that do not serve nodes, and their options.

use clap::{Args, Subcommand, builder::FalseyValueParser};

use super::{
    DiffArgs, HistoryArgs, InspectArgs, ParamsArgs, RestoreArgs, TopArgs, VerifyArgs, WaitArgs,
};
use crate::hide::{self, Hide};

/// A command that looks at a rosrescue, a checkpoint or this computer.
#[derive(Debug, Subcommand)]
pub enum Tool {
    /// Say in words how two checkpoints differ, or a checkpoint and the running master. Exit status 1 if they do
    Diff(DiffArgs),
    /// List the checkpoints that are kept: of the last sessions, and of rescues
    History(HistoryArgs),
    /// Say what a checkpoint holds, also beside a running rosrescue
    Inspect(InspectArgs),
    /// Print the parameters of a checkpoint, for `rosparam load`
    Params(ParamsArgs),
    /// Put a checkpoint back into a running rosrescue: its parameters, and the registrations of its nodes that are
    /// alive. First says what it would do
    Restore(RestoreArgs),
    /// Say how the running rosrescue is, in ten lines
    Status(StatusArgs),
    /// Show live what goes on: calls a second, slowest callers, nodes, rescues
    Top(TopArgs),
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
