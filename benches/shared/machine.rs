//! Describes the computer on which the numbers were measured.

use std::{fs, process::Command, thread::available_parallelism};

use rosrescue::clock;

/// Processor, system, versions, date and commit, in one phrase.
pub(crate) fn describe() -> String {
    let cores = available_parallelism().map_or(0, usize::from);
    let date = clock::wall_text(clock::wall_time());
    let date = date.split('T').next().unwrap_or_default();
    let uname = rustix::system::uname();
    let release = uname.release().to_string_lossy();
    format!(
        "{}, {cores} cores, Linux {}, {}, rosmaster {}, {date}, commit {}",
        processor(),
        release.split('-').next().unwrap_or_default(),
        output_of("/usr/bin/python3", &["--version"]),
        output_of("rosversion", &["rosmaster"]),
        output_of("git", &["rev-parse", "--short", "HEAD"]),
    )
}

fn processor() -> String {
    let text = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    // On ARM the file has no model names.
    let name = text.lines().find_map(|line| {
        let (key, value) = line.split_once(':')?;
        (key.trim() == "model name").then(|| value.trim().to_owned())
    });
    name.unwrap_or_else(|| std::env::consts::ARCH.to_owned())
}

fn output_of(program: &str, arguments: &[&str]) -> String {
    let output = Command::new(program).args(arguments).output();
    output.map_or_else(
        |_| "of unknown version".to_owned(),
        |output| String::from_utf8_lossy(&output.stdout).trim().to_owned(),
    )
}
