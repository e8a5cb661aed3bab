//! The commands in the documents work: the blocks of each section are pasted unchanged into a shell, on a simulated
//! computer (`tests/support/documents.sh`). [`blocks::NOT_RUN`] lists the ones that cannot be run there.

use std::{fmt::Write as _, fs, path::Path, process::Command};

use super::support::{Scratch, blocks, documents};

const ROOT: &str = env!("CARGO_MANIFEST_DIR");

/// Run before a section that needs a running rosrescue but starts none itself.
const A_ROBOT: &str = "rosrescue core\nroslaunch --wait my_robot.launch\n";

/// Runs the blocks of `document`. Panics with the output of a section that fails.
fn run(document: &str) {
    let text = fs::read_to_string(Path::new(ROOT).join(document)).unwrap();
    let mut blocks = blocks(&text);
    blocks.retain(|block| block.reason().is_none() && !block.is_transcript());
    for section in blocks.chunk_by(|one, next| one.section == next.section) {
        let starts = |name: &str| section.iter().any(|block| block.text.contains(name));
        let mut script = ". tests/support/documents.sh\n".to_owned();
        if !["rosrescue core", "rosrescue proxy", "examples/"]
            .iter()
            .any(|name| starts(name))
        {
            script += A_ROBOT;
        }
        for block in section {
            write!(
                script,
                "echo '--- {document} line {}'\n{}",
                block.line, block.text
            )
            .unwrap();
        }
        run_on_a_computer(&script);
    }
}

/// Runs a script in new namespaces: its ports are free, `pkill` finds no other processes, and everything ends with the
/// shell.
#[track_caller]
pub(super) fn run_on_a_computer(script: &str) -> String {
    let scratch = Scratch::new();
    let mut command = Command::new("unshare");
    scratch.prepare(&mut command);
    let output = command
        .args([
            "--net",
            "--mount",
            "--pid",
            "--fork",
            "--mount-proc",
            "--kill-child",
        ])
        .args(["timeout", "--kill-after=5", "240", "bash", "-euc", script])
        .env("REPOSITORY", ROOT)
        .env("ROSRESCUE", env!("CARGO_BIN_EXE_rosrescue"))
        .current_dir(ROOT)
        .output()
        .unwrap();
    assert!(
        output.status.success(),
        "{} (namespaces need root; tests/run.sh installs what the documents use):\n{script}\n{}{}",
        output.status,
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn the_commands_of_the_readme_work() {
    run("README.md");
}

#[test]
fn the_commands_of_the_guide_for_robots_work() {
    run("ROS_MASTER_URI.md");
}

#[test]
fn the_commands_of_all_other_documents_work() {
    for document in documents() {
        let name = document.strip_prefix(ROOT).unwrap().to_str().unwrap();
        if !["README.md", "ROS_MASTER_URI.md"].contains(&name) {
            run(name);
        }
    }
}

/// The lines of a picture without numbers.
fn lines(picture: &str) -> Vec<String> {
    let lines = picture
        .lines()
        .filter(|line| line.starts_with("<text class=\"line"));
    let texts = lines.map(|line| line.split_once('>').unwrap().1);
    let words = texts.map(|text| text.split(|c: char| c.is_ascii_digit() || c == '.'));
    words
        .map(|words| {
            words
                .filter(|word| !word.is_empty())
                .collect::<Vec<_>>()
                .join("0")
        })
        .collect()
}

#[test]
fn the_recording_matches_the_output_of_its_script() {
    let ours = fs::read_to_string(Path::new(ROOT).join("docs/rescue.svg")).unwrap();
    let made = run_on_a_computer(". tests/support/documents.sh\nexamples/record.sh");
    assert!(lines(&made).len() > 10, "{made}");
    assert_eq!(
        lines(&ours),
        lines(&made),
        "the picture is out of date; to make it again: examples/record.sh >docs/rescue.svg"
    );
}
