//! What no compiler checks: documents say what the program says, the core does no IO, files stay
//! small.

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

use std::{
    fs,
    path::{Path, PathBuf},
};

/// A longer file holds more than one idea.
const LINES_MOST: usize = 800;

/// The modules that do no IO, as `src/lib.rs` has them: a file or a folder each.
const CORE: [&str; 15] = [
    "xmlrpc",
    "master",
    "order",
    "hide",
    "replay",
    "lifecycle",
    "health",
    "checkpoint/session",
    "checkpoint/format",
    "checkpoint/compare",
    "checkpoint/putback",
    "cluster/machine",
    "cluster/journal",
    "cluster/merge",
    "cluster/namesake",
];

/// What of the standard library the core may name: nothing that reaches the outside world.
#[rustfmt::skip]
const STD: [&str; 15] = [
    "borrow", "cmp", "collections", "error", "fmt", "hash", "io", "iter", "mem", "num", "ops", "slice",
    "str", "sync", "time",
];

/// The packages that the core may name: they work on values and bytes.
const PURE: [&str; 9] = [
    "base64",
    "bytes",
    "crc32c",
    "indexmap",
    "quick_xml",
    "regex",
    "serde",
    "serde_saphyr",
    "thiserror",
];

/// What reaches the outside world all the same, or another thread: clocks, the standard streams, locks.
#[rustfmt::skip]
const OUTSIDE: [&str; 12] = [
    "::now(", ".elapsed(", "SystemTime", "io::stdin", "io::stdout", "io::stderr", "print!(",
    "println!(", "Mutex", "RwLock", "Condvar", "mpsc",
];

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

/// The text of a source file without comments and without the tests at its end; none if all of it
/// is tests.
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

/// What `code` names directly below `root`: `a` and `b` of `root::{a, b::{c}}`, `d` of `root::d::e`.
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

/// What `code` names that the core must not name.
fn impurities(code: &str, packages: &[String]) -> Vec<String> {
    let mut found: Vec<String> = OUTSIDE
        .iter()
        .filter(|word| code.contains(**word))
        .map(|word| (*word).to_owned())
        .collect();
    let others = |root: &str, allowed: &[&str]| -> Vec<String> {
        let names = named(code, root).into_iter();
        let others = names.filter(|name| !allowed.contains(name));
        others.map(|name| format!("{root}::{name}")).collect()
    };
    found.extend(others("std", &STD));
    let core = CORE.map(|module| module.split('/').next().unwrap());
    found.extend(others("crate", &core));
    let packages = packages.iter();
    for package in packages.filter(|name| !PURE.contains(&name.as_str())) {
        found.extend(others(package, &[]));
        // Whole, or in an attribute.
        let whole = [format!("use {package};"), format!("#[{package}(")];
        found.extend(whole.into_iter().filter(|name| code.contains(name)));
    }
    found
}

/// The packages of the manifest, as code names them.
fn packages() -> Vec<String> {
    let manifest = read("Cargo.toml");
    let (_, rest) = manifest.split_once("\n[dependencies]\n").unwrap();
    let listed = rest.split("\n[").next().unwrap();
    let names = listed.lines().filter_map(|line| line.split_once(" = "));
    names.map(|(name, _)| name.replace('-', "_")).collect()
}

#[test]
fn the_core_does_no_io() {
    let packages = packages();
    assert!(
        packages.len() > 10
            && PURE
                .iter()
                .all(|name| packages.contains(&(*name).to_owned()))
    );
    for impure in [
        "use std::{fmt, fs::{self, File}, io};",
        "use crate::{\n    cli::Restore,\n    master::Master,\n};",
        "let config = crate::config::Config::default();",
        "use crate::wait;",
        "use std::os::fd::AsFd;",
        "rustix::process::getpid()",
        "use socket2::Socket;",
        "if start.elapsed() > LIMIT {",
        "let clock = std::time::Instant::now();",
        "tracing::info!(\"said\");",
        "use clap;",
    ] {
        assert!(!impurities(impure, &packages).is_empty(), "{impure}");
    }
    let pure = "use std::{collections::{BTreeMap, VecDeque}, time::Duration};\nuse crate::{master::{self, Master}};";
    assert_eq!(impurities(pure, &packages), Vec::<String>::new());
    let mut seen = 0;
    for module in CORE {
        let folder = root().join("src").join(module);
        let mut files = vec![folder.with_extension("rs")];
        files.retain(|file| file.exists());
        if folder.is_dir() {
            files.extend(rust_files(&folder));
        }
        assert!(!files.is_empty(), "there is no module `{module}`");
        for file in files {
            let Some(code) = code(&file) else { continue };
            let found = impurities(&code, &packages);
            assert!(found.is_empty(), "{} names {found:?}", file.display());
            // Above the module is the crate, which is called by its name.
            let is_top = file.parent() != Some(&*folder) || file.ends_with("mod.rs");
            let above = if is_top { "super::" } else { "super::super::" };
            assert!(!code.contains(above), "{} names {above}", file.display());
            seen += 1;
        }
    }
    assert!(seen > CORE.len());
}

/// The modules, each above all that it may import: `docs/decisions/0020`.
#[rustfmt::skip]
const LAYERS: [&str; 33] = [
    "clock", "dice", "limit", "log", "regular_file", "wait", "xmlrpc", "master", "hide", "replay", "lifecycle", "health", "order", "checkpoint", "cli", "ros_env",
    "config", "resolver", "cluster", "gate", "status", "ledger", "upstream", "write_queue", "guardian", "process", "nodes",
    "recovery", "roscore", "server", "app", "commands", "main",
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

/// Decisions hang on the monotonic clock: the wall clock is read in one place, for people.
#[test]
fn only_the_clock_reads_the_wall_clock() {
    let mut readers = Vec::new();
    for file in rust_files(&root().join("src")) {
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
    // Who asks it: for reports and the start of a session, both read by people only.
    let mut users = Vec::new();
    for file in rust_files(&root().join("src")) {
        let code = code(&file).unwrap_or_default();
        users.extend(code.contains("wall_time").then_some(file));
    }
    users.sort();
    let expected = [
        "app/startup.rs",
        "clock.rs",
        "commands/check/facts.rs",
        "recovery/reporting.rs",
        "server/clients.rs",
        "server/pages/robot.rs",
        "server/pages/status.rs",
        "status/computers.rs",
        "status/condition.rs",
    ];
    assert_eq!(users, expected.map(|name| root().join("src").join(name)));
}

#[test]
fn files_stay_small() {
    let folders = ["src", "tests", "benches"].map(|folder| rust_files(&root().join(folder)));
    for file in folders.into_iter().flatten() {
        let lines = read(&file).lines().count();
        assert!(
            lines <= LINES_MOST,
            "{} has {lines} lines; split it by idea",
            file.display()
        );
    }
}
