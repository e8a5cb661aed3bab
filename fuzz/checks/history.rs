//! Checks that must hold for any bytes found as parts of a checkpoint's history.

use checkpoint_store::change_log::decompress;
use rescue_core::{
    checkpoint::change_log::{LogReader, Moment, is_set_back_after, moment, span},
    hide::Hide,
};
use ros1_master::master::Master;

use super::seal::{position, sealed};

/// Separates two files of the history.
const NEXT: &[u8] = b"=== next file ===\n";

/// Decompresses the bytes, and reads them as the files of a history: as they are, and with all check sums corrected.
pub(crate) fn check(bytes: &[u8]) {
    drop(decompress(bytes));
    let mut files = Vec::new();
    let mut rest = bytes;
    while let Some(at) = position(rest, NEXT) {
        files.push(&rest[..at]);
        rest = &rest[at + NEXT.len()..];
    }
    files.push(rest);
    read(files.iter().copied());
    let sealed: Vec<_> = files.into_iter().map(sealed).collect();
    read(sealed.iter().map(Vec::as_slice));
}

/// Panics if reading panics, or if what was read contradicts itself.
fn read<'a>(files: impl Iterator<Item = &'a [u8]>) {
    let mut reader = LogReader::new(Hide::nothing());
    for file in files {
        let is_whole = reader.read(file).is_ok();
        drop(reader.take_entries());
        let Ok(span) = span(file) else {
            assert!(!is_whole, "it was read, and has no times");
            continue;
        };
        let mut last = None;
        for time in [0, span.earliest, span.latest, u64::MAX] {
            let Ok(Some(found)) = moment(file, time) else {
                continue;
            };
            check_moment(&found, time);
            is_set_back_after(file, found.seq, time);
            // A later time shows no fewer records.
            assert!(last.is_none_or(|(before, seq)| before > time || seq <= found.seq));
            last = Some((time, found.seq));
        }
    }
}

fn check_moment(found: &Moment, time: u64) {
    assert!(found.at <= time, "{} is later than {time}", found.at);
    assert!(found.seq >= found.snapshot_seq);
    let mirror = &found.rebuilt.mirror;
    assert_eq!(
        Master::from_snapshot(mirror.snapshot()).as_ref(),
        Ok(mirror)
    );
}
