//! Plain English: phrases that must not come back.

use std::{
    path::{Path, PathBuf},
    process::Command,
};

use super::{read, root};

/// Phrases that confuse readers, each with what to write instead. A space stands for any blanks, line breaks and
/// underscores, so that names are checked as well.
const PHRASES: &[(&str, &str)] = &[
    ("a line a message", "one line per message"),
    ("a time alone", "while it was cut off"),
    ("times alone", "while it was cut off"),
    ("and tries again", "retrying"),
    ("afresh", "again, without the old state"),
    ("anew", "again"),
    ("answers no more", "no longer answers"),
    ("are to be asked", "must be asked"),
    ("are to be done", "must be done"),
    ("are to be told", "must be told"),
    ("is to be asked", "must be asked"),
    ("is to be done", "must be done"),
    ("is to be told", "must be told"),
    ("as ever", "as usual"),
    ("asks nobody", "asks no other process"),
    ("but for what", "except for"),
    ("comes again", "reconnects, comes back"),
    ("gave up in order", "stepped down cleanly"),
    ("give up in order", "step down cleanly"),
    ("gives up in order", "steps down cleanly"),
    ("goes past", "bypasses"),
    ("has it that", "(say it directly)"),
    ("hold up nobody", "delay no other node"),
    ("holds up nobody", "delays no other node"),
    ("holds nobody up", "delays no other node"),
    ("how it went", "the result"),
    ("in good order", "cleanly"),
    ("ended in order", "stopped cleanly"),
    ("ends in order", "stops cleanly"),
    ("stop in order", "stop cleanly"),
    ("stopped in order", "stopped cleanly"),
    ("stops in order", "stops cleanly"),
    ("is no concern of", "does not matter to"),
    ("is no death", "does not count as a death"),
    ("is no failure", "is not an error"),
    ("is no name of", "is not a valid name"),
    ("is no rescue", "is not a rescue"),
    ("is told of nothing", "gets no notification"),
    ("look for what", "check for"),
    ("made of it", "made from it"),
    ("nobody else", "no other computer, no other program"),
    ("nobody knows", "it is unknown"),
    ("nobody waits", "no call waits"),
    ("of one's own", "your own"),
    ("otherwise than", "without, differently from"),
    ("somebody did so", "another program did that"),
    ("somebody else", "another program, another computer"),
    ("somebody has", "(name the program or person)"),
    ("somebody looks", "(name the program or person)"),
    ("somebody who", "(name the program or person)"),
    ("takes everything back", "undoes everything"),
    ("takes out", "unregisters, removes"),
    ("what goes on", "the present state"),
    ("what is looked at", "the facts"),
    ("what is meant", "(name it)"),
    ("what is needed of", "the part of"),
    ("what was owed", "what was not sent"),
    ("who else", "which other programs or users"),
    ("why it is not known", "why it is unknown"),
    ("why they are not known", "why they are unknown"),
    ("cease to", "stop"),
    ("ceases to", "stops"),
    ("that did not hold", "that was lost"),
    ("does not give what", "failed"),
    ("gave way", "was closed"),
    ("give way", "yield, be closed"),
    ("gives way", "yields, is closed"),
    ("giving way", "yielding"),
    ("has to be told", "must be told"),
    ("heard of last", "last heard from"),
    ("in the place of", "in place of"),
    ("in vain", "timed out"),
    ("is tried again", "retrying"),
    ("keeps its word", "works"),
    ("makes a service of", "installs as a service"),
    ("not so after", "timed out after"),
    ("past rosrescue", "bypasses rosrescue"),
    ("reign", "term"),
    ("so that nobody", "(leave it out)"),
    ("are taken out", "are unregistered"),
    ("is taken out", "is unregistered"),
    ("was taken out", "was unregistered"),
    ("take out nodes", "unregister nodes"),
    ("two minds", "split-brain"),
    ("what is not so", "what is wrong"),
    ("what is so", "the present state"),
    ("when the system likes", "leave it to the operating system"),
    ("whoever", "(name the program or person)"),
];

/// Files and folders whose words are not checked: this list, the examples of how to write, and the code of several
/// computers with its tests.
const UNCHECKED: [&str; 3] = [
    "tests/tidy/words.rs",
    "CONTRIBUTING.md",
    "crates/rescue-core/src/cluster/tests",
];

/// Tracked files whose words are checked: code, scripts and documents, but neither this list nor history.
fn files() -> Vec<PathBuf> {
    let listed = Command::new("git")
        .args([
            "ls-files",
            "-z",
            "--cached",
            "--others",
            "--exclude-standard",
        ])
        .current_dir(root())
        .output()
        .unwrap();
    let listed = String::from_utf8(listed.stdout).unwrap();
    let kinds = ["rs", "md", "sh", "py", "js", "html", "yaml", "toml", "in"];
    let files = listed.split('\0').map(Path::new).filter(|path| {
        let is_text = path
            .extension()
            .is_some_and(|kind| kinds.iter().any(|known| kind == *known));
        let is_exempt = UNCHECKED.iter().any(|exempt| path.starts_with(exempt));
        is_text && !is_exempt && root().join(path).is_file()
    });
    files.map(Path::to_owned).collect()
}

/// `text` in small letters, with one blank for blanks, line breaks, underscores, and marks of comments and continued
/// strings; and the line of each byte.
fn joined(text: &str) -> (String, Vec<usize>) {
    let (mut flat, mut lines) = (String::new(), Vec::new());
    for (number, line) in text.lines().enumerate() {
        let line = line.trim_start_matches([' ', '/', '!', '#', '*', '>', '\t']);
        let words = line.trim_end_matches('\\').to_ascii_lowercase();
        for word in words.split([' ', '_']).filter(|word| !word.is_empty()) {
            flat.push_str(word);
            flat.push(' ');
            lines.resize(flat.len(), number + 1);
        }
    }
    (flat, lines)
}

/// The phrases in `text`, each with its line and what to write instead.
fn phrases(text: &str) -> Vec<(usize, &'static str, &'static str)> {
    let (flat, lines) = joined(text);
    let is_letter = |at: Option<usize>| {
        at.and_then(|at| flat.as_bytes().get(at))
            .is_some_and(u8::is_ascii_alphabetic)
    };
    let mut found = Vec::new();
    for (phrase, instead) in PHRASES {
        for (at, _) in flat.match_indices(phrase) {
            if !is_letter(at.checked_sub(1)) && !is_letter(Some(at + phrase.len())) {
                found.push((lines[at], *phrase, *instead));
            }
        }
    }
    found
}

#[test]
fn phrases_that_confuse_do_not_come_back() {
    for bad in [
        "/// The two\n    /// minds.",
        "fn waits_in_vain() {",
        "\"a dead node is taken \\\n     out\"",
    ] {
        assert_eq!(phrases(bad).len(), 1, "{bad}");
    }
    assert!(phrases("a main vein; sovereign; renewal").is_empty());
    let files = files();
    assert!(files.len() > 300, "the files are not listed");
    let mut found = Vec::new();
    for file in files {
        for (line, phrase, instead) in phrases(&read(&file)) {
            found.push(format!(
                "{}:{line}: {phrase:?}; write: {instead}",
                file.display()
            ));
        }
    }
    assert!(found.is_empty(), "{}", found.join("\n"));
}
