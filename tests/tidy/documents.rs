//! Checks documents against the program, and the names in them.

use std::{collections::BTreeSet, fs, process::Command};

use super::{blocks::documents, commands::quoted, read, root, rust_files, source_folders, sources};

/// The output of `rosrescue ARGUMENTS` at a width of 100, without settings of this computer.
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

/// The block of `text` fenced with `first` as its first line, without that line.
fn block<'a>(text: &'a str, first: &str) -> &'a str {
    let start = format!("```\n{first}\n");
    let (_, rest) = text
        .split_once(&start)
        .unwrap_or_else(|| panic!("no block `{first}`"));
    rest.split_once("\n```\n").expect("the block ends").0
}

/// The commands that `rosrescue --help` lists.
fn commands() -> Vec<String> {
    let help = printed(&["--help"]);
    let (_, list) = help.split_once("\nCommands:\n").unwrap();
    let list = list.split("\n\n").next().unwrap();
    let names = list.lines().filter_map(|line| {
        let name = line.strip_prefix("  ")?;
        let is_name = name.starts_with(|c: char| c.is_ascii_lowercase());
        is_name.then(|| name.split_whitespace().next())?
    });
    let names: Vec<_> = names.map(str::to_owned).collect();
    assert!(names.len() > 5, "{names:?}");
    names
}

#[test]
fn the_documents_have_the_help_as_the_program_prints_it() {
    let document = read("docs/cli.md");
    for command in commands() {
        assert_eq!(
            block(&document, &format!("$ rosrescue {command} --help")),
            printed(&[&command, "--help"]),
            "put this help of `rosrescue {command}` into docs/cli.md"
        );
    }
}

/// `packaging/build-book.sh` adds the decisions to the book.
#[test]
fn every_document_is_in_the_table_of_contents() {
    let contents = read("docs/SUMMARY.md");
    for document in documents() {
        let path = document.strip_prefix(root()).unwrap();
        let is_decision = path.starts_with("docs/decisions") && !path.ends_with("README.md");
        if is_decision || path.ends_with("SUMMARY.md") {
            continue;
        }
        let path = path.strip_prefix("docs").map_or_else(
            |_| format!("](../{})", path.display()),
            |path| format!("]({})", path.display()),
        );
        assert!(contents.contains(&path), "docs/SUMMARY.md lacks {path}");
    }
}

/// `tests/robot/documents.rs` compares the lines of the recording with those of a new one.
#[test]
fn numbers_of_the_documents_are_those_of_the_benchmarks() {
    let check = Command::new("/usr/bin/python3")
        .args(["benches/summary.py", "--check"])
        .current_dir(root())
        .output()
        .unwrap();
    let why = String::from_utf8_lossy(&check.stderr);
    assert!(check.status.success(), "{why}; run benches/summary.py");
}

#[test]
fn the_recording_is_small_and_needs_nothing_else() {
    let picture = read("docs/rescue.svg");
    assert!(picture.len() < 40 << 10, "{} bytes", picture.len());
    let linked = picture.replace("xmlns=\"http://www.w3.org/2000/svg\"", "");
    for foreign in ["href", "url(", "@import", "<script", "src="] {
        assert!(!linked.contains(foreign), "docs/rescue.svg has {foreign}");
    }
    assert!(picture.contains("prefers-color-scheme: dark"));
}

#[test]
fn the_documents_name_the_rust_that_is_needed() {
    let manifest = read("Cargo.toml");
    let (_, rest) = manifest.split_once("\nrust-version = \"").unwrap();
    let needed = rest.split_once('"').unwrap().0;
    for document in ["README.md", "CONTRIBUTING.md"] {
        let text = read(document);
        let named: Vec<_> = text
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
        assert!(!named.is_empty(), "{document} names no version of Rust");
        assert!(
            named.iter().all(|version| *version == needed),
            "{document}: {named:?} are not {needed}"
        );
    }
}

#[test]
fn there_is_a_reason_for_every_dependency_and_for_no_other() {
    let manifest = read("Cargo.toml");
    let document = read("CONTRIBUTING.md");
    let mut listed = false;
    let mut names = BTreeSet::new();
    for line in manifest.lines() {
        if line.starts_with('[') {
            listed = line == "[workspace.dependencies]";
        } else if listed
            && let Some((name, of)) = line.split_once(" = ")
            && !of.contains("path = ")
        {
            assert!(
                document.contains(&format!("\n| `{name}`")),
                "no reason for `{name}` in CONTRIBUTING.md"
            );
            names.insert(name);
        }
    }
    assert!(
        names.len() > 10,
        "the manifest is not read as it is written"
    );
    let (_, table) = document.split_once("\n| crate | for |\n").unwrap();
    for row in table.lines().filter_map(|line| line.strip_prefix("| `")) {
        let name = row.split('`').next().unwrap();
        assert!(names.contains(name), "`{name}` is no dependency any more");
    }
}

