//! `rosrescue verify`: checks a checkpoint for damage, and shows what can still be used.

use std::fmt;

use ros1_master::master::Counts;
use serde::Serialize;

use super::{CommandFailure, Exit, files, print};
use crate::{
    cli::VerifyArgs,
    printable::{Lines, Page, display_lines, line},
};

pub(super) async fn run(args: &VerifyArgs) -> Result<Exit, CommandFailure> {
    let opened = files::open(&files::find(&args.file, &args.checkpoint).await?)?;
    let verified = Verified {
        file: opened.path.display().to_string(),
        whole: opened.damage.is_empty(),
        exact: opened.exact,
        snapshot: opened.snapshot_seq,
        records: opened.journal.len(),
        usable: opened.state.counts(),
        torn: opened.torn,
        damage: opened.damage,
    };
    print(&verified, &args.output)?;
    Ok(if verified.whole {
        Exit::Good
    } else {
        Exit::Bad
    })
}

#[derive(Serialize)]
struct Verified {
    file: String,
    /// Whether the file is undamaged.
    whole: bool,
    /// Whether everything recorded can be used, if necessary from the previous version of the file, which is kept
    /// beside it.
    exact: bool,
    /// Number of the last record that the usable snapshot includes. `None` if no snapshot is usable.
    snapshot: Option<u64>,
    /// Number of usable records after the snapshot.
    records: usize,
    usable: Counts,
    /// Why the last record is incomplete. `None` if it is complete.
    torn: Option<String>,
    damage: Vec<String>,
}

impl Lines for Verified {
    fn lines(&self, f: &mut Page) -> fmt::Result {
        let verdict = match (self.whole, self.exact) {
            (true, _) => "is whole",
            (false, true) => "is damaged, but nothing is lost",
            (false, false) => "is damaged",
        };
        line!(f, "{} {verdict}", self.file)?;
        for sentence in &self.damage {
            line!(f, "damage   {sentence}")?;
        }
        let source = match (self.snapshot, self.records) {
            (Some(_), records) => format!("the snapshot and {records} records"),
            (None, 0) => "nothing".to_owned(),
            (None, records) => format!("{records} records without a snapshot"),
        };
        line!(f, "usable   {source}: {}", self.usable)?;
        if let Some(torn) = &self.torn {
            line!(
                f,
                "torn     {torn}: normal after a crash or during a write. It contains nothing that was confirmed"
            )?;
        }
        if !self.whole && (self.snapshot, self.records) != (None, 0) {
            line!(
                f,
                "to do    use --damaged with inspect, diff, params or restore to use the readable part"
            )?;
        }
        Ok(())
    }
}

display_lines!(Verified);
