//! Checks that `docs/operations.md` has every warning and error of the log, that `docs/monitoring.md` has every metric,
//! and that neither has others.

use super::{code, read, sources};

/// The arguments of each `name(…)` in `code`.
fn arguments<'a>(code: &'a str, name: &str) -> Vec<&'a str> {
    let name = format!("{name}(");
    let calls = code.match_indices(&name).map(|(at, found)| {
        let rest = &code[at + found.len()..];
        let (mut depth, mut quoted, mut escaped) = (1, false, false);
        let end = rest.find(|c: char| {
            match c {
                _ if escaped => escaped = false,
                '\\' => escaped = quoted,
                '"' => quoted = !quoted,
                '(' if !quoted => depth += 1,
                ')' if !quoted => depth -= 1,
                _ => {}
            }
            depth == 0
        });
        &rest[..end.expect("the call ends")]
    });
    calls.collect()
}

/// The last text among `arguments`, in one line. `None` if there is no text.
fn text(arguments: &str) -> Option<String> {
    let (before, _) = arguments.rsplit_once('"')?;
    let (_, rest) = before.rsplit_once('"')?;
    let lines: Vec<_> = rest.split("\\\n").map(str::trim_start).collect();
    Some(lines.concat())
}

/// The messages of warnings and errors in the source.
fn messages() -> Vec<String> {
    let mut messages = Vec::new();
    for file in sources() {
        let Some(code) = code(&file) else { continue };
        let limited = ["rarely!", "alarm!", "all_clear!"];
        let always = ["tracing::warn!", "tracing::error!", "log_once"];
        for name in limited.into_iter().chain(always) {
            for arguments in arguments(&code, name) {
                let level = arguments.trim_start();
                if limited.contains(&name)
                    && !level.starts_with("warn")
                    && !level.starts_with("error")
                {
                    continue;
                }
                messages.extend(text(arguments));
            }
        }
    }
    // `log_once` gets its message from its caller, and the macro is only a definition.
    messages.retain(|message| message != "{text}" && !message.starts_with('$'));
    messages
}

/// The beginning of a message, without values and without the explanation that follows.
fn beginning(message: &str) -> &str {
    let ends = ["{", "; ", ". ", ": nodes keep", "…"];
    let end = ends.iter().filter_map(|end| message.find(end)).min();
    &message[..end.unwrap_or(message.len())]
}

#[test]
fn the_document_has_every_warning_and_error_of_the_log() {
    let document = read("docs/operations.md");
    let (_, table) = document
        .split_once("\n### Lines that ask for something\n")
        .unwrap();
    let table = table.split("\n## ").next().unwrap();
    let messages = messages();
    assert!(
        messages.len() > 30,
        "the source is not read as it is written"
    );
    let missing: Vec<_> = messages
        .iter()
        .map(|message| beginning(message))
        .filter(|said| said.len() < 8 || !table.contains(&format!("| `{said}")))
        .collect();
    assert!(
        missing.is_empty(),
        "docs/operations.md lacks a row for each of {missing:#?}"
    );
    let rows = table.lines().filter_map(|line| line.strip_prefix("| `"));
    for row in rows {
        let said = beginning(row.split('`').next().unwrap());
        assert!(
            messages.iter().any(|message| message.starts_with(said)),
            "nothing says `{said}` any more"
        );
    }
}

#[test]
fn the_document_has_every_metric() {
    let document = read("docs/monitoring.md");
    let (_, tables) = document.split_once("\n## Metrics\n").unwrap();
    let tables = tables.split("\n## ").next().unwrap();
    let metrics = read("src/status/metrics.rs") + &read("src/process/usage.rs");
    let mut names: Vec<String> = metrics
        .lines()
        .filter_map(|line| line.trim_start().strip_prefix("(\""))
        .map(|line| line.split('"').next().unwrap().to_owned())
        .collect();
    assert!(
        names.len() > 15,
        "the gauges are not read as they are written"
    );
    let counters = read("src/status/stats.rs");
    let (_, counters) = counters.split_once("\ncounters! {\n").unwrap();
    let meanings = counters.lines().filter_map(|line| line.split_once(" = \""));
    for (name, meaning) in meanings {
        let name = format!("{}_total", name.trim());
        let meaning = meaning
            .trim_end_matches("\",")
            .split(", see")
            .next()
            .unwrap();
        assert!(
            tables.contains(&format!("| `{name}` | {meaning}")),
            "docs/monitoring.md lacks: | `{name}` | {meaning} |"
        );
        names.push(name);
    }
    for name in &names {
        assert!(
            tables.contains(&format!("`{name}`")),
            "docs/monitoring.md lacks `{name}`"
        );
    }
    let cells = tables
        .lines()
        .filter_map(|line| line.strip_prefix("| ")?.split(" | ").next());
    let named = cells.flat_map(|cell| cell.split('`').skip(1).step_by(2));
    for name in named {
        let labelled = [
            "build_info{",
            "call_duration_seconds{",
            "condition{",
            "cluster_role{",
            "node_since_seconds{",
        ];
        let is_labelled = labelled.iter().any(|with| name.starts_with(with));
        let known = names.iter().any(|known| known == name) || is_labelled;
        assert!(known, "there is no metric `{name}`");
    }
}
