//! Checks that types have unique names, few fields and one place, and that the map has every crate and folder.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
};

use super::{code, read, root, sources};

/// Highest percentage of visible types that share their name with another one.
const SHARED_PERCENT_MOST: usize = 5;
const FIELDS_MOST: usize = 20;
/// Types with too many fields, and their numbers of fields. No other type may be added, and none may grow.
const LARGE: [(&str, usize); 4] = [
    // Options of the command line and the configuration made from them: each option is a field.
    ("CommonArgs", 23),
    ("Config", 23),
    // Facts that people and programs read, as flat JSON.
    ("SetupFacts", 25),
    ("Status", 40),
];
const IMPL_FILES_MOST: usize = 3;
/// Types with `impl` blocks in too many files, and the numbers of files.
const SPREAD: [(&str, usize); 1] = [
    // One file for each part of the Master API.
    ("Master", 7),
];

/// Each source file's crate, or its folder within `src`, and its code.
fn codes() -> Vec<(String, String)> {
    let files = sources().into_iter();
    let codes = files.filter_map(|file| {
        let relative = file.strip_prefix(root()).unwrap();
        let of = match relative.strip_prefix("crates") {
            Ok(inside) => inside.iter().next().unwrap().to_str().unwrap(),
            Err(_) => relative.iter().nth(1).unwrap().to_str().unwrap(),
        };
        let of = of.trim_end_matches(".rs");
        Some((of.to_owned(), code(&file)?))
    });
    codes.collect()
}

/// The name that a line declares after one of `keywords`, and what follows it.
fn declared<'a>(line: &'a str, keywords: &[&str]) -> Option<(&'a str, &'a str)> {
    let rest = keywords.iter().find_map(|word| line.strip_prefix(word))?;
    let end = rest.find(|c: char| !c.is_alphanumeric() && c != '_');
    Some(rest.split_at(end.unwrap_or(rest.len())))
}

/// A line without its visibility. `None` if it has none.
fn visible(line: &str) -> Option<&str> {
    let rest = line.strip_prefix("pub")?;
    match rest.strip_prefix('(') {
        Some(inside) => Some(inside.split_once(')')?.1.trim_start()),
        None => rest.strip_prefix(' '),
    }
}

#[test]
fn few_types_share_their_name() {
    let mut names: BTreeMap<String, usize> = BTreeMap::new();
    for (_, code) in codes() {
        let keywords = ["struct ", "enum ", "trait ", "type "];
        // A type that is declared twice in one file is one type, with and without a feature.
        let lines = code.lines().filter_map(visible);
        let here: BTreeSet<_> = lines.filter_map(|line| declared(line, &keywords)).collect();
        for (name, _) in here {
            *names.entry(name.to_owned()).or_default() += 1;
        }
    }
    let all: usize = names.values().sum();
    let shared: Vec<_> = names.iter().filter(|(_, count)| **count > 1).collect();
    let types: usize = shared.iter().map(|(_, count)| **count).sum();
    println!("{types} of {all} types share a name: {shared:?}");
    assert!(all > 300, "the source is not read as it is written");
    assert!(
        types * 100 <= all * SHARED_PERCENT_MOST,
        "{types} of {all} types have a name that another one has: {shared:?}"
    );
}

#[test]
fn types_have_few_fields_and_one_place() {
    let mut large = BTreeMap::new();
    let mut places: BTreeMap<(String, String), usize> = BTreeMap::new();
    for (of, code) in codes() {
        let mut fields: Option<(&str, usize)> = None;
        let mut implemented = BTreeSet::new();
        for line in code.lines() {
            if let Some((name, rest)) = declared(visible(line).unwrap_or(line), &["struct "]) {
                fields = rest.ends_with('{').then_some((name, 0));
            } else if line == "}" {
                if let Some((name, count)) = fields.take()
                    && count > FIELDS_MOST
                {
                    large.insert(name.to_owned(), count);
                }
            } else if let Some((_, count)) = &mut fields {
                let is_field = line.starts_with("    ") && !line.starts_with("     ");
                *count += usize::from(is_field && line.contains(": "));
            }
            // An `impl` of a trait may be wherever the trait is used.
            let inherent = line.starts_with("impl") && !line.contains(" for ");
            if inherent && line.ends_with('{') {
                let generic = line
                    .strip_prefix("impl<")
                    .and_then(|rest| rest.split_once("> "));
                let of = generic.map_or_else(|| line.trim_start_matches("impl "), |(_, rest)| rest);
                let name = declared(of, &[""]);
                implemented.extend(name.map(|(name, _)| name.to_owned()));
            }
        }
        for name in implemented {
            *places.entry((of.clone(), name)).or_default() += 1;
        }
    }
    places.retain(|_, files| *files > IMPL_FILES_MOST);
    let spread: BTreeMap<_, _> = places
        .into_iter()
        .map(|((_, name), of)| (name, of))
        .collect();
    for (found, listed, what) in [
        (large, &LARGE[..], "fields"),
        (spread, &SPREAD[..], "files"),
    ] {
        for (name, count) in found {
            let most = listed.iter().find(|(listed, _)| *listed == name);
            assert!(
                most.is_some_and(|(_, most)| count <= *most),
                "{name} has {count} {what}: split it by responsibility"
            );
        }
    }
}

#[test]
fn the_map_has_every_crate_and_folder() {
    let map = read("docs/architecture.md");
    let mut missing = Vec::new();
    for folder in ["src", "crates"] {
        for entry in fs::read_dir(root().join(folder)).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_str().unwrap();
            let named = [format!("`{name}"), format!("{folder}/{name}")];
            if path.is_dir() && !named.iter().any(|named| map.contains(named.as_str())) {
                missing.push(format!("{folder}/{name}"));
            }
        }
    }
    assert!(missing.is_empty(), "docs/architecture.md lacks {missing:?}");
}
