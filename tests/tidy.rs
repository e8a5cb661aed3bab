//! What no compiler checks: documents say what the program says, the core does no IO, files stay
//! small.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

/// A longer file holds more than one idea.
const LINES_MOST: usize = 500;

/// The modules that do no IO, as `src/lib.rs` has them: a file or a folder each.
const CORE: [&str; 6] = [
    "xmlrpc",
    "master",
    "lifecycle",
    "census",
    "session",
    "record",
];

/// What the core does not name: the outside world, and the modules that deal with it.
const SHELL: [&str; 17] = [
    "std::net",
    "std::fs",
    "std::env",
    "std::process",
    "std::thread",
    "tokio",
    "hyper",
    "SystemTime::now",
    "Instant::now",
    "crate::admin",
    "crate::app",
    "crate::clock",
    "crate::proxy",
    "crate::recovery",
    "crate::ros_env",
    "crate::store",
    "crate::supervisor",
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

/// What `rosrescue ARGUMENTS` prints at a width of 100, without any setting of this computer.
fn printed(arguments: &[&str]) -> String {
    let output = Command::new(env!("CARGO_BIN_EXE_rosrescue"))
        .args(arguments)
        .env_clear()
        .env("COLUMNS", "100")
        .output()
        .unwrap();
    assert!(output.status.success(), "{output:?}");
    let text = String::from_utf8(output.stdout).unwrap();
    let lines: Vec<_> = text.trim_end().lines().map(str::trim_end).collect();
    lines.join("\n")
}

/// The fenced block of `text` whose first line is `first`, without that line.
fn block<'a>(text: &'a str, first: &str) -> &'a str {
    let start = format!("```\n{first}\n");
    let (_, rest) = text
        .split_once(&start)
        .unwrap_or_else(|| panic!("no block `{first}`"));
    rest.split_once("\n```\n").expect("the block ends").0
}

#[test]
fn the_readme_has_the_help_as_the_program_prints_it() {
    let readme = read("README.md");
    for command in ["core", "proxy"] {
        assert_eq!(
            block(&readme, &format!("$ rosrescue {command} --help")),
            printed(&[command, "--help"]),
            "put this help of `rosrescue {command}` into the README"
        );
    }
}

#[test]
fn the_readme_names_the_rust_that_is_needed() {
    let manifest = read("Cargo.toml");
    let (_, rest) = manifest.split_once("\nrust-version = \"").unwrap();
    let needed = rest.split_once('"').unwrap().0;
    let readme = read("README.md");
    let named: Vec<_> = readme
        .split("Rust ")
        .skip(1)
        .map(|after| {
            after
                .split(|c: char| !c.is_ascii_digit() && c != '.')
                .next()
                .unwrap()
                .trim_end_matches('.')
        })
        .filter(|version| !version.is_empty())
        .collect();
    assert!(!named.is_empty(), "the README names no version of Rust");
    assert!(
        named.iter().all(|version| *version == needed),
        "{named:?} are not {needed}"
    );
}

#[test]
fn the_readme_gives_a_reason_for_every_dependency() {
    let manifest = read("Cargo.toml");
    let readme = read("README.md");
    let mut listed = false;
    let mut count = 0;
    for line in manifest.lines() {
        if line.starts_with('[') {
            listed = ["[dependencies]", "[dev-dependencies]"].contains(&line);
        } else if listed && let Some((name, _)) = line.split_once(" = ") {
            assert!(
                readme.contains(&format!("\n| `{name}`")),
                "no reason for `{name}`"
            );
            count += 1;
        }
    }
    assert!(count > 10, "the manifest is not read as it is written");
}

#[test]
fn links_in_documents_lead_somewhere() {
    let documents = fs::read_dir(root().join("docs")).unwrap();
    let documents = documents.map(|entry| entry.unwrap().path());
    let own = ["README.md", "ROS_MASTER_URI.md", "CHANGELOG.md"];
    let mut links = 0;
    for document in documents.chain(own.map(|name| root().join(name))) {
        let text = read(&document);
        for link in text.split("](").skip(1) {
            let target = link.split([')', '#']).next().unwrap();
            if target.is_empty() || target.starts_with("https://") {
                continue;
            }
            let path = document.parent().unwrap().join(target);
            assert!(path.exists(), "{} links to {target}", document.display());
            links += 1;
        }
    }
    assert!(links > 5);
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

/// `code` with every `std::{a, b::{c}}` followed by `std::a std::b`: names of grouped imports.
fn ungrouped(code: &str, root: &str) -> String {
    let mut names = code.to_owned();
    for group in code.split(&format!("{root}::{{")).skip(1) {
        let mut depth = 0;
        let mut top = String::new();
        for c in group.chars() {
            match c {
                '{' => depth += 1,
                '}' if depth == 0 => break,
                '}' => depth -= 1,
                _ if depth == 0 => top.push(c),
                _ => {}
            }
        }
        for name in top.split(',') {
            names.push_str(&format!(" {root}::{} ", name.trim()));
        }
    }
    names
}

#[test]
fn the_core_does_no_io() {
    assert!(ungrouped("use std::{fmt, fs::{self, File}, io};", "std").contains(" std::fs::"));
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
            let code = ungrouped(&ungrouped(&code, "std"), "crate");
            for name in SHELL {
                assert!(!code.contains(name), "{} names {name}", file.display());
            }
            seen += 1;
        }
    }
    assert!(seen > CORE.len());
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
        users.extend(code.contains("wall_time()").then_some(file));
    }
    users.sort();
    let expected = ["app.rs", "clock.rs", "recovery/report.rs"];
    assert_eq!(users, expected.map(|name| root().join("src").join(name)));
}

#[test]
fn files_stay_small() {
    for file in rust_files(&root().join("src")) {
        let lines = read(&file).lines().count();
        assert!(
            lines <= LINES_MOST,
            "{} has {lines} lines; split it by idea",
            file.display()
        );
    }
}
