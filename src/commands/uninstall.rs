//! `rosrescue uninstall`: takes back what `rosrescue install` has done.

use super::{
    Exit, Failure,
    install::{carry_out, facts, place, plan},
    print,
};
use crate::cli::UninstallArgs;

pub(super) async fn run(args: &UninstallArgs) -> Result<Exit, Failure> {
    let place = place(&args.scope)?;
    let Some(earlier) = facts::earlier(&place)? else {
        let mut plan = plan::Plan::default();
        let path = place.manifest.display();
        plan.notes.push(format!(
            "nothing is installed here by `rosrescue install` ({path} is missing)"
        ));
        print(&plan, &args.scope.output)?;
        return Ok(Exit::Good);
    };
    let present = facts::present(earlier.files());
    let plan = plan::uninstall(&place, &earlier, &present, facts::systemd_runs(&place));
    if args.scope.dry_run {
        print(&plan, &args.scope.output)?;
        return Ok(Exit::Good);
    }
    let exit = carry_out(&plan, &place, &args.scope, false)?;
    // A changed file of ours is left.
    Ok(if plan.notes.is_empty() {
        exit
    } else {
        Exit::Bad
    })
}
