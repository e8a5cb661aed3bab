//! Options that affect rosrescue's output, set by environment variables as in a service unit.

use std::process::Command;

use crate::support::{Rosmaster, Scratch, Setup};

#[test]
fn the_log_as_json() {
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    let mut rescue = Setup::proxy(&scratch, master.client().port())
        .env("ROSRESCUE_LOG_FORMAT", "json")
        .start();
    // Standard error may be read after standard output.
    rescue.wait_line("something in its log", |line| line.starts_with('{'));
    let log = rescue.output();
    let lines: Vec<serde_json::Value> = log
        .iter()
        .filter(|line| line.starts_with('{'))
        .map(|line| serde_json::from_str(line).expect("JSON"))
        .collect();
    assert!(!lines.is_empty(), "{log:?}");
    assert!(lines.iter().all(|line| line["level"].is_string()));
}

/// The same command, run in a terminal.
fn on_terminal(own: &Command) -> Command {
    let words = std::iter::once(own.get_program()).chain(own.get_args());
    let words: Vec<_> = words
        .map(|word| format!("'{}'", word.to_str().unwrap()))
        .collect();
    let mut script = Command::new("script");
    script.args([
        "--quiet",
        "--return",
        "--command",
        &words.join(" "),
        "/dev/null",
    ]);
    for (key, value) in own.get_envs() {
        match value {
            Some(value) => script.env(key, value),
            None => script.env_remove(key),
        };
    }
    script
}

#[test]
fn colour_on_a_terminal_only_and_not_with_no_color() {
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    let is_coloured = |no_color: &str, terminal: bool| {
        let setup = Setup::proxy(&scratch, master.client().port());
        let folder = scratch.path(format!("{no_color}{terminal}"));
        std::fs::create_dir(&folder).unwrap();
        let setup = setup.at_checkpoint(folder.join("checkpoint"));
        let setup = setup.env("NO_COLOR", no_color);
        let rescue = match terminal {
            true => setup.wrapped(on_terminal),
            false => setup,
        }
        .start();
        rescue.output().iter().any(|line| line.contains('\u{1b}'))
    };
    assert!(is_coloured("", true));
    assert!(!is_coloured("1", true));
    assert!(!is_coloured("", false));
}
