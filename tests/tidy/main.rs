//! Checks that no compiler makes: documents match the program, modules import downward only.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

#[path = "../support/blocks.rs"]
#[allow(dead_code, reason = "`tests/robot` takes the rest")]
mod blocks;
mod commands;
mod documents;
mod lines;
mod scripts;
mod words;

use std::{
    fs,
    path::{Path, PathBuf},
};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn read(path: impl AsRef<Path>) -> String {
    let path = root().join(path);
    fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// All Rust files below `folder`.
fn rust_files(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path());
    let mut files = Vec::new();
    for path in entries {
        if path.is_dir() {
            files.extend(rust_files(&path));
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            files.push(path);
        }
    }
    files
}

/// The folders with the source of the program and of its crates.
fn source_folders() -> Vec<PathBuf> {
    let crates = fs::read_dir(root().join("crates")).unwrap();
    let crates = crates.map(|entry| entry.unwrap().path().join("src"));
    let mut folders: Vec<_> = [root().join("src")].into_iter().chain(crates).collect();
    folders.retain(|folder| folder.is_dir());
    folders.sort();
    folders
}

/// All source files of the program and of its crates.
fn sources() -> Vec<PathBuf> {
    let mut files: Vec<_> = source_folders()
        .iter()
        .flat_map(|of| rust_files(of))
        .collect();
    files.sort();
    files
}

/// The text of a source file without comments and without the tests at its end. `None` if all of it is tests.
fn code(path: &Path) -> Option<String> {
    let relative = path.strip_prefix(root()).unwrap();
    let is_test = |part: &std::ffi::OsStr| part == "tests" || part == "tests.rs";
    if relative.iter().any(is_test) {
        return None;
    }
    let text = read(path);
    let code = text.split("#[cfg(test)]\nmod tests {").next().unwrap();
    let lines = code
        .lines()
        .filter(|line| !line.trim_start().starts_with("//"));
    Some(lines.collect::<Vec<_>>().join("\n"))
}

/// The names directly below `root` in `code`: `a` and `b` of `root::{a, b::{c}}`, `d` of `root::d::e`.
fn named<'a>(code: &'a str, root: &str) -> Vec<&'a str> {
    let mut names = Vec::new();
    let first = |name: &'a str| {
        let name = name.trim_start();
        let end = name.find(|c: char| !c.is_alphanumeric() && c != '_');
        &name[..end.unwrap_or(name.len())]
    };
    for (at, found) in code.match_indices(&format!("{root}::")) {
        let before = code[..at].chars().next_back();
        if before.is_some_and(|c| c.is_alphanumeric() || "_:".contains(c)) {
            continue;
        }
        let rest = &code[at + found.len()..];
        let Some(group) = rest.strip_prefix('{') else {
            names.push(first(rest));
            continue;
        };
        let (mut depth, mut start) = (0, 0);
        for (at, c) in group.char_indices() {
            match c {
                ',' | '}' if depth == 0 => {
                    names.push(first(&group[start..at]));
                    start = at + 1;
                    if c == '}' {
                        break;
                    }
                }
                '{' => depth += 1,
                '}' => depth -= 1,
                _ => {}
            }
        }
    }
    names.retain(|name| !name.is_empty());
    names
}

/// The modules, each above all that it may import: `docs/decisions/0020`.
#[rustfmt::skip]
const LAYERS: [&str; 26] = [
    "clock", "limit", "printable", "logging", "task", "wait", "cli", "ros_env",
    "config", "resolver", "cluster", "gate", "status", "ledger", "upstream", "write_queue", "guardian", "process", "nodes",
    "recovery", "roscore", "server", "app", "commands", "program", "main",
];

#[test]
fn modules_import_downward_only() {
    let source = root().join("src");
    for file in rust_files(&source) {
        let Some(code) = code(&file) else { continue };
        let relative = file.strip_prefix(&source).unwrap().with_extension("");
        let module = relative.iter().next().unwrap().to_str().unwrap().to_owned();
        if module == "lib" {
            continue;
        }
        let layer = |name: &str| LAYERS.iter().position(|of| *of == name);
        let own = layer(&module).unwrap_or_else(|| panic!("{module} is in no layer"));
        for name in named(&code, "crate") {
            let of = layer(name).unwrap_or_else(|| panic!("{name} is in no layer"));
            assert!(of <= own, "{} imports {name}", file.display());
        }
    }
}

/// Decisions depend on the monotonic clock. The wall clock is read in one place, for people.
#[test]
fn only_the_clock_reads_the_wall_clock() {
    let mut readers = Vec::new();
    for file in sources() {
        let Some(code) = code(&file) else { continue };
        let words = [
            "SystemTime",
            "UNIX_EPOCH",
            "wall_clock",
            "CLOCK_REALTIME",
            "ClockId",
        ];
        if words.iter().any(|word| code.contains(word)) {
            readers.push(file);
        }
    }
    assert_eq!(readers, [root().join("src/clock.rs")]);
    // These use it for reports and for the start of a session, which only people read.
    let mut users = Vec::new();
    for file in sources() {
        let code = code(&file).unwrap_or_default();
        users.extend(code.contains("wall_time").then_some(file));
    }
    users.sort();
    let expected = [
        "app/startup.rs",
        "clock.rs",
        "commands/check/facts/clock.rs",
        "nodes/addresses.rs",
        "nodes/liveness.rs",
        "nodes/local/unregister_dead.rs",
        "nodes/local.rs",
        "recovery/reporting.rs",
        "server/clients.rs",
        "server/pages/robot.rs",
        "server/pages/status.rs",
        "status/computers.rs",
        "status/condition.rs",
    ];
    assert_eq!(users, expected.map(|name| root().join("src").join(name)));
}
