//! Plain English: phrases that must not come back, and sentences that are too long to read once.

use std::{
    path::{Path, PathBuf},
    process::Command,
};

use clap::CommandFactory;
use regex::Regex;
use rosrescue::cli::Cli;

use super::{read, root};

/// Phrases that confuse readers, each with what to write instead. A space also matches an underscore, so that names
/// are checked as well.
const PHRASES: &[(&str, &str)] = &[
    ("a line a message", "one line per message"),
    ("and tries again", "retrying"),
    ("anew", "again"),
    ("as ever", "as usual"),
    ("(?:that did|that does|alone does) not hold", "was lost"),
    ("does not give what", "failed"),
    ("(?:gives?|giving|gave) way", "yields, is closed"),
    ("has to be told", "must be told"),
    ("heard of last", "last heard from"),
    ("in the place of", "in place of"),
    ("in vain", "timed out"),
    ("is tried again", "retrying"),
    (
        "(?:is|are) to be (?:done|asked|told|had|taken|sent)",
        "must be done",
    ),
    ("keeps its word", "works"),
    ("(?:makes?|made) a service of", "install as a service"),
    ("(?:never )?ceases? to", "always, stops"),
    ("not so after", "timed out after"),
    ("past rosrescue", "bypasses rosrescue"),
    ("reigns?", "term"),
    ("so that nobody", "(leave it out)"),
    ("somebody else's", "another program's, started by others"),
    ("(?:is|are|was|were) taken out", "is unregistered"),
    ("takes? out (?:nodes|dead)", "unregister"),
    ("(?:a time|times) alone", "while it was cut off"),
    ("two minds", "split-brain"),
    ("what (?:is|was) (?:so|not so)", "the present state, wrong"),
    ("when the system likes", "leave it to the operating system"),
    ("whoever", "(name the program or person)"),
];

/// The most words of a sentence in `--help`.
const HELP_WORDS: usize = 25;
/// The most words of a sentence in the documents that a new user reads first.
const GUIDE_WORDS: usize = 30;

/// Files and folders whose words are not checked: this list, history, the examples of how to write, and what still says
/// "a time alone": the code of several computers with its log lines.
const UNCHECKED: [&str; 11] = [
    "tests/tidy/words.rs",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "crates/rescue-core/src/cluster",
    "crates/rescue-core/src/cluster.rs",
    "src/app/cluster",
    "src/app/cluster.rs",
    "src/cluster",
    "src/cluster.rs",
    "tests/computers",
    "docs/operations.md",
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

/// `text` with each line break and what marks a comment or a continued string replaced by spaces, so that phrases are
/// found across lines. Positions stay the same.
fn joined(text: &str) -> String {
    let breaks = Regex::new(r"\\?\n[ \t]*(?:(?://[/!]?|#|\*|>)[ \t])?").unwrap();
    breaks
        .replace_all(text, |found: &regex::Captures| " ".repeat(found[0].len()))
        .into_owned()
}

/// The phrases in `text`, each with its line and what to write instead.
fn phrases<'a>(text: &str, patterns: &[(Regex, &'a str)]) -> Vec<(usize, String, &'a str)> {
    let flat = joined(text);
    let mut found = Vec::new();
    for (pattern, instead) in patterns {
        for hit in pattern.captures_iter(&flat) {
            let phrase = hit.get(1).unwrap();
            let line = text[..phrase.start()].lines().count().max(1);
            found.push((line, phrase.as_str().to_owned(), *instead));
        }
    }
    found
}

fn patterns() -> Vec<(Regex, &'static str)> {
    let pattern = |phrase: &str| {
        let phrase = phrase.replace(' ', r"[\s_]+");
        Regex::new(&format!(r"(?i)(?:^|[^a-z])({phrase})(?:$|[^a-z])")).unwrap()
    };
    let all = PHRASES.iter();
    all.map(|(phrase, instead)| (pattern(phrase), *instead))
        .collect()
}

#[test]
fn phrases_that_confuse_do_not_come_back() {
    let patterns = patterns();
    for bad in [
        "/// It is made\n    /// again.",
        "fn waits_in_vain() {",
        "\"a dead node is taken \\\n     out\"",
    ] {
        assert_eq!(phrases(bad, &patterns).len(), 1, "{bad}");
    }
    assert!(phrases("a main vein; timeout; an era", &patterns).is_empty());
    let files = files();
    assert!(files.len() > 300, "the files are not listed");
    let mut found = Vec::new();
    for file in files {
        for (line, phrase, instead) in phrases(&read(&file), &patterns) {
            found.push(format!(
                "{}:{line}: {phrase:?}; write: {instead}",
                file.display()
            ));
        }
    }
    assert!(found.is_empty(), "{}", found.join("\n"));
}

