//! The commands that do not serve nodes, and their options.

use clap::{Args, Subcommand, builder::FalseyValueParser};

use super::{TopArgs, WaitArgs};
use crate::hide::{self, Hide};

/// A command that looks at a rosrescue, a checkpoint or this computer.
#[derive(Debug, Subcommand)]
pub enum Tool {
    /// Say how the running rosrescue is, in ten lines
    Status(StatusArgs),
    /// Show live what goes on: calls a second, slowest callers, nodes, rescues
    Top(TopArgs),
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
