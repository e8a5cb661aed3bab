//! The command blocks in documents. A fenced block without a language, or in sh, bash or console, and every
//! indented block is a block of commands, except for launch files. Program output is in a fence marked
//! `text`.

use std::{
    fs,
    path::{Path, PathBuf},
};

/// Commands in documents that the test does not run, the reason, and where they are tested instead. A block
/// that contains one of these texts is left out.
#[rustfmt::skip]
pub(crate) const NOT_RUN: [(&str, &str); 20] = [
    ("sudo ", "changes this computer: `tests/robot/installation/booted.rs` and `tests/robot/installation/package.rs` have their own"),
    ("rosrescue install", "changes this computer: `tests/robot/installation/install.rs`"),
    ("systemctl ", "needs systemd: `tests/robot/installation/booted.rs`"),
    ("journalctl ", "needs systemd: `tests/robot/installation/booted.rs`"),
    ("packaging/", "takes minutes: `tests/robot/installation/package.rs`"),
    ("catkin_make", "needs a workspace: `tests/robot/installation/catkin.rs`"),
    ("rosrun rosrescue", "needs a workspace: `tests/robot/installation/catkin.rs`"),
    ("docker ", "no Docker in CI: `tests/robot/restart/guardian.rs` has a process namespace"),
    ("robot_upstart", "not in Debian: it was never run, as `ROS_MASTER_URI.md` says"),
    ("cargo ", "builds and tests: `tests/run.sh`"),
    ("tests/run.sh", "runs this very test: `tests/run.sh`"),
    ("ROSRESCUE_SCRIPT=failed.txt", "needs the output of a failure: `tests/differential/script.rs`"),
    ("examples/robot/", "takes minutes: `tests/robot/nodes/example.rs`"),
    ("ROSRESCUE_CHECKPOINT=", "settings of a unit: `tests/robot/installation/install.rs`"),
    ("ROSRESCUE_CLUSTER=", "settings of a unit: `tests/robot/installation/install.rs`"),
    ("etcdctl ", "needs several computers: `tests/robot/computers.rs` has them"),
    ("openssl ", "needs several computers: `tests/robot/computers.rs` has them"),
    ("check --cluster ", "needs several computers: `tests/robot/computers.rs` has them"),
    ("core --cluster ", "needs several computers: `tests/robot/computers.rs` has them"),
    ("rosrescue handover", "needs several computers: `tests/robot/computers.rs` has them"),
];

/// A block of commands as it stands in a document, without its indentation.
#[derive(Clone, Debug)]
pub(crate) struct Block {
    /// The line of the document on which the block starts.
    pub(crate) line: usize,
    /// The heading above the block.
    pub(crate) section: String,
    pub(crate) text: String,
}

impl Block {
    /// Why the block is not run. `None` if it is.
    pub(crate) fn reason(&self) -> Option<&'static str> {
        let found = NOT_RUN.iter().find(|(word, _)| self.text.contains(word));
        found.map(|(_, reason)| *reason)
    }

    /// Whether the block shows the output of a program, with the command above it, as in `$ rosrescue core
    /// --help`.
    pub(crate) fn is_transcript(&self) -> bool {
        self.text.starts_with("$ ")
    }
}

/// Every document of the repository.
pub(crate) fn documents() -> Vec<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let folders = [
        "",
        "docs",
        "docs/decisions",
        "benches",
        "fuzz",
        "examples/robot",
    ]
    .map(|name| root.join(name));
    let files = folders.iter().flat_map(fs::read_dir).flatten();
    let files = files.map(|entry| entry.unwrap().path());
    let mut files: Vec<_> = files
        .filter(|file| file.extension().is_some_and(|extension| extension == "md"))
        .collect();
    files.sort();
    files
}

/// The command blocks of a document, in order.
pub(crate) fn blocks(document: &str) -> Vec<Block> {
    let mut blocks = Vec::new();
    let mut section = String::new();
    let mut lines = document.lines().zip(1..).peekable();
    let mut after_blank = true;
    while let Some((line, number)) = lines.next() {
        let indent = indentation(line);
        let mut body = Vec::new();
        if let Some(language) = line.trim_start().strip_prefix("```") {
            body.extend(
                lines
                    .by_ref()
                    .map(|(line, _)| line)
                    .take_while(|line| !line.trim_start().starts_with("```")),
            );
            if !["", "sh", "bash", "console"].contains(&language) {
                body.clear();
            }
        } else if after_blank
            && indent >= 4
            && !line.trim_start().starts_with('<')
            && !line.trim().is_empty()
        {
            body.push(line);
            while let Some((line, _)) =
                lines.next_if(|(line, _)| line.trim().is_empty() || indentation(line) >= 4)
            {
                body.push(line);
            }
        } else if line.starts_with('#') {
            section = line.trim_start_matches('#').trim().to_owned();
        }
        after_blank = line.trim().is_empty() || !body.is_empty();
        if !body.is_empty() {
            let indent = indentation(body[0]);
            let text = body
                .iter()
                .map(|line| line.get(indent..).unwrap_or("").trim_end());
            let text = text.collect::<Vec<_>>().join("\n").trim_end().to_owned() + "\n";
            blocks.push(Block {
                line: number,
                section: section.clone(),
                text,
            });
        }
    }
    blocks
}

fn indentation(line: &str) -> usize {
    line.len() - line.trim_start_matches(' ').len()
}
