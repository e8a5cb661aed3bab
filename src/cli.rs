//! The command line. Each option of `core` and `proxy` has an environment variable. Of the other commands, only options
//! that say where rosrescue and its checkpoint are or which values to hide have one, and those that `check` shares with
//! `core` and `proxy`. A variable left over from an earlier command must not choose or confirm anything.

pub(crate) mod cluster_args;
pub(crate) mod config_file;
mod files;
mod live;
mod serve;
mod service;
mod tools;
mod when;

use std::{ffi::OsString, fmt::Display};

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand, error::ErrorKind};

pub use self::{
    cluster_args::{ClusterArg, ClusterArgs, ClusterSync, WhenCutOff},
    config_file::OptionValue,
    files::{
        CheckpointArgs, DiffArgs, HistoryArgs, InspectArgs, LogArgs, ParamsArgs, ReadArgs,
        ReportArgs, RestoreArgs, VerifyArgs,
    },
    live::{For, HandoverArgs, TopArgs, WaitArgs},
    serve::{
        CommonArgs, CoreArgs, LogFormat, LoggingArgs, ProxyArgs, Reads, ReapNodes, RestoreChoice,
        SyncPolicy, Writes,
    },
    service::{CompletionsArgs, InstallArgs, ManArgs, ScopeArgs, UninstallArgs},
    tools::{CheckArgs, DrillArgs, HideArgs, OutputArgs, StatusArgs, TargetArgs, Tool, Victim},
    when::When,
};

/// Keeps a ROS 1 robot running when its master dies.
///
/// Nodes call rosrescue as their master. It forwards their calls to the real rosmaster and records every
/// change. When the master dies, rosrescue answers in its place and restores a new one.
/// Without a command it runs `rosrescue core`.
#[derive(Debug, Parser)]
#[command(name = "rosrescue", version = env!("ROSRESCUE_VERSION"), max_term_width = 100)]
#[command(args_conflicts_with_subcommands = true, disable_help_subcommand = true)]
pub struct Cli {
    /// What to run; `core` if it is left out.
    #[command(subcommand)]
    pub command: Option<Command>,
    /// The options of `core`, for `rosrescue` without a command.
    #[command(flatten)]
    pub core: CoreArgs,
}

impl Cli {
    /// Reads the command line, the environment and the configuration file. Returns also the words of the command line
    /// with the options of the file, for a worker, which does not read the file again: an edit must not keep it from
    /// starting.
    ///
    /// # Errors
    ///
    /// If something is wrong, or if help or version must be printed.
    pub fn read(is_worker: bool) -> Result<(Self, Vec<OsString>), clap::Error> {
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
            // The variables of the options of `core` must not count as options given before another command.
            command = command.mut_args(|option| option.env(None::<&str>));
        }
        let file = match is_worker {
            true => config_file::FromFile::default(),
            false => config_file::insert(&command, &mut words).map_err(Self::usage_error)?,
        };
        let matches = command.clone().try_get_matches_from(&words)?;
        let mut cli = Self::from_arg_matches(&matches)?;
        if let Some(Command::Tool(Tool::Check(args))) = &mut cli.command
            && let Some((_, checked)) = matches.subcommand()
        {
            args.settings =
                config_file::settings(&command, checked, &file).map_err(Self::usage_error)?;
        }
        Ok((cli, words))
    }

    /// A usage error with this text, like those of clap. The exit status is 2.
    pub(crate) fn usage_error(why: impl Display) -> clap::Error {
        Self::command().error(ErrorKind::ValueValidation, why)
    }
}

/// The command to run.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Replace roscore: start rosmaster and rosout, watch them, and restore them when they die
    Core(Box<CoreArgs>),
    /// Protect a master that something else starts
    Proxy(ProxyArgs),
    /// A command that does not serve nodes.
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
    fn only_options_that_every_command_takes_alike_have_environment_variables() {
        let cli = Cli::command();
        for command in std::iter::once(&cli).chain(cli.get_subcommands()) {
            for option in command.get_arguments().filter(|a| {
                !a.is_positional() && !["help", "version"].contains(&a.get_id().as_str())
            }) {
                let (command, name) = (command.get_name(), option.get_id().as_str());
                assert!(option.get_help().is_some(), "{name} has no help");
                let serves = ["rosrescue", "core", "proxy"].contains(&command);
                let is_shared = ["uri", "checkpoint", "hide_values"].contains(&name)
                    || command == "check" && option.get_action().takes_values();
                let variable = option.get_env().map(|name| name.to_string_lossy());
                match variable {
                    Some(variable) => {
                        assert!(serves || is_shared, "{command} --{name} has {variable}");
                        assert!(variable.starts_with("ROSRESCUE_"), "{name}");
                    }
                    None => assert!(!serves, "{name} has no variable"),
                }
            }
        }
    }

    /// A person who asks for help wants to read it.
    #[test]
    fn the_help_of_core_is_short_and_plain() {
        let cli = Cli::command();
        let core = cli.find_subcommand("core").expect("core");
        let shown: Vec<_> = core
            .get_arguments()
            .filter(|option| !option.is_hide_set())
            .collect();
        assert!(shown.len() <= 30, "{} options", shown.len());
        let first = shown
            .iter()
            .filter(|option| option.get_help_heading().is_none());
        assert!((10..=16).contains(&first.count()));
        for command in cli.get_subcommands() {
            let name = command.get_name();
            for option in command.get_arguments() {
                let help = option
                    .get_help()
                    .map(ToString::to_string)
                    .unwrap_or_default();
                for sentence in help.split([';', '[']).flat_map(|part| part.split(". ")) {
                    let count = sentence.split_whitespace().count();
                    assert!(count <= 25, "{name}: {count} words: {sentence}");
                }
            }
        }
    }

    /// `ROSRESCUE_CHECKPOINT` counts as given, too.
    #[test]
    fn a_report_of_another_computer_is_shown_whatever_the_checkpoint_here() {
        let words = "rosrescue report --uri http://other:11311 --checkpoint /here.yaml";
        Cli::try_parse_from(words.split(' ')).unwrap();
    }

    #[test]
    fn bare_rosrescue_is_core() {
        let cli = Cli::parse_from(["rosrescue", "-p", "12000"]);
        assert!(cli.command.is_none());
        assert_eq!(cli.core.port, Some(12_000));
    }
}
