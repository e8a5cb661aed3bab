//! `rosrescue status`: shows the status of the running rosrescue.

use super::{CommandFailure, Exit, print, running::Running};
use crate::cli::StatusArgs;

pub(super) async fn run(args: &StatusArgs) -> Result<Exit, CommandFailure> {
    let status = Running::find(&args.target)?.status().await?;
    print(&status, &args.output)?;
    Ok(match status.condition.is_good() {
        true => Exit::Good,
        false => Exit::Bad,
    })
}
