//! Stores the reports of rescues as files next to the checkpoint, for operators and for the next process of the
//! session.

use std::{
    fs::{self, OpenOptions},
    io::{self, Read, Write},
    os::unix::fs::OpenOptionsExt,
    path::{Path, PathBuf},
    time::Instant,
};

use checkpoint_store::regular_file;
use serde::{Deserialize, Serialize};

use crate::{
    clock,
    limit::Limit,
    status::{Board, Earlier, report::Report},
};

/// Number of reports that are kept.
const KEPT: usize = 20;
/// Largest file that is read, in bytes.
const LARGEST: u64 = 16 << 20;
/// Limits the reports of a master that dies every few seconds: memory cards wear out.
static LIMIT: Limit = Limit::new();

/// The last line of a report's file, as JSON. The lines before it are the report for people.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct ReportRecord {
    /// Id of the session.
    session: String,
    /// Totals of the session when the report was made, as in [`Facts`](crate::status::Facts).
    rescues: u64,
    deaths: u64,
    worker_restarts: u64,
    pub(crate) report: Report,
}

impl ReportRecord {
    pub(super) fn new(board: &Board, session: &str, report: Report) -> Self {
        let facts = board.read();
        Self {
            session: session.to_owned(),
            rescues: facts.rescues,
            deaths: facts.deaths,
            worker_restarts: facts.earlier.worker_restarts,
            report,
        }
    }
}

/// Writes a report next to the checkpoint at `checkpoint`, in another thread. The file is not
/// synced.
pub(super) fn save(checkpoint: PathBuf, kept: ReportRecord) {
    if LIMIT.pass(Instant::now()).is_none() {
        return;
    }
    crate::task::spawn_blocking(move || {
        if let Err(error) = write(&checkpoint, &kept) {
            tracing::debug!(%error, "could not keep the report of this rescue");
        }
    });
}

fn write(checkpoint: &Path, kept: &ReportRecord) -> io::Result<()> {
    let (Some(folder), Some(prefix)) = (checkpoint.parent(), prefix(checkpoint)) else {
        return Ok(());
    };
    let checkpoint_name = checkpoint.file_name().unwrap_or_default();
    let report = &kept.report;
    let at = clock::wall_text(report.detected_at).replace(':', "-");
    let path = folder.join(format!("{prefix}{at}-{}.txt", report.number));
    // The file gets its name when it is whole: a report cut off by a death of rosrescue would count as no rescue.
    let fresh = folder.join(format!("{}.report.new", checkpoint_name.to_string_lossy()));
    let _ = fs::remove_file(&fresh);
    let mut file = OpenOptions::new()
        .write(true)
        .create_new(true)
        .mode(0o600)
        .open(&fresh)?;
    let json = serde_json::to_string(kept)?;
    write!(
        file,
        "rosrescue {}\n{report}{json}\n",
        env!("CARGO_PKG_VERSION")
    )?;
    fs::rename(&fresh, &path)?;
    let mut others = files(checkpoint)?;
    // The new report always stays. Its number is low if the earlier reports could not be read at the start.
    others.retain(|other| *other != path);
    let surplus = (others.len() + 1).saturating_sub(KEPT);
    others.iter().take(surplus).try_for_each(fs::remove_file)
}

/// The prefix of the names of report files.
fn prefix(checkpoint: &Path) -> Option<String> {
    Some(format!(
        "{}.report-",
        checkpoint.file_name()?.to_string_lossy()
    ))
}

/// The report files, sorted by the numbers in their names. The dates depend on the clock.
fn files(checkpoint: &Path) -> io::Result<Vec<PathBuf>> {
    let (Some(folder), Some(prefix)) = (checkpoint.parent(), prefix(checkpoint)) else {
        return Ok(Vec::new());
    };
    let mut files = Vec::new();
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let name = entry.file_name();
        let name = name.to_string_lossy();
        if name.starts_with(&prefix) && name.ends_with(".txt") {
            files.push(entry.path());
        }
    }
    files.sort_by_key(|file| {
        let name = file.file_stem().unwrap_or_default().to_string_lossy();
        let number = name.rsplit('-').next();
        number
            .and_then(|number| number.parse().ok())
            .unwrap_or(0u64)
    });
    Ok(files)
}

