//! Options of the commands that set up a computer.

use std::path::PathBuf;

use clap::Args;
use clap_complete::Shell;

use super::OutputArgs;

/// Options of `rosrescue install`.
#[derive(Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  rosrescue install --dry-run                show the changes
  sudo rosrescue install                     run `core`, now and at every boot
  sudo rosrescue install -- core -p 11411    with options of `core`
  sudo rosrescue install -- proxy --master http://127.0.0.1:11312
  rosrescue install --user                   without root, as a service of your own")]
pub struct InstallArgs {
    /// Which systemd to use, and whether to ask.
    #[command(flatten)]
    pub scope: ScopeArgs,
    /// User that runs the service [default: the user who called sudo]
    #[arg(long, value_name = "USER", conflicts_with = "user")]
    pub run_as: Option<String>,
    /// Install although ROS_MASTER_URI does not lead to this service
    #[arg(long)]
    pub other_master: bool,
    /// Command of the service: `core` or `proxy`, with options [default: core]
    #[arg(last = true, value_name = "COMMAND")]
    pub service: Vec<String>,
}

/// Options of `rosrescue uninstall`.
#[derive(Args, Clone, Debug)]
pub struct UninstallArgs {
    /// Which systemd to use, and whether to ask.
    #[command(flatten)]
    pub scope: ScopeArgs,
}

/// Which systemd to use, and whether to make the changes.
#[derive(Args, Clone, Debug)]
pub struct ScopeArgs {
    /// Service of your own, without root
    #[arg(long, conflicts_with = "system")]
    pub user: bool,
    /// Service of this computer, which needs root (default)
    #[arg(long)]
    pub system: bool,
    /// Only show the changes
    #[arg(long)]
    pub dry_run: bool,
    /// Do not ask. Required without a terminal
    #[arg(short, long)]
    pub yes: bool,
    /// How to print the result.
    #[command(flatten)]
    pub output: OutputArgs,
}

/// Options of `rosrescue completions`.
#[derive(Args, Clone, Debug)]
pub struct CompletionsArgs {
    /// Shell
    pub shell: Shell,
}

/// Options of `rosrescue man`.
#[derive(Args, Clone, Debug)]
pub struct ManArgs {
    /// Command whose page is printed [default: rosrescue itself]
    pub command: Option<String>,
    /// Write all pages into this folder instead
    #[arg(long, conflicts_with = "command")]
    pub folder: Option<PathBuf>,
}
