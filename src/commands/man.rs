//! `rosrescue man`: manual pages, made of the command line's own definition.

use std::fs;

use clap::CommandFactory;

use super::{Exit, Failure, print_line};
use crate::cli::{Cli, ManArgs};

pub(super) async fn run(args: &ManArgs) -> Result<Exit, Failure> {
    let mut command = Cli::command();
    // Names the commands' pages `rosrescue-core`, …
    command.build();
    match &args.folder {
        None => {
            let mut page = Vec::new();
            let written = clap_mangen::Man::new(command).render(&mut page);
            written.map_err(|error| Failure::Failed(format!("no page: {error}")))?;
            print_line(String::from_utf8_lossy(&page).trim_end())?;
        }
        Some(folder) => {
            let written =
                fs::create_dir_all(folder).and_then(|()| clap_mangen::generate_to(command, folder));
            written.map_err(|error| Failure::Failed(format!("{}: {error}", folder.display())))?;
        }
    }
    Ok(Exit::Good)
}
