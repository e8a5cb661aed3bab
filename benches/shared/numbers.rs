//! Formats numbers, and writes them into documents.

use std::{fs, path::Path, time::Duration};

const DOCUMENT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/benches/results.md");

/// The time below which this share of `sorted` lies, in milliseconds.
pub(crate) fn at(sorted: &[Duration], share: f64) -> f64 {
    let place = (sorted.len() as f64 * share) as usize;
    let time = sorted.get(place.min(sorted.len().saturating_sub(1)));
    time.map_or(f64::NAN, |time| time.as_secs_f64() * 1e3)
}

/// Median and maximum.
pub(crate) fn spread(numbers: &[f64]) -> (f64, f64) {
    let mut sorted = numbers.to_vec();
    sorted.sort_by(f64::total_cmp);
    let largest = sorted.last().copied().unwrap_or(f64::NAN);
    let median = sorted.get(sorted.len() / 2).copied();
    (median.unwrap_or(f64::NAN), largest)
}

/// Formats a number with three significant digits.
pub(crate) fn short(number: f64) -> String {
    match number {
        0.0..1.0 => format!("{number:.2}"),
        1.0..100.0 => format!("{number:.1}"),
        _ => format!("{number:.0}"),
    }
}

/// Writes a file and prints its name.
pub(crate) fn write(path: &Path, text: &str) {
    fs::write(path, text).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    eprintln!("written: {}", path.display());
}

/// Writes `text` into `benches/results.md`, between the marks of this bench.
pub(crate) fn write_document(bench: &str, text: &str) {
    let document = fs::read_to_string(DOCUMENT).expect("the document");
    let document = between_marks(&document, bench, text).expect("marks for the tables");
    write(Path::new(DOCUMENT), &document);
}

fn between_marks(document: &str, bench: &str, text: &str) -> Option<String> {
    let [begin, end] = ["begin", "end"].map(|mark| format!("<!-- {bench}:{mark} -->"));
    let (before, rest) = document.split_once(&begin)?;
    let (_, after) = rest.split_once(&end)?;
    Some(format!("{before}{begin}\n{text}\n{end}{after}"))
}
