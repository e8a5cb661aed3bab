//! `rosrescue completions`: prints a completion script made from the definition of the command line.

use clap::CommandFactory;

use super::{CommandFailure, Exit, print_line};
use crate::{
    cli::{Cli, CompletionsArgs},
    printable::Printable,
};

pub(super) async fn run(args: &CompletionsArgs) -> Result<Exit, CommandFailure> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut Cli::command(), "rosrescue", &mut script);
    print_line(&Printable::trusted(
        String::from_utf8_lossy(&script).into_owned(),
    ))?;
    Ok(Exit::Good)
}
