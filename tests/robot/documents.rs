//! The commands in the documents work: the blocks of each section are pasted unchanged into a shell, on a simulated
//! computer (`tests/support/documents.sh`). [`blocks::NOT_RUN`] lists the ones that cannot be run there.

use std::{fmt::Write as _, fs, path::Path, process::Command};

use super::support::{Scratch, blocks, documents};

const ROOT: &str = env!("CARGO_MANIFEST_DIR");

/// Begins the line that prints where a block stands.
const WHERE: &str = "echo '--- ";

/// The sections of `document` with commands for a simulated computer: the heading and the commands. A line before each block
/// prints where it stands.
fn sections(document: &str) -> Vec<(String, String)> {
    let text = fs::read_to_string(Path::new(ROOT).join(document)).unwrap();
    let mut blocks = blocks(&text);
    blocks.retain(|block| block.reason().is_none() && !block.is_transcript());
    let sections = blocks.chunk_by(|one, next| one.section == next.section);
    let sections = sections.map(|section| {
        let mut script = String::new();
        for block in section {
            let (line, text) = (block.line, &block.text);
            write!(script, "{WHERE}{document} line {line}'\n{text}").unwrap();
        }
        (section[0].section.clone(), script)
    });
    sections.collect()
}

/// What the reader of a section has started before, unless the section starts it itself.
fn before(section: &str) -> &'static str {
    let has = |word: &&str| section.contains(word);
    let uses_ros = [
        "rosrescue ",
        "rosnode ",
        "rostopic ",
        "rosparam ",
        "roslaunch ",
        "curl ",
    ];
    let starts_master = ["rosrescue core", "rosrescue proxy", "examples/"];
    match uses_ros.iter().any(has) && !starts_master.iter().any(has) {
        false => "",
        true if has(&"roslaunch ") => "rosrescue core\n",
        true => "rosrescue core\nroslaunch --wait my_robot.launch\n",
    }
}

/// Runs the commands of `document`. Panics with the output of a section that fails.
fn run(document: &str) {
    for (_, section) in sections(document) {
        let before = before(&section);
        run_on_a_computer(&format!(". tests/support/documents.sh\n{before}{section}"));
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
        .args(["timeout", "--kill-after=5", "900", "bash", "-euc", script])
        .env("REPOSITORY", ROOT)
        .env("ROSRESCUE", env!("CARGO_BIN_EXE_rosrescue"))
        // As for all other tests: on a busy computer any master is late from time to time.
        .env("ROSRESCUE_STAND_IN_AFTER", "5000")
        .env(
            "QUICK_ROSVERSION",
            Path::new(env!("CARGO_TARGET_TMPDIR")).with_file_name("quick-rosversion"),
        )
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

/// The quickstart is in the recording below. The other commands are in the straight path of the guide, in this order.
#[test]
fn other_tests_run_the_commands_of_the_readme() {
    let mut guide = sections("ROS_MASTER_URI.md");
    guide.retain(|(heading, _)| heading == "The straight path");
    let readme = sections("README.md");
    let commands = |(_, section): &(String, String)| -> Vec<_> {
        let lines = section.lines().filter(|line| !line.starts_with(WHERE));
        let commands = lines.map(|line| line.split(" #").next().unwrap().trim().to_owned());
        commands.collect()
    };
    let mut path = guide.iter().flat_map(commands);
    let mut others: Vec<_> = readme.iter().flat_map(commands).collect();
    others.retain(|command| command != "examples/quickstart.sh");
    assert!(others.len() > 1, "{readme:?}");
    for command in others {
        let is_there = path.any(|found| found == command);
        assert!(is_there, "{command} is not in this order in {guide:?}");
    }
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
    // A talker that gets no processor during the rescue sends nothing, so the line has no first and last message.
    let texts = texts.map(|text| match text.contains("meanwhile the listener heard") {
        true => text.split_once(" messages").unwrap().0,
        false => text,
    });
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
    let script = fs::read_to_string(Path::new(ROOT).join("examples/record.sh")).unwrap();
    assert!(script.contains("examples/quickstart.sh"), "{script}");
    let ours = fs::read_to_string(Path::new(ROOT).join("docs/rescue.svg")).unwrap();
    let made = run_on_a_computer(". tests/support/documents.sh\nexamples/record.sh");
    assert!(lines(&made).len() > 10, "{made}");
    assert_eq!(
        lines(&ours),
        lines(&made),
        "the picture is out of date; to make it again: examples/record.sh >docs/rescue.svg"
    );
}
