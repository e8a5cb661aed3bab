//! The command that the service runs.

use std::{collections::BTreeMap, ffi::OsString, net::SocketAddr, path::PathBuf};

use clap::{CommandFactory, FromArgMatches};

use super::super::CommandFailure;
use crate::{
    cli::{Cli, Command, config_file},
    config::Config,
    ros_env::MasterUri,
    server::listener,
};

/// A parsed service command.
pub(super) struct Service {
    pub(super) listen: Vec<SocketAddr>,
    /// The address where nodes find the service.
    pub(super) advertised: MasterUri,
    /// By default it is in the home folder, which is `HOME` in the settings.
    pub(super) checkpoint: PathBuf,
    /// Whether the command is `core`, which starts the master itself.
    pub(super) runs_rosmaster: bool,
    /// Whether the service must find rosmaster on the PATH.
    pub(super) searches_rosmaster: bool,
}

/// Parses a service's command. The service gets none of the caller's ROSRESCUE_ variables.
pub(super) fn read_service(
    words: &[String],
    settings: &BTreeMap<String, String>,
) -> Result<Service, CommandFailure> {
    let usage = |why: String| CommandFailure::Usage(format!("`{}`: {why}", words.join(" ")));
    let command = Cli::command()
        .mut_args(|option| option.env(None::<&str>))
        .mut_subcommands(|command| command.mut_args(|option| option.env(None::<&str>)));
    let mut all = vec![OsString::from("rosrescue")];
    all.extend(words.iter().map(OsString::from));
    config_file::insert(&command, &mut all).map_err(usage)?;
    let matches = command.try_get_matches_from(all).map_err(|error| {
        let text = error.to_string();
        let lines = text.lines().take_while(|line| !line.is_empty());
        let said = lines.map(str::trim).collect::<Vec<_>>().join(" ");
        usage(said.trim_start_matches("error: ").to_owned())
    })?;
    let cli = Cli::from_arg_matches(&matches).map_err(|error| usage(error.to_string()))?;
    let env = |name: &str| settings.get(name).cloned();
    let hostname = rustix::system::uname()
        .nodename()
        .to_string_lossy()
        .into_owned();
    let local = listener::local_address();
    let core = match &cli.command {
        Some(Command::Core(args)) => args,
        None => &cli.core,
        Some(Command::Proxy(_)) => &cli.core,
        Some(Command::Tool(_)) => return Err(usage("a service runs `core` or `proxy`".to_owned())),
    };
    let (config, common, rosmaster) = match &cli.command {
        Some(Command::Proxy(args)) => (
            Config::proxy(args, &env, &hostname, local),
            &args.common,
            None,
        ),
        _ => (
            Config::core(core, &env, &hostname, local),
            &core.common,
            Some(&core.rosmaster),
        ),
    };
    let files = [
        common.config.as_ref(),
        common.checkpoint.as_ref(),
        rosmaster.and_then(Option::as_ref),
    ];
    if let Some(file) = files.into_iter().flatten().find(|file| file.is_relative()) {
        let file = file.display();
        return Err(usage(format!(
            "write the full path of {file}: a service starts in /"
        )));
    }
    let config = config.map_err(|error| usage(error.to_string()))?;
    Ok(Service {
        listen: config.listen,
        advertised: config.advertised,
        checkpoint: config.checkpoint,
        runs_rosmaster: rosmaster.is_some(),
        searches_rosmaster: rosmaster.is_some_and(Option::is_none),
    })
}
