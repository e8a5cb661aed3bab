//! Options of the commands that watch a running rosrescue.

use std::{fmt, str::FromStr};

use clap::Args;

use super::{OutputArgs, TargetArgs, cluster_args::name};

/// Options of `rosrescue top`.
#[derive(Args, Clone, Debug)]
pub struct TopArgs {
    /// The running rosrescue.
    #[command(flatten)]
    pub target: TargetArgs,
    /// Stop after this many updates, one per second [default: until q, Ctrl-C or a signal]
    #[arg(long, value_name = "COUNT")]
    #[arg(value_parser = clap::value_parser!(u64).range(1..))]
    pub count: Option<u64>,
    /// Print one JSON object per line, once a second
    #[arg(long)]
    pub json: bool,
}

/// Options of `rosrescue handover`.
#[derive(Args, Clone, Debug)]
pub struct HandoverArgs {
    /// The running rosrescue, on any of the computers of the robot.
    #[command(flatten)]
    pub target: TargetArgs,
    /// Computer that should lead: its whole name, its host name, or its IPv4 address [default: any follower]
    #[arg(long, value_name = "NAME", value_parser = name)]
    pub to: Option<String>,
    /// Longest time to wait for the new leader, in seconds
    #[arg(long, value_name = "SECONDS", default_value = "30", value_parser = seconds)]
    pub timeout: f64,
    /// How to print the result.
    #[command(flatten)]
    pub output: OutputArgs,
}

/// Options of `rosrescue wait`.
#[derive(Args, Clone, Debug)]
pub struct WaitArgs {
    /// The running rosrescue.
    #[command(flatten)]
    pub target: TargetArgs,
    /// What to wait for: `answered`, `master`, `protected`, or the /NAME of a node. `answered`: rosrescue answers
    /// calls. `master`: a master answers calls. `protected`: rosrescue also records every change. Several
    /// conditions must all be met
    #[arg(long = "for", value_name = "WHAT")]
    #[arg(value_delimiter = ',', num_args = 1.., default_value = "answered")]
    pub wanted: Vec<For>,
    /// Longest time to wait, in seconds; 0 for no limit
    #[arg(long, value_name = "SECONDS", default_value = "60", value_parser = seconds)]
    pub timeout: f64,
    /// How to print the result.
    #[command(flatten)]
    pub output: OutputArgs,
}

fn seconds(text: &str) -> Result<f64, String> {
    let seconds = text.parse::<f64>().ok();
    let seconds = seconds.filter(|seconds| (0.0..=1e9).contains(seconds));
    seconds.ok_or_else(|| format!("\"{text}\" is not a number of seconds, such as 30 or 0.5"))
}

/// What `rosrescue wait` waits for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum For {
    /// rosrescue answers calls.
    Answered,
    /// Calls pass to a master.
    Master,
    /// Calls pass to a master, and changes are recorded.
    Protected,
    /// The node with this name is registered.
    Node(String),
}

impl FromStr for For {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "answered" => Ok(Self::Answered),
            "master" => Ok(Self::Master),
            "protected" => Ok(Self::Protected),
            name if name.starts_with('/') && name.len() > 1 => Ok(Self::Node(name.to_owned())),
            _ => Err(
                "write answered, master, protected, or the full name of a node, such as /talker"
                    .to_owned(),
            ),
        }
    }
}

impl fmt::Display for For {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Answered => f.write_str("answers to calls"),
            Self::Master => f.write_str("a master"),
            Self::Protected => f.write_str("protection"),
            Self::Node(name) => write!(f, "the node {name}"),
        }
    }
}
