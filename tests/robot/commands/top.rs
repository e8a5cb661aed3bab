//! `rosrescue top`: a live picture on a terminal, and plain text elsewhere.

use std::process::Command;
use std::time::{Duration, Instant};

use crate::support::{
    Mode, NODES, Process, Robot, Tool, behind, command, eventually, free_port, params, stop, within,
};

/// The output of `rosrescue top` on a terminal of `size` after `key` or a signal's number: the last line of the
/// script's verdict, and the pictures.
fn on_terminal(robot: &Robot, key: &str, size: &str) -> (String, Vec<String>) {
    let mut python = Command::new("/usr/bin/python3");
    python
        .arg(format!("{NODES}/terminal.py"))
        .args(["2.5", key, size]);
    let mut command = behind(python, &command(&robot.scratch, robot.port(), &["top"]));
    let output = command.output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    let (verdict, shown) = text.split_once('\n').unwrap();
    assert!(shown.starts_with("\u{1b}[?1049h\u{1b}[?25l"), "{text:?}");
    assert!(
        shown.trim_end().ends_with("\u{1b}[?25h\u{1b}[?1049l"),
        "{text:?}"
    );
    let pictures = shown.split("\u{1b}[H").skip(1);
    (verdict.to_owned(), pictures.map(str::to_owned).collect())
}

#[test]
fn it_is_live_on_a_terminal_and_leaves_it_as_it_was() {
    let robot = Robot::start(Mode::Core);
    robot.client().call("getPid", params!["/caller"]).unwrap();
    let start = Instant::now();
    let (verdict, pictures) = on_terminal(&robot, "q", "80x24");
    // The key may be typed late.
    let most = 1 + usize::try_from(start.elapsed().as_secs()).unwrap();
    assert_eq!(verdict, "0 True");
    assert!(
        (2..=most).contains(&pictures.len()),
        "once a second: {pictures:?}"
    );
    for picture in &pictures {
        let lines: Vec<_> = picture.lines().collect();
        assert!(lines.len() <= 24, "{picture}");
        let width = |line: &str| line.split('\u{1b}').next().unwrap().chars().count();
        assert!(lines.iter().all(|line| width(line) <= 80), "{picture}");
        assert!(
            picture.contains("protected, for ") && picture.contains("/caller"),
            "{picture}"
        );
    }
    for end in ["2", "15", "1"] {
        let (verdict, _) = on_terminal(&robot, end, "80x24");
        assert_eq!(verdict, "0 True", "after signal {end}");
    }
}

#[test]
fn it_follows_the_size_of_the_terminal() {
    let robot = Robot::start(Mode::Core);
    let (verdict, pictures) = on_terminal(&robot, "resize", "120x40");
    assert_eq!(verdict, "0 True");
    let last = pictures.last().unwrap();
    let lines: Vec<_> = last.lines().collect();
    assert!(lines.len() <= 10, "{last}");
    let width = |line: &str| line.split('\u{1b}').next().unwrap().chars().count();
    assert!(lines.iter().all(|line| width(line) <= 40), "{last}");
}

#[test]
fn without_a_terminal_it_prints_blocks_or_json_lines() {
    let mut robot = Robot::start(Mode::Core);
    robot.crash_master();
    let client = robot.client();
    let text = Tool::rosrescue(&robot.scratch, robot.port(), &["top", "--count", "2"]);
    assert_eq!(text.exit(), 0, "{text:?}");
    assert_eq!(text.stdout.matches("rosrescue top ").count(), 2, "{text:?}");
    assert!(text.stdout.contains("rescues so far: 1\n"), "{text:?}");
    for _ in 0..100 {
        client.call("getPid", params!["/busy"]).unwrap();
    }
    let json = Tool::rosrescue(
        &robot.scratch,
        robot.port(),
        &["top", "--count", "2", "--json"],
    );
    let lines: Vec<serde_json::Value> = json
        .stdout
        .lines()
        .map(|line| serde_json::from_str(line).expect("JSON"))
        .collect();
    assert_eq!(lines.len(), 2, "{json:?}");
    let busy = lines[1]["callers"].as_array().unwrap().iter();
    let mut busy = busy.filter(|row| row["caller"] == "/busy");
    assert!(
        busy.next().unwrap()["calls"].as_u64() >= Some(100),
        "{json:?}"
    );
    assert_eq!(lines[1]["condition"]["name"], "protected");
}

#[test]
fn it_waits_for_a_rosrescue_that_goes_away() {
    let mut robot = Robot::start(Mode::Proxy);
    let port = robot.port();
    let mut top = Process::start(
        "top",
        &mut command(&robot.scratch, port, &["top", "--json"]),
    );
    eventually("a first line", || !top.stdout().is_empty());
    robot.rescue.kill();
    top.wait_line("that no rosrescue answers", |line| {
        line.contains("no rosrescue at ")
    });
    let before = top.stdout().len();
    robot.rescue.start_again();
    eventually("it goes on", || top.stdout().len() > before);
    // The next look begins at once, and takes 5 s.
    stop(robot.rescue.pid());
    top.wait_line("that rosrescue does not answer", |line| {
        line.contains("no rosrescue answers at ")
    });
    let ended = within(Duration::from_secs(3), "the end", || top.terminate());
    assert_eq!(ended.code(), Some(0));
    let nobody = Tool::rosrescue(&robot.scratch, free_port(), &["top"]);
    assert_eq!(nobody.exit(), 3, "{nobody:?}");
}
