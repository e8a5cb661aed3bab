//! `rosrescue report`: prints the report of a rescue, from the files beside the checkpoint or from a running rosrescue.

use super::{CommandFailure, Exit, files, print, running::Running};
use crate::{
    cli::{ReportArgs, TargetArgs},
    recovery::report_file,
};

pub(super) async fn run(args: &ReportArgs) -> Result<Exit, CommandFailure> {
    let (place, mut reports) = match &args.uri {
        Some(_) => {
            let target = TargetArgs {
                uri: args.uri.clone(),
            };
            let running = Running::find(&target)?;
            let place = format!("at {}", running.address);
            (place, running.status().await?.last_rescues)
        }
        None => {
            let present = files::present(&args.checkpoint).await;
            files::require_access(&present)?;
            let kept = report_file::read(&present).into_iter();
            let reports: Vec<_> = kept.map(|kept| kept.report).collect();
            (format!("beside {}", present.display()), reports)
        }
    };
    let found = match args.number {
        Some(number) => reports.iter().position(|report| report.number == number),
        None => reports.len().checked_sub(1),
    };
    let Some(found) = found else {
        let numbers: Vec<_> = reports
            .iter()
            .map(|report| report.number.to_string())
            .collect();
        return Err(CommandFailure::Failed(match numbers.as_slice() {
            [] => format!("there is no report {place}"),
            all => format!(
                "there is no report of that rescue; there are {}",
                all.join(", ")
            ),
        }));
    };
    print(&reports.swap_remove(found), &args.output)?;
    Ok(Exit::Good)
}
