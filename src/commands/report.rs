//! `rosrescue report`: prints the report of a rescue, from the files beside the checkpoint.

use super::{CommandFailure, Exit, files, print};
use crate::{cli::ReportArgs, recovery::report_file};

pub(super) async fn run(args: &ReportArgs) -> Result<Exit, CommandFailure> {
    let present = files::present(&args.place).await;
    let mut reports: Vec<_> = report_file::read(&present)
        .into_iter()
        .map(|kept| kept.report)
        .collect();
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
            [] => format!("there is no report beside {}", present.display()),
            all => format!(
                "there is no report of that rescue; there are {}",
                all.join(", ")
            ),
        }));
    };
    print(&reports.swap_remove(found), &args.output)?;
    Ok(Exit::Good)
}
