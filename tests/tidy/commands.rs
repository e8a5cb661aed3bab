//! Checks that the commands in documents exist. `tests/robot/documents.rs` runs their blocks.

use std::process::Command;

use super::{
    blocks::{NOT_RUN, blocks, documents},
    read, root,
};

/// The texts between backticks in a document, on one line each.
pub(crate) fn quoted(text: &str) -> impl Iterator<Item = &str> {
    text.lines()
        .flat_map(|line| line.split('`').skip(1).step_by(2))
}

#[test]
fn commands_that_are_not_run_name_an_existing_test() {
    for (word, reason) in NOT_RUN {
        let files: Vec<_> = quoted(reason).collect();
        assert!(!files.is_empty(), "{word}: {reason}");
        for file in files {
            assert!(root().join(file).exists(), "{word} names {file}");
        }
    }
}

/// The output of `rosrescue COMMAND --help`. `None` if there is no such command.
fn help(command: &[&str]) -> Option<String> {
    let output = Command::new(env!("CARGO_BIN_EXE_rosrescue"))
        .args(command)
        .arg("--help")
        .env_clear()
        .output()
        .unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    output.status.success().then_some(text)
}

/// The checked commands in `line`, each without what precedes it.
fn commands(line: &str) -> impl Iterator<Item = Vec<&str>> {
    let line = line.split(" #").next().unwrap();
    line.split(['|', ';', '&']).filter_map(|command| {
        let mut words = command.split_whitespace().peekable();
        while words
            .next_if(|word| ["$", "sudo"].contains(word) || word.contains('='))
            .is_some()
        {}
        let words: Vec<_> = words.collect();
        (!words.is_empty()).then_some(words)
    })
}

/// The mistake in a command of a document.
fn mistake(words: &[&str]) -> Option<String> {
    let [program, arguments @ ..] = words else {
        return None;
    };
    let is_name = |word: &&&str| word.chars().all(|c| c.is_ascii_lowercase() || c == '-');
    match *program {
        "rosrescue" => {
            let command = arguments
                .first()
                .filter(is_name)
                .filter(|word| !word.starts_with('-'));
            let command: Vec<_> = command.into_iter().copied().collect();
            let Some(help) = help(&command) else {
                return Some("there is no such command".to_owned());
            };
            // What follows `--` belongs to another command.
            let own = arguments.iter().take_while(|word| **word != "--");
            let options = own.filter(|word| word.starts_with("--"));
            let mut options = options.map(|word| word.split('=').next().unwrap());
            let is_known = |option: &str| {
                help.split([' ', '\n', '=', ',', '['])
                    .any(|word| word == option)
            };
            options
                .find(|option| !is_known(option))
                .map(|option| format!("it has no {option}"))
        }
        "cargo" => {
            let target = arguments
                .windows(2)
                .find(|pair| ["--bench", "--test"].contains(&pair[0]))?;
            let folder = if target[0] == "--bench" {
                "benches"
            } else {
                "tests"
            };
            let exists = ["", ".rs", "/main.rs"]
                .iter()
                .any(|end| root().join(format!("{folder}/{}{end}", target[1])).exists());
            (!exists).then(|| format!("there is no {folder}/{}", target[1]))
        }
        script
            if script.ends_with(".sh")
                && script.contains('/')
                && !script.starts_with(['/', '~', '$']) =>
        {
            (!root().join(script).exists()).then(|| "there is no such script".to_owned())
        }
        _ => None,
    }
}

#[test]
fn commands_in_documents_exist_with_their_options() {
    let mut checked = 0;
    for document in documents() {
        let text = read(&document);
        let blocks = blocks(&text);
        let lines = blocks.iter().flat_map(|block| {
            let end = if block.is_transcript() { 1 } else { usize::MAX };
            block.text.lines().take(end)
        });
        for words in lines.chain(quoted(&text)).flat_map(commands) {
            let mistake = mistake(&words);
            assert!(
                mistake.is_none(),
                "{} has `{}`: {}",
                document.display(),
                words.join(" "),
                mistake.unwrap()
            );
            checked += 1;
        }
    }
    assert!(checked > 100, "{checked}");
}

/// The test of the help compares transcripts with the program.
#[test]
fn transcripts_are_of_help() {
    for document in documents() {
        for block in blocks(&read(&document))
            .iter()
            .filter(|block| block.is_transcript())
        {
            let first = block.text.lines().next().unwrap();
            assert!(
                first.ends_with(" --help"),
                "{} line {}: put what is printed into a fence of text, and its command before it",
                document.display(),
                block.line
            );
        }
    }
}
