//! The log: priorities for journald, rate limits, and reports as files.

use std::fs::{self, File};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::time::{Duration, Instant};

use crate::support::{
    Forkserver, Mode, Rescue, Robot, Rosmaster, Scratch, Setup, behind, eventually, free_port,
    request, status,
};

/// Standard error is a file in this test. rosrescue recognises it by device and inode, as it does a socket of journald.
#[test]
fn log_lines_have_priorities_only_for_journald() {
    let scratch = Scratch::new();
    let mut master = Rosmaster::start(&scratch);
    let path = scratch.path("journal");
    let file = File::create(&path).unwrap().metadata().unwrap();
    let stream = format!("{}:{}", file.dev(), file.ino());
    for (stream, is_journald) in [(stream, true), ("1:2".to_owned(), false)] {
        let checkpoint = scratch.path(format!("{is_journald}")).join("checkpoint");
        let rescue = Setup::proxy(&scratch, master.client().port())
            .at_checkpoint(checkpoint)
            .env("JOURNAL_STREAM", stream)
            .env("JOURNAL", &path)
            .wrapped(|own| {
                let mut shell = std::process::Command::new("sh");
                shell.args(["-c", r#"exec "$0" "$@" 2>>"$JOURNAL""#]);
                behind(shell, own)
            });
        let mut rescue = rescue.start();
        if is_journald {
            let port = master.client().port();
            master.kill();
            let has = |start: &str, words: &str| {
                let journal = fs::read_to_string(&path).unwrap();
                let found = |line: &str| line.starts_with(start) && line.contains(words);
                journal.lines().any(found)
            };
            eventually("a warning", || has("<4>", "the master is away"));
            assert!(has("<6>", "calls pass to the master"));
            let journal = fs::read_to_string(&path).unwrap();
            assert!(
                journal.lines().all(|line| line.starts_with('<')),
                "{journal}"
            );
            master = Rosmaster::start_at(&scratch, port);
        }
        rescue.terminate();
        let journal = fs::read_to_string(&path).unwrap();
        assert_eq!(journal.contains('<'), is_journald, "{journal}");
        File::create(&path).unwrap();
    }
}

#[test]
fn repeated_log_lines_are_limited_to_ten() {
    let robot = Robot::start_with(Mode::Core, &[]);
    let client = robot.client();
    let foreign = request("POST / HTTP/1.1", &["Origin: http://elsewhere"], b"x");
    for _ in 0..200 {
        client.exchange(&foreign).unwrap();
    }
    assert_eq!(robot.counter("requests_refused"), 200);
    let said = || {
        let log = robot.rescue.stderr().into_iter();
        log.filter(|line| line.contains("refused a request"))
            .count()
    };
    // Another thread writes the lines.
    eventually("the log says it", || said() >= 10);
    assert_eq!(said(), 10, "{}", robot.rescue.log());
}

/// Enough deaths for the limit of log lines. In a crash loop a core waits 10 s before each further start.
const DEATHS: usize = 11;

#[test]
fn after_many_deaths_of_its_master_a_cores_last_lines_say_that_it_is_back() {
    let mut robot = Robot::start(Mode::Core);
    let mut deaths = Vec::new();
    for _ in 0..DEATHS {
        deaths.push(Instant::now());
        robot.crash_master();
    }
    // Six deaths within a minute are a crash loop. Masters may start too slowly for that.
    let in_loop = deaths
        .windows(6)
        .any(|deaths| deaths[5] - deaths[0] < Duration::from_secs(50));
    assert_last_lines_are_good(&robot.rescue, Mode::Core, in_loop);
}

#[test]
fn after_many_deaths_of_its_master_a_proxys_last_lines_say_that_it_is_back() {
    let scratch = Scratch::new();
    let port = free_port();
    let mut masters = Forkserver::new(&scratch);
    let mut master = masters.start(port, "");
    let rescue = Setup::proxy(&scratch, port).start();
    for _ in 0..DEATHS {
        masters.kill(master);
        master = masters.start(port, "");
        eventually("calls pass to the new master", || {
            let status = status(&rescue.client());
            status["open"] == true && status["master_pid"] == master
        });
    }
    assert_last_lines_are_good(&rescue, Mode::Proxy, true);
}

/// Asserts that the log ends with the good news, and that not every death is in it. `in_loop` says that the deaths were a
/// crash loop.
#[track_caller]
fn assert_last_lines_are_good(rescue: &Rescue, mode: Mode, in_loop: bool) {
    eventually("the crash loop is over", || {
        let log = rescue.stderr();
        let has = |words: &str| log.iter().any(|line| line.contains(words));
        let was_noticed = in_loop || has("crash loop: the master");
        !was_noticed || has("the crash loop is over")
    });
    let log = rescue.stderr();
    let is_waiting = [
        "the master is away",
        "waiting for the master",
        "could not read or restore",
    ];
    for (all_clear, alarms) in [
        ("calls pass to the master", &is_waiting[..]),
        (
            "started rosmaster",
            &[
                "rosmaster has ended",
                "the master does not answer; killing it",
            ],
        ),
        ("the crash loop is over", &["crash loop: the master"]),
    ] {
        let lines = log.iter().filter_map(|line| {
            let is_alarm = alarms.iter().any(|alarm| line.contains(alarm));
            (is_alarm || line.contains(all_clear)).then_some(is_alarm)
        });
        let lines: Vec<_> = lines.collect();
        let may_be_missing = !in_loop && all_clear == "the crash loop is over";
        if lines.is_empty() && (mode == Mode::Proxy || may_be_missing) {
            continue;
        }
        assert_eq!(lines.last(), Some(&false), "{all_clear}: {log:#?}");
        let unasked = lines.windows(2).any(|pair| pair == [false, false]);
        assert!(!unasked, "{all_clear} without an alarm: {log:#?}");
        let told = log.iter().filter(|line| line.contains(alarms[0])).count();
        assert!(told < DEATHS, "limited: {told}");
    }
}

#[test]
fn each_rescue_leaves_a_report_beside_the_checkpoint() {
    let mut robot = Robot::start(Mode::Core);
    let reports = |robot: &Robot| {
        let folder = robot.rescue.checkpoint();
        let entries = fs::read_dir(folder.parent().unwrap()).unwrap();
        let paths = entries.map(|entry| entry.unwrap().path());
        let is_report =
            |path: &std::path::PathBuf| path.to_str().unwrap().contains(".yaml.report-");
        let mut reports: Vec<_> = paths.filter(is_report).collect();
        reports.sort();
        reports
    };
    assert!(
        reports(&robot).is_empty(),
        "an ordinary start is not a rescue"
    );
    for count in 1..=2 {
        robot.crash_master();
        eventually("a report is written", || reports(&robot).len() == count);
    }
    let path = reports(&robot).pop().unwrap();
    eventually("it is whole", || {
        let text = fs::read_to_string(&path).unwrap();
        text.contains("signal 9") && text.contains("a new master got the whole state")
    });
    assert_eq!(
        fs::metadata(&path).unwrap().permissions().mode() & 0o777,
        0o600
    );
}