/// The sentences of a paragraph. Code between backticks counts as one word, a link as its text.
fn sentences(paragraph: &str) -> Vec<String> {
    let code = Regex::new("`[^`]*`").unwrap();
    let link = Regex::new(r"\[([^\]]*)\]\([^)]*\)").unwrap();
    let end = Regex::new(r"[.!?]\)?(?:\s+|$)").unwrap();
    let plain = link.replace_all(paragraph, "$1");
    let plain = code.replace_all(&plain, "code");
    end.split(&plain).map(str::to_owned).collect()
}

/// The sentences of `paragraph` with more than `most` words.
fn long(paragraph: &str, most: usize) -> Vec<String> {
    let is_word = |word: &&str| word.chars().any(char::is_alphanumeric);
    let mut sentences = sentences(paragraph);
    sentences.retain(|sentence| sentence.split_whitespace().filter(is_word).count() > most);
    sentences
}

/// Collects the long sentences in the help of `command` and its subcommands.
fn long_in_help(command: &clap::Command, found: &mut Vec<String>) {
    let mut texts: Vec<String> = Vec::new();
    let own = [
        command.get_about(),
        command.get_long_about(),
        command.get_after_help(),
        command.get_after_long_help(),
    ];
    texts.extend(own.into_iter().flatten().map(ToString::to_string));
    for argument in command.get_arguments() {
        let help = [argument.get_help(), argument.get_long_help()];
        texts.extend(help.into_iter().flatten().map(ToString::to_string));
        let values = argument.get_possible_values();
        let help = values.iter().filter_map(|value| value.get_help());
        texts.extend(help.map(ToString::to_string));
    }
    for text in texts {
        // Indented lines are examples of commands.
        let lines: Vec<_> = text
            .lines()
            .filter(|line| !line.starts_with("  "))
            .collect();
        let text = lines.join("\n");
        for paragraph in text.split("\n\n").flat_map(|part| part.split("\n- ")) {
            for sentence in long(paragraph, HELP_WORDS) {
                found.push(format!("{}: {sentence}", command.get_name()));
            }
        }
    }
    for command in command.get_subcommands() {
        long_in_help(command, found);
    }
}

#[test]
fn help_has_short_sentences() {
    let mut found = Vec::new();
    long_in_help(&Cli::command(), &mut found);
    found.sort();
    found.dedup();
    assert!(found.is_empty(), "{found:#?}");
}

/// The paragraphs, list items and table cells of a document, without its code.
fn paragraphs(document: &str) -> Vec<String> {
    let mut paragraphs = Vec::new();
    let mut present = String::new();
    let mut is_code = false;
    for line in document.lines() {
        let text = line.trim();
        if text.starts_with("```") {
            is_code = !is_code;
        }
        let is_indented = line.starts_with("    ") && present.is_empty();
        let begins = text.is_empty()
            || text.starts_with(['#', '|', '!', '<', '>'])
            || text.starts_with("* ")
            || text.starts_with("- ")
            || text
                .split_once(". ")
                .is_some_and(|(number, _)| number.parse::<u32>().is_ok());
        if begins || is_code {
            paragraphs.push(std::mem::take(&mut present));
        }
        if is_code || is_indented || text.is_empty() || text.starts_with(['#', '!', '<']) {
            continue;
        }
        match text.starts_with('|') {
            true => paragraphs.extend(text.split('|').map(str::to_owned)),
            false => present = format!("{present} {text}"),
        }
    }
    paragraphs.push(present);
    paragraphs
}

#[test]
fn the_first_documents_have_short_sentences() {
    let twenty = "word ".repeat(20);
    let text =
        format!("# Title\n{twenty}\n{twenty}.\n\n    {twenty}{twenty}\n| {twenty} | {twenty} |\n");
    let found = paragraphs(&text)
        .iter()
        .map(|part| long(part, GUIDE_WORDS).len());
    assert_eq!(found.sum::<usize>(), 1);
    for file in ["README.md", "ROS_MASTER_URI.md"] {
        let text = read(file);
        let found = paragraphs(&text);
        let found: Vec<_> = found
            .iter()
            .flat_map(|part| long(part, GUIDE_WORDS))
            .collect();
        assert!(found.is_empty(), "{file}: {found:#?}");
    }
}
