//! The command line. Every option has a default and a unit in its help, and an environment variable. Flags of
//! commands that do not serve have none: consent must not be left over from an earlier command.

pub(crate) mod cluster;
mod files;
mod live;
mod serve;
mod service;
mod tools;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};

pub use self::{
    cluster::{ClusterArgs, ClusterSync, Members, WhenCutOff},
    files::{
        CheckpointArgs, DiffArgs, HistoryArgs, InspectArgs, ParamsArgs, ReadArgs, ReportArgs,
        RestoreArgs, VerifyArgs,
    },
    live::{For, HandoverArgs, TopArgs, WaitArgs},
    serve::{CommonArgs, CoreArgs, LogFormat, ProxyArgs, Reads, RestoreChoice, SyncPolicy},
    service::{CompletionsArgs, InstallArgs, ManArgs, ScopeArgs, UninstallArgs},
    tools::{CheckArgs, DrillArgs, HideArgs, OutputArgs, StatusArgs, TargetArgs, Tool, Victim},
};

/// Keeps a ROS 1 robot running when its master dies.
///
/// Nodes point ROS_MASTER_URI at rosrescue; it forwards their calls to the real rosmaster, records
/// what changes, and brings a restarted master back to the same state before it lets calls through.
/// Without a command it is `rosrescue core`.
#[derive(Debug, Parser)]
#[command(name = "rosrescue", version = env!("ROSRESCUE_VERSION"), max_term_width = 100)]
#[command(args_conflicts_with_subcommands = true, disable_help_subcommand = true)]
pub struct Cli {
    /// What to run; `core` if it is left out.
    #[command(subcommand)]
    pub command: Option<Command>,
    /// The options of `core`, for the bare `rosrescue`.
    #[command(flatten)]
    pub core: CoreArgs,
}

impl Cli {
    /// Reads the command line and the environment; ends the process with what is wrong with them.
    pub fn read() -> Self {
        let mut command = Self::command();
        let mut words: Vec<_> = std::env::args_os().collect();
        if words.get(1).is_some_and(|first| first == "help") {
            words.remove(1);
            words.push("--help".into());
        }
        if words
            .get(1)
            .is_some_and(|first| command.find_subcommand(first).is_some())
        {
            // The options of the bare `rosrescue` are not meant, so neither are their variables.
            command = command.mut_args(|option| option.env(None::<&str>));
        }
        let matches = command.get_matches_from(words);
        Self::from_arg_matches(&matches).unwrap_or_else(|error| error.exit())
    }
}

/// What to run.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Stand in for roscore: start, supervise and restore a rosmaster and rosout
    Core(Box<CoreArgs>),
    /// Stand in front of a master that somebody else starts
    Proxy(ProxyArgs),
    /// What does not serve.
    #[command(flatten)]
    Tool(Tool),
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_definition_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn every_option_but_a_flag_of_a_tool_has_an_environment_variable_and_each_a_help_text() {
        let cli = Cli::command();
        for command in std::iter::once(&cli).chain(cli.get_subcommands()) {
            for option in command.get_arguments().filter(|a| {
                !a.is_positional() && !["help", "version"].contains(&a.get_id().as_str())
            }) {
                let name = option.get_id();
                assert!(option.get_help().is_some(), "{name} has no help");
                let serves = ["rosrescue", "core", "proxy"].contains(&command.get_name());
                if !serves && !option.get_action().takes_values() && name != "json" {
                    assert_eq!(option.get_env(), None, "{name}: consent by environment");
                    continue;
                }
                let variable = option
                    .get_env()
                    .unwrap_or_else(|| panic!("{name} has no variable"));
                assert!(
                    variable.to_string_lossy().starts_with("ROSRESCUE_"),
                    "{name}"
                );
            }
        }
    }

    #[test]
    fn bare_rosrescue_is_core() {
        let cli = Cli::parse_from(["rosrescue", "-p", "12000"]);
        assert!(cli.command.is_none());
        assert_eq!(cli.core.port, Some(12_000));
    }
}
