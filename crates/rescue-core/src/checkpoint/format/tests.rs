//! Damage to a file of realistic size, examined before its YAML is read.

use super::*;
use ros1_master::{master::Method, xmlrpc::Value};

/// A file of at least 64 KiB with more than 500 records, and where each of its lines starts.
fn file() -> (Vec<u8>, Vec<usize>) {
    let encoded = encode_checkpoint(&Checkpoint::default(), 1).unwrap();
    let mut bytes = encoded.bytes;
    let mut starts = vec![bytes.len()];
    for seq in 1..=600 {
        let text = "some text of a parameter that is not too long ".repeat(1 + seq % 2);
        let params = vec![
            "/node".into(),
            format!("/ns/p{seq}").into(),
            Value::String(text),
        ];
        let record = Record {
            seq: seq as u64,
            entry: RecordContent::call(Request::new(Method::SetParam, params)),
        };
        bytes.extend(encode_record(&record, encoded.stamp).unwrap());
        starts.push(bytes.len());
    }
    assert!(bytes.len() >= 64 * 1024);
    (bytes, starts)
}

/// A debug build tries only every 31st place, to save time. 31 and 251 are prime, so every position in a line and in a
/// byte is tried.
const CUT_STEP: usize = if cfg!(debug_assertions) { 31 } else { 1 };
/// A debug build flips only every 251st bit; see [`CUT_STEP`].
const FLIP_STEP: usize = if cfg!(debug_assertions) { 251 } else { 16 };

#[test]
fn a_large_file_cut_at_every_byte_has_the_records_before_the_cut() {
    let (bytes, starts) = file();
    for cut in (starts[0]..bytes.len()).step_by(CUT_STEP) {
        let framed = scan(&bytes[..cut]).unwrap();
        let whole = starts.partition_point(|end| *end <= cut + 1) - 1;
        assert_eq!(framed.lines.len(), whole, "byte {cut}");
        assert!(
            framed
                .lines
                .iter()
                .zip(1..)
                .all(|(line, seq)| line.seq == seq)
        );
        assert!(framed.damaged.is_empty() && !framed.end_lost);
    }
}

fn assert_flips_noticed(step: usize) {
    let (mut bytes, starts) = file();
    for place in (0..bytes.len() * 8).step_by(step) {
        let (at, bit) = (place / 8, 1 << (place % 8));
        bytes[at] ^= bit;
        let framed = scan(&bytes).unwrap();
        let lost = 600 - framed.lines.len();
        if at < starts[0] {
            assert!(framed.checkpoint().is_err() && lost == 0, "place {place}");
        } else {
            assert!((1..=2).contains(&lost), "place {place}");
            assert!(
                framed.torn.is_some() || !framed.damaged.is_empty(),
                "place {place}"
            );
        }
        bytes[at] ^= bit;
    }
}

/// Flips every [`FLIP_STEP`]th bit; all bits with `ROSRESCUE_FLIP_STEP=1 cargo test --release flipped`.
#[test]
fn every_flipped_bit_in_a_large_file_is_noticed() {
    let step = std::env::var("ROSRESCUE_FLIP_STEP").map(|step| step.parse().unwrap());
    assert_flips_noticed(step.unwrap_or(FLIP_STEP));
}

/// The check sums are valid, but the numbers are the highest possible ones.
#[test]
fn numbers_too_high_to_continue_counting_are_damage() {
    let checkpoint = |seq| Checkpoint {
        seq,
        ..Checkpoint::default()
    };
    let most = u64::MAX / 2;
    let header = |seq, generation| {
        let bytes = encode_checkpoint(&checkpoint(seq), generation)
            .unwrap()
            .bytes;
        decode(&bytes).unwrap().checkpoint
    };
    assert_eq!(header(most, most), Ok(checkpoint(most)));
    assert_eq!(header(most, most + 1), Err(SnapshotError::Header));
    assert_eq!(header(u64::MAX, 1), Err(SnapshotError::Header));
    let encoded = encode_checkpoint(&checkpoint(0), 1).unwrap();
    for (seq, whole) in [(most, true), (most + 1, false), (u64::MAX, false)] {
        let entry = RecordContent::Session(Box::default());
        let line = encode_record(&Record { seq, entry }, encoded.stamp).unwrap();
        let decoded = decode(&[encoded.bytes.as_slice(), &line].concat()).unwrap();
        assert_eq!(
            (decoded.records.len() == 1, decoded.damaged.is_empty()),
            (whole, whole)
        );
    }
}
