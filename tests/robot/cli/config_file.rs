//! `--config FILE`: which value counts, and which files are refused.

use std::{fs, path::PathBuf, process::Command};

use serde_json::Value;

use crate::support::{Scratch, find_program, free_port};

fn file(scratch: &Scratch, text: &str) -> PathBuf {
    let file = scratch.path("rosrescue.toml");
    fs::write(&file, text).unwrap();
    file
}

/// `rosrescue WORDS --config FILE`, with `text` in the file.
fn command(scratch: &Scratch, text: &str, words: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_rosrescue"));
    scratch.prepare(&mut command);
    command.args(words).arg("--config").arg(file(scratch, text));
    command
}

#[test]
fn the_command_line_wins_over_the_environment_and_that_over_the_file() {
    let scratch = Scratch::new();
    let port = free_port().to_string();
    // `check` does not import a rosmaster that is named, which would take most of its time.
    let rosmaster = find_program("rosmaster");
    let text = "port = 1\nhold = 2\nhistory = 3\nno-rosout = true\nverbose = true\nallow = [\"10.0.0.0/24\", \"fd00::/64\"]\n";
    let output = command(&scratch, text, &["check", "--json", "--port", &port])
        .env("ROSRESCUE_HOLD", "4.5")
        .env("ROSRESCUE_VERBOSE", "0")
        .env("ROSRESCUE_ROSMASTER", &rosmaster)
        .output()
        .unwrap();
    let report: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let file = scratch.path("rosrescue.toml").display().to_string();
    for (option, value, source) in [
        ("port", port.as_str(), "command line"),
        ("hold", "4.5", "environment"),
        ("verbose", "0", "environment"),
        ("history", "3", &file),
        ("no-rosout", "true", &file),
        ("allow", "10.0.0.0/24,fd00::/64", &file),
        ("numworkers", "8", "default"),
    ] {
        let options = report["options"].as_array().unwrap();
        let found = options
            .iter()
            .find(|found| found["option"] == option)
            .unwrap();
        assert_eq!(
            (&found["value"], &found["source"]),
            (&value.into(), &source.into()),
            "{option}"
        );
    }
    let output = command(&scratch, text, &["check", "--port", &port])
        .env("ROSRESCUE_ROSMASTER", &rosmaster)
        .output()
        .unwrap();
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(said.contains(&format!("history = 3 ({file})")), "{said}");
}

#[test]
fn a_file_with_a_mistake_is_refused_in_a_sentence() {
    let scratch = Scratch::new();
    for (words, text, said) in [
        (
            &["core"][..],
            "prot = 3",
            "unknown key `prot`; did you mean `port`?",
        ),
        (
            &[],
            "numworker = 3",
            "unknown key `numworker`; did you mean `numworkers`?",
        ),
        (
            &["core"],
            "xyz = 3",
            "unknown key `xyz`; the keys are the long options",
        ),
        (&["core"], "config = 'x'", "unknown key `config`"),
        (&["core"], "help = true", "unknown key `help`"),
        (
            &["core"],
            "master = 'http://a:1'",
            "`master` is an option of `rosrescue proxy`",
        ),
        (
            &["proxy"],
            "no-rosout = true",
            "`no-rosout` is an option of `rosrescue core`",
        ),
        (&["core"], "port = 'x'", "`port`: invalid value 'x'"),
        (&["core"], "port = 0", "`port`: invalid value '0'"),
        (&["core"], "port", "line 1"),
        (&["core"], "[port]", "`port` must be a text or a number"),
        (
            &["core"],
            "no-rosout = 1",
            "`no-rosout` must be true or false",
        ),
        (&["core"], "advertise = 'a'", "--cluster"),
        (
            &["install", "--dry-run", "--", "core"],
            "prot = 3",
            "did you mean `port`?",
        ),
    ] {
        let output = command(&scratch, text, words).output().unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{text}: {stderr}");
        assert!(stderr.contains(said), "{text}: {stderr}");
    }
    let mut none = Command::new(env!("CARGO_BIN_EXE_rosrescue"));
    scratch.prepare(&mut none);
    let output = none
        .args(["core", "--config", "/nonexistent"])
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("/nonexistent: No such file"));
}

#[test]
fn a_file_without_end_is_refused() {
    let scratch = Scratch::new();
    for (options, file) in [
        (&[][..], "--config"),
        (
            &["--cluster", "http://127.0.0.1:1", "--cluster-user", "u"],
            "--cluster-password-file",
        ),
    ] {
        let mut endless = Command::new(env!("CARGO_BIN_EXE_rosrescue"));
        scratch.prepare(&mut endless);
        let output = endless
            .arg("core")
            .args(options)
            .args([file, "/dev/zero"])
            .output()
            .unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{file}: {stderr}");
        assert!(
            stderr.contains("it has more than 1 MiB"),
            "{file}: {stderr}"
        );
    }
}
