//! The reports of rescues as files beside the checkpoint, for questions next week.

use std::{
    fs::{self, OpenOptions},
    io::{self, Write},
    os::unix::fs::OpenOptionsExt,
    path::{Path, PathBuf},
    time::Instant,
};

use crate::{clock, limit::Limit, status::report::Report};

/// Reports that are kept.
const KEPT: usize = 20;
/// A master that dies every few seconds must not wear out a memory card.
static LIMIT: Limit = Limit::new();

/// Writes `report` beside the checkpoint at `checkpoint`, in another thread. It is not synced.
pub(super) fn keep(checkpoint: PathBuf, report: Report) {
    if LIMIT.pass(Instant::now()).is_none() {
        return;
    }
    tokio::task::spawn_blocking(move || {
        if let Err(error) = write(&checkpoint, &report) {
            tracing::debug!(%error, "the report of this rescue is not kept");
        }
    });
}

fn write(checkpoint: &Path, report: &Report) -> io::Result<()> {
    let (Some(folder), Some(name)) = (checkpoint.parent(), checkpoint.file_name()) else {
        return Ok(());
    };
    let prefix = format!("{}.report-", name.to_string_lossy());
    let at = clock::wall_text(report.detected_at).replace(':', "-");
    let path = folder.join(format!("{prefix}{at}-{}.txt", report.number));
    let mut file = OpenOptions::new()
        .write(true)
        .create_new(true)
        .mode(0o600)
        .open(&path)?;
    write!(file, "rosrescue {}\n{report}", env!("CARGO_PKG_VERSION"))?;
    let mut kept = Vec::new();
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let name = entry.file_name();
        let other = name.to_string_lossy();
        // Not this one: a clock that was set back makes it the oldest.
        if other.starts_with(&prefix) && other.ends_with(".txt") && entry.path() != path {
            kept.push(entry.path());
        }
    }
    kept.sort();
    let surplus = (kept.len() + 1).saturating_sub(KEPT);
    kept.iter().take(surplus).try_for_each(fs::remove_file)
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;
    use crate::status::report::{Outcome, Phases};

    fn report(number: u64) -> Report {
        Report {
            number,
            cause: "the master's process ended".to_owned(),
            ended: Some("signal 9".to_owned()),
            detected_at: 1_795_253_213.0 + number as f64,
            outcome: Outcome::Injected,
            master_pid: 7,
            phases: Phases::default(),
            answered: 3,
            unanswered: 0,
            health_check_ms: None,
            restored: Default::default(),
            not_restored: Vec::new(),
            mismatches: Vec::new(),
            removed: vec!["/dead".to_owned()],
            reconciled: Vec::new(),
            unreachable: Vec::new(),
            told_again: Vec::new(),
        }
    }

    #[test]
    fn the_last_20_are_kept_and_a_clock_that_was_set_back_costs_none() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoint = folder.path().join("chkpt.yaml");
        fs::write(&checkpoint, "").unwrap();
        for number in 1..=25 {
            write(&checkpoint, &report(number)).unwrap();
        }
        let mut early = report(26);
        early.detected_at = 0.0;
        write(&checkpoint, &early).unwrap();
        let mut names: Vec<_> = fs::read_dir(folder.path())
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        assert_eq!(names.len(), KEPT + 1, "{names:?}");
        assert_eq!(names[1], "chkpt.yaml.report-1970-01-01T00-00-00Z-26.txt");
        assert!(names.contains(&"chkpt.yaml.report-2026-11-21T09-27-18Z-25.txt".to_owned()));
        let path = folder.path().join(&names[1]);
        let text = fs::read_to_string(&path).unwrap();
        assert!(
            text.contains("signal 9") && text.contains("/dead"),
            "{text}"
        );
        assert_eq!(
            fs::metadata(path).unwrap().permissions().mode() & 0o777,
            0o600
        );
    }
}
