//! `rosrescue man`: prints manual pages made from the definition of the command line.

use std::fs;

use clap::CommandFactory;

use super::{CommandFailure, Exit, print_line};
use crate::{
    cli::{Cli, ManArgs},
    printable::Printable,
};

pub(super) async fn run(args: &ManArgs) -> Result<Exit, CommandFailure> {
    let mut command = Cli::command();
    // Gives the pages names such as `rosrescue-core`.
    command.build();
    match &args.folder {
        None => {
            let shown = match &args.command {
                None => command,
                Some(name) => {
                    let found = command.find_subcommand(name).cloned();
                    found.ok_or_else(|| {
                        CommandFailure::Usage(format!(
                            "there is no command `{name}`; to write all pages, use --folder {name}"
                        ))
                    })?
                }
            };
            let mut page = Vec::new();
            let written = clap_mangen::Man::new(shown).render(&mut page);
            written.map_err(|error| CommandFailure::Failed(format!("no page: {error}")))?;
            print_line(&Printable::trusted(
                String::from_utf8_lossy(&page).into_owned(),
            ))?;
        }
        Some(folder) => {
            let written =
                fs::create_dir_all(folder).and_then(|()| clap_mangen::generate_to(command, folder));
            written.map_err(|error| {
                CommandFailure::Failed(format!("{}: {error}", folder.display()))
            })?;
        }
    }
    Ok(Exit::Good)
}
