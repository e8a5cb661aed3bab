//! The session's history survives the death of rosrescue.

use serde_json::Value;

use crate::support::{FakeNode, Mode, Robot, Tool, eventually};

#[test]
fn rescues_before_a_death_of_rosrescue_are_still_reported() {
    let mut robot = Robot::start_with(Mode::Proxy, &["--node-timeout", "300"]);
    let reports = |robot: &Robot| {
        let folder = robot.rescue.checkpoint().parent().unwrap().to_owned();
        let entries = std::fs::read_dir(folder).unwrap().flatten();
        let names = entries.map(|entry| entry.file_name().to_string_lossy().into_owned());
        names.filter(|name| name.contains(".report-")).count()
    };
    let dead = FakeNode::start("/dead");
    dead.publish(&robot.client(), "/scan", "x/Y");
    drop(dead);
    robot.crash_master();
    eventually("the report is kept", || reports(&robot) == 1);
    let numbers = |status: &Value| {
        let reports = status["last_rescues"].as_array().unwrap().iter();
        reports
            .map(|report| report["number"].as_u64().unwrap())
            .collect::<Vec<_>>()
    };
    let before = robot.status().unwrap();
    assert_eq!((numbers(&before), &before["deaths"]), (vec![1], &1.into()));
    assert_eq!(before["worker_restarts"], 0);

    for deaths in 1..=2 {
        robot.rescue.kill();
        robot.rescue.start_again();
        robot.rescue.wait_serving();
        robot.await_gate();
        eventually("the death of rosrescue has a report", || {
            reports(&robot) == 1 + deaths
        });
    }
    let after = robot.status().unwrap();
    assert_eq!(numbers(&after), [1, 2, 3]);
    assert_eq!(after["last_rescues"][0], before["last_rescues"][0]);
    assert_eq!(
        after["last_rescues"][2]["cause"],
        "rosrescue itself died and restarted"
    );
    for (field, count) in [("deaths", 1), ("worker_restarts", 2), ("rescues", 3)] {
        assert_eq!(after[field], count, "{field}");
    }
    let run = |robot: &Robot, words: &[&str]| {
        Tool::rosrescue(&robot.scratch, robot.port(), words).ended(0)
    };
    // The dead node is a reason to look.
    let status = Tool::rosrescue(&robot.scratch, robot.port(), &["status"]).ended(1);
    assert!(status.contains(", died 2 times, guarded by"), "{status}");
    assert!(status.contains("rescues     3, the last:\n3  "), "{status}");
    let get = crate::support::page(&robot.client(), "/metrics");
    assert!(
        get.contains("\nrosrescue_worker_restarts_total 2\n"),
        "{get}"
    );
    // A node that was unregistered as dead is still listed as dead on the page.
    let state = crate::support::page(&robot.client(), "/state.json");
    assert!(
        state.contains(r#""name":"/dead","health":"dead""#),
        "{state}"
    );

    robot.crash_master();
    eventually("the next report is kept", || reports(&robot) == 4);
    let rows = Tool::rosrescue(&robot.scratch, robot.port(), &["history", "--json"]).json(0);
    let rows = rows["kept"].as_array().unwrap().clone();
    let row = rows
        .iter()
        .find(|row| row["name"] == "rescue-4")
        .expect("the same number");
    let report = Tool::rosrescue(&robot.scratch, robot.port(), &["report", "4", "--json"]).json(0);
    assert_eq!(row["rescue"]["cause"], report["cause"]);
    assert_eq!(row["rescue"]["total_ms"], report["phases"]["total_ms"]);
    assert_eq!(run(&robot, &["report"]), run(&robot, &["report", "4"]));
    let first = run(&robot, &["report", "1"]);
    assert!(
        first.starts_with("1  ") && first.contains("unregistered dead nodes: /dead"),
        "{first}"
    );
    let history = run(&robot, &["history"]);
    let cause = report["cause"].as_str().unwrap();
    assert!(history.contains(&format!(" ms: {cause}")), "{history}");
    let none = Tool::rosrescue(&robot.scratch, robot.port(), &["report", "9"]);
    assert_eq!(none.exit(), 1, "{none:?}");
    assert!(none.stderr.contains("there are 1, 2, 3, 4"), "{none:?}");
}