/// The anchors of a document's headings, made from their text.
fn anchors(text: &str) -> BTreeSet<String> {
    let mut fenced = false;
    let mut anchors = BTreeSet::new();
    for line in text.lines() {
        fenced ^= line.starts_with("```");
        if !fenced && line.starts_with('#') {
            let heading = line.trim_start_matches('#').trim().to_lowercase();
            let letters = heading.chars().filter_map(|letter| match letter {
                ' ' => Some('-'),
                letter if letter.is_alphanumeric() || "-_".contains(letter) => Some(letter),
                _ => None,
            });
            anchors.insert(letters.collect());
        }
    }
    anchors
}

#[test]
fn links_in_documents_are_not_broken() {
    let mut links = 0;
    for document in documents() {
        let text = read(&document);
        for link in text.split("](").skip(1) {
            let link = link.split(')').next().unwrap();
            if link.starts_with("https://") {
                continue;
            }
            let (target, anchor) = link.split_once('#').unwrap_or((link, ""));
            let path = match target {
                "" => document.clone(),
                _ => document.parent().unwrap().join(target),
            };
            assert!(path.exists(), "{} links to {link}", document.display());
            assert!(
                [".md", ".png", ".svg"]
                    .iter()
                    .any(|end| target.is_empty() || target.ends_with(end)),
                "{} links to {link}, which is not in the book: name it in backticks",
                document.display()
            );
            assert!(
                anchor.is_empty() || anchors(&read(&path)).contains(anchor),
                "{} links to {link}, which has no such heading",
                document.display()
            );
            links += 1;
        }
    }
    assert!(links > 50);
}

/// Comments name documents by their path from the top of the repository.
#[test]
fn documents_that_the_source_names_exist() {
    for file in sources() {
        for name in read(&file).split("`docs/").skip(1) {
            let name = format!("docs/{}", name.split('`').next().unwrap());
            assert!(
                root().join(&name).exists(),
                "{} names {name}",
                file.display()
            );
        }
    }
}

/// A file that is renamed leaves its name behind in documents.
#[test]
fn files_and_functions_that_documents_name_exist() {
    let sources: Vec<_> = sources().iter().map(read).collect();
    let is_in_source = |text: &str| sources.iter().any(|source| source.contains(text));
    let (mut files, mut functions) = (0, 0);
    for document in documents() {
        let text = read(&document);
        for name in quoted(&text) {
            let is_path = name.ends_with(".rs") && !name.contains([' ', '*']);
            if is_path {
                let mut places = ["", "tests"].map(|place| root().join(place)).to_vec();
                places.extend(source_folders());
                let exists = places.iter().any(|place| place.join(name).exists());
                assert!(exists, "{} names the file {name}", document.display());
                files += 1;
            }
            let path = name.split('(').next().unwrap();
            let is_item = |c: char| c.is_ascii_alphanumeric() || "_:".contains(c);
            if path.contains("::") && path.chars().all(is_item) {
                let item = path.rsplit("::").next().unwrap();
                let is_function = item.starts_with(|c: char| c.is_ascii_lowercase());
                let exists = match is_function {
                    true => ["(", "<"]
                        .iter()
                        .any(|end| is_in_source(&format!("fn {item}{end}"))),
                    false => is_in_source(item),
                };
                assert!(exists, "{} names {name}", document.display());
                functions += 1;
            }
        }
    }
    assert!(files > 10 && functions > 30, "{files}, {functions}");
}

/// A function that is moved leaves its old file in the table.
#[test]
fn functions_in_the_table_of_decisions_are_in_its_files() {
    let text = read(root().join("docs/architecture.md"));
    let (_, table) = text.split_once("## Where it is decided").unwrap();
    let table = table.split("\n## ").next().unwrap();
    let mut functions = 0;
    for row in table.lines().filter(|line| line.starts_with("| ")).skip(1) {
        let columns: Vec<_> = row.split('|').collect();
        let files: Vec<_> = quoted(columns[4])
            .map(|file| read(root().join(file)))
            .collect();
        assert!(!files.is_empty(), "no file: {row}");
        for name in quoted(columns[2]).filter(|name| name.contains("::")) {
            let item = format!("fn {}", name.rsplit("::").next().unwrap());
            let is_there = files.iter().any(|file| {
                ["(", "<"]
                    .iter()
                    .any(|end| file.contains(&format!("{item}{end}")))
            });
            assert!(is_there, "{name} is in none of the files: {row}");
            functions += 1;
        }
    }
    assert!(functions > 30, "{functions}");
}

