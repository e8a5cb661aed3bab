//! Options of the commands that put rosrescue into a computer.

use std::path::PathBuf;

use clap::Args;
use clap_complete::Shell;

use super::OutputArgs;

/// Options of `rosrescue install`.
#[derive(Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  sudo rosrescue install                     `core` from the next boot on, and now
  sudo rosrescue install -- core -p 11411    with options of `core`
  sudo rosrescue install -- proxy --master http://127.0.0.1:11312
  rosrescue install --user                   without root, as a service of your own
  rosrescue install --dry-run                what it would do

What was chosen at an earlier installation stays, unless it is said otherwise.")]
pub struct InstallArgs {
    /// Where to.
    #[command(flatten)]
    pub scope: ScopeArgs,
    /// User that runs the service [default: the one who called sudo]
    #[arg(
        long,
        env = "ROSRESCUE_RUN_AS",
        value_name = "USER",
        conflicts_with = "user"
    )]
    pub run_as: Option<String>,
    /// What the service runs: `core` or `proxy` with options [default: core]
    #[arg(last = true, value_name = "COMMAND")]
    pub service: Vec<String>,
}

/// Options of `rosrescue uninstall`.
#[derive(Args, Clone, Debug)]
pub struct UninstallArgs {
    /// Where from.
    #[command(flatten)]
    pub scope: ScopeArgs,
}

/// Which systemd is meant, and whether it is really to be done.
#[derive(Args, Clone, Debug)]
pub struct ScopeArgs {
    /// A service of this user alone, without root
    #[arg(long, conflicts_with = "system")]
    pub user: bool,
    /// A service of this computer; needs root [the default]
    #[arg(long)]
    pub system: bool,
    /// Only show what would be changed
    #[arg(long)]
    pub dry_run: bool,
    /// Do not ask. Needed where there is no terminal to ask at
    #[arg(short, long)]
    pub yes: bool,
    /// In which form.
    #[command(flatten)]
    pub output: OutputArgs,
}

/// Options of `rosrescue completions`.
#[derive(Args, Clone, Debug)]
pub struct CompletionsArgs {
    /// The shell
    pub shell: Shell,
}

/// Options of `rosrescue man`.
#[derive(Args, Clone, Debug)]
pub struct ManArgs {
    /// Write every page into this folder, instead of rosrescue(1) to stdout
    pub folder: Option<PathBuf>,
}