/// Reads the reports next to the checkpoint at `checkpoint`, sorted by number. Leaves out files that cannot be read or
/// have no JSON in the last line.
pub(crate) fn read(checkpoint: &Path) -> Vec<ReportRecord> {
    let files = files(checkpoint).unwrap_or_default();
    let mut all: Vec<ReportRecord> = files.iter().filter_map(|file| read_one(file)).collect();
    all.sort_by_key(|kept| kept.report.number);
    all
}

fn read_one(file: &Path) -> Option<ReportRecord> {
    let file = regular_file::open_ours(file).ok()?;
    if file.metadata().ok()?.len() > LARGEST {
        return None;
    }
    let text = io::read_to_string(file.take(LARGEST)).ok()?;
    serde_json::from_str(text.lines().next_back()?).ok()
}

/// The facts about the session with this id in the files next to the checkpoint at `checkpoint`. `died` says whether
/// its last process crashed. `states` is the highest rescue number among the checkpoints that are kept there.
pub(crate) fn earlier(checkpoint: &Path, session: &str, died: bool, states: u64) -> Earlier {
    let all = read(checkpoint);
    let last = all.last().map_or(0, |kept| kept.report.number);
    let mut earlier = Earlier {
        worker_restarts: u64::from(died),
        died,
        last_number: last.max(states),
        ..Earlier::default()
    };
    for kept in all.into_iter().filter(|kept| kept.session == session) {
        let ReportRecord {
            rescues,
            deaths,
            worker_restarts,
            report,
            ..
        } = kept;
        // In a crash loop not every rescue has a report. The total in the next report also counts rescues without a
        // report.
        earlier.rescues = earlier.rescues.max(rescues);
        earlier.deaths = earlier.deaths.max(deaths);
        let restarts = worker_restarts + u64::from(died);
        earlier.worker_restarts = earlier.worker_restarts.max(restarts);
        earlier.reports.push(report);
    }
    earlier
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;
    use crate::status::report::{Phases, RecoveryOutcome};

    fn record(session: &str, number: u64) -> ReportRecord {
        ReportRecord {
            session: session.to_owned(),
            rescues: number,
            deaths: number + 1,
            worker_restarts: 2,
            report: report(number),
        }
    }

    fn report(number: u64) -> Report {
        Report {
            number,
            cause: "the master's process ended".to_owned(),
            ended: Some("signal 9".to_owned()),
            detected_at: 1_795_253_213.0 + number as f64,
            outcome: RecoveryOutcome::Injected,
            same_master: false,
            master_pid: 7,
            master_speaks: "HTTP/1.1".to_owned(),
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
        // An earlier process died while it wrote a report.
        fs::write(folder.path().join("chkpt.yaml.report.new"), "rosre").unwrap();
        for number in 1..=25 {
            write(&checkpoint, &record("a", number)).unwrap();
        }
        for number in [26, 27] {
            let mut early = record("a", number);
            early.report.detected_at = 0.0;
            write(&checkpoint, &early).unwrap();
        }
        let mut names: Vec<_> = fs::read_dir(folder.path())
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        assert_eq!(names.len(), KEPT + 1, "{names:?}");
        assert_eq!(names[1], "chkpt.yaml.report-1970-01-01T00-00-00Z-26.txt");
        assert_eq!(names[2], "chkpt.yaml.report-1970-01-01T00-00-00Z-27.txt");
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

    #[test]
    fn the_next_process_goes_on_with_the_reports_of_its_session() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoint = folder.path().join("chkpt.yaml");
        let nothing = earlier(&checkpoint, "b", false, 0);
        assert_eq!((nothing.last_number, nothing.worker_restarts), (0, 0));
        for (session, number) in [("a", 1), ("b", 2), ("b", 3)] {
            write(&checkpoint, &record(session, number)).unwrap();
        }
        // A report of an older version, and a damaged one.
        let other = |name: &str| folder.path().join(format!("chkpt.yaml.report-{name}.txt"));
        fs::write(other("2026-11-21T09-27-18Z-1"), "rosrescue 0.8.0\ntext\n").unwrap();
        fs::write(other("x"), [0xff]).unwrap();
        let found = earlier(&checkpoint, "b", true, 7);
        let numbers: Vec<_> = found.reports.iter().map(|report| report.number).collect();
        assert_eq!(numbers, [2, 3]);
        assert_eq!(
            (found.rescues, found.deaths, found.worker_restarts),
            (3, 4, 3)
        );
        assert_eq!((found.last_number, found.died), (7, true));
        assert_eq!(earlier(&checkpoint, "c", false, 0).last_number, 3);
    }
}