#[test]
fn tests_that_the_table_of_decisions_names_exist() {
    let text = read(root().join("docs/architecture.md"));
    let (_, table) = text.split_once("## Where it is decided").unwrap();
    let table = table.split("\n## ").next().unwrap();
    let tests = ["tests", "crates"].map(|folder| rust_files(&root().join(folder)));
    let tests = tests.into_iter().flatten();
    let sources: Vec<_> = sources().into_iter().chain(tests).map(read).collect();
    let mut tests = 0;
    for row in table.lines().filter(|line| line.starts_with("| ")) {
        let column = row.split('|').nth(3).unwrap();
        for name in quoted(column) {
            let declared = format!("fn {name}(");
            let exists = sources.iter().any(|source| source.contains(&declared));
            assert!(exists, "docs/architecture.md names the test {name}");
            tests += 1;
        }
    }
    assert!(tests > 10, "{tests}");
}

#[test]
fn the_map_has_every_crate_and_every_folder_of_the_source() {
    let text = read("docs/architecture.md");
    let (_, map) = text.split_once("\n## Crates and modules\n").unwrap();
    let named: BTreeSet<_> = quoted(map.split("\n## ").next().unwrap()).collect();
    let mut folders = 0;
    for (folder, before) in [("crates", "crates/"), ("src", "")] {
        for entry in fs::read_dir(root().join(folder)).unwrap() {
            let entry = entry.unwrap();
            if entry.file_type().unwrap().is_dir() {
                let name = format!("{before}{}", entry.file_name().into_string().unwrap());
                assert!(
                    named.contains(&*name),
                    "docs/architecture.md lacks `{name}`"
                );
                folders += 1;
            }
        }
    }
    assert!(folders > 15, "{folders}");
}

#[test]
fn the_document_has_the_states_of_the_gate() {
    let source = read("src/gate.rs");
    let (_, states) = source.split_once("enum State {\n").unwrap();
    let states = states.split("\n}").next().unwrap().lines();
    let states = states.filter_map(|line| line.strip_prefix("    "));
    let states = states.filter(|line| line.starts_with(|c: char| c.is_ascii_uppercase()));
    let states: Vec<_> = states
        .map(|line| line.split(|c: char| !c.is_alphanumeric()).next().unwrap())
        .collect();
    assert!(states.len() > 3, "{states:?}");
    let text = read("docs/architecture.md");
    let (_, table) = text.split_once("\n| state | reads | writes |\n").unwrap();
    let rows = table.split("\n\n").next().unwrap().lines().skip(1);
    let rows: Vec<_> = rows.map(|row| row.split('`').nth(1).unwrap()).collect();
    assert_eq!(rows, states, "the states in docs/architecture.md");
}

#[test]
fn every_decision_is_numbered_dated_and_in_the_index() {
    let folder = root().join("docs/decisions");
    let index = read(folder.join("README.md"));
    let names = fs::read_dir(&folder).unwrap();
    let names = names.map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let mut names: Vec<_> = names.filter(|name| name != "README.md").collect();
    names.sort();
    assert!(!names.is_empty());
    let mut last = 0;
    for name in &names {
        let number: u32 = name.split('-').next().unwrap().parse().unwrap();
        assert!(
            number > last && name.starts_with(&format!("{number:04}-")),
            "{name} has no number of its own"
        );
        last = number;
        let text = read(folder.join(name));
        let title = text.lines().next().unwrap();
        let title = title.strip_prefix(&format!("# {number}. "));
        let title = title.unwrap_or_else(|| panic!("the title of {name} has another number"));
        let (_, date) = text.split_once("\nDate: ").expect("a date");
        let row = format!("| [{number}]({name}) | {title} | {} |", &date[..10]);
        assert!(index.contains(&row), "the index lacks: {row}");
        for section in ["Context", "Decision", "Consequences", "Alternatives"] {
            assert!(
                text.contains(&format!("\n## {section}\n")),
                "{name} lacks {section}"
            );
        }
    }
}
