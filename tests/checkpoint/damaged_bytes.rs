//! Reading a damaged checkpoint returns what was written, or less, but never anything else.

use std::path::{Path, PathBuf};

use rescue_core::checkpoint::format::{
    Announced, Checkpoint, Decoded, FormatError, Label, Origin, PendingWrite, Record,
    RecordContent, Session, SnapshotError, Stamp, decode, encode_checkpoint, encode_record,
};
use ros1_master::{
    master::{Method, OrderedMap, Request, Snapshot, SnapshotNode},
    xmlrpc::{Struct, Value},
};

fn checkpoint(seq: u64) -> Checkpoint {
    Checkpoint {
        seq,
        session: Session {
            id: "run".to_owned(),
            boot_id: "boot".to_owned(),
            ..Session::default()
        },
        snapshot: Snapshot {
            nodes: OrderedMap::from([(
                "/talker".to_owned(),
                SnapshotNode {
                    api: "http://robot:40001/".to_owned(),
                    ..SnapshotNode::default()
                },
            )]),
            publishers: OrderedMap::from([("/chatter".to_owned(), vec!["/talker".to_owned()])]),
            params: Struct::from([("rate".to_owned(), Value::Double(10.0))]),
            ..Snapshot::default()
        },
        pending: Vec::new(),
        displaced: Vec::new(),
        follows: false,
    }
}

fn record(seq: u64) -> Record {
    let params = [
        "/n".into(),
        format!("/p{seq}").into(),
        Value::Double(seq as f64),
    ];
    Record {
        seq,
        entry: RecordContent::call(Request::new(Method::SetParam, params)),
    }
}

/// A checkpoint as of record 7, followed by `count` records. Also returns the position of each line and the stamp.
fn file(count: u64, generation: u64) -> (Vec<u8>, Vec<usize>, Stamp) {
    let encoded = encode_checkpoint(&checkpoint(7), generation).unwrap();
    let mut bytes = encoded.bytes;
    let mut starts = vec![bytes.len()];
    for seq in 8..8 + count {
        bytes.extend(encode_record(&record(seq), encoded.stamp).unwrap());
        starts.push(bytes.len());
    }
    (bytes, starts, encoded.stamp)
}

/// Checks that all that was read had been written. Returns whether everything was read and no damage was found.
fn is_untouched(decoded: &Decoded, count: u64) -> bool {
    if let Ok(found) = &decoded.checkpoint {
        assert_eq!(*found, checkpoint(7));
    }
    for found in &decoded.records {
        assert_eq!(*found, record(found.seq));
        assert!((8..8 + count).contains(&found.seq));
    }
    assert!(decoded.records.is_sorted_by(|a, b| a.seq < b.seq));
    decoded.checkpoint.is_ok()
        && decoded.records.len() as u64 == count
        && decoded.torn.is_none()
        && decoded.damaged.is_empty()
}

#[test]
fn an_undamaged_file_is_read_completely() {
    let (bytes, _, _) = file(3, 2);
    let decoded = decode(&bytes).unwrap();
    assert!(is_untouched(&decoded, 3));
    assert_eq!(decoded.generation, 2);
}

#[test]
fn every_flipped_bit_is_noticed() {
    let (bytes, starts, _) = file(6, 2);
    let mut flipped = bytes.clone();
    for at in 0..bytes.len() {
        for bit in 0..8 {
            flipped[at] ^= 1 << bit;
            let decoded = decode(&flipped).unwrap_or_else(|error| panic!("byte {at}: {error}"));
            assert!(
                !is_untouched(&decoded, 6),
                "the flip of bit {bit} in byte {at} went unnoticed"
            );
            // One bit costs the snapshot, or one record, or two if they become one line.
            if at < starts[0] {
                assert!(decoded.checkpoint.is_err(), "bit {bit} of byte {at}");
                assert_eq!(decoded.records.len(), 6, "bit {bit} of byte {at}");
            } else {
                assert!(decoded.checkpoint.is_ok());
                assert!(decoded.records.len() >= 4, "bit {bit} of byte {at}");
            }
            flipped[at] ^= 1 << bit;
        }
    }
    println!("{} bits flipped", bytes.len() * 8);
}

#[test]
fn a_zeroed_sector_costs_only_the_records_in_it() {
    let (bytes, starts, _) = file(200, 2);
    for sector in (0..bytes.len()).step_by(512) {
        let end = bytes.len().min(sector + 512);
        let mut zeroed = bytes.clone();
        zeroed[sector..end].fill(0);
        let decoded = decode(&zeroed).unwrap();
        assert!(!is_untouched(&decoded, 200));
        let hit = starts
            .windows(2)
            // A line that begins behind the sector has lost the line feed before it.
            .filter(|line| line[0] <= end && sector < line[1])
            .count();
        assert_eq!(decoded.records.len(), 200 - hit, "sector at {sector}");
        // At the end of the file this is an incomplete append; anywhere else it is damage.
        if sector >= starts[0] {
            assert_eq!(
                decoded.torn.is_some(),
                end == bytes.len(),
                "sector at {sector}"
            );
            assert_eq!(
                decoded.damaged.is_empty(),
                end == bytes.len(),
                "sector at {sector}"
            );
        }
    }
}

#[test]
fn records_of_an_earlier_file_are_ignored() {
    let (mut bytes, starts, stamp) = file(3, 2);
    let (old, old_starts, _) = file(9, 1);
    let whole = bytes.len();
    // Undamaged records of an older file, with the numbers that would come next.
    bytes.extend_from_slice(&old[old_starts[3]..]);
    let decoded = decode(&bytes).unwrap();
    assert_eq!(decoded.records.len(), 3);
    assert_eq!(decoded.torn, Some(whole..bytes.len()));
    assert!(decoded.damaged.is_empty());

    // The same records in the middle of the file are damage.
    bytes.extend(encode_record(&record(11), stamp).unwrap());
    let decoded = decode(&bytes).unwrap();
    assert_eq!(decoded.records.len(), 4);
    assert_eq!(decoded.damaged.len(), 6);

    // A record that occurs twice, or is already in the snapshot.
    for seq in [8, 7] {
        let mut bytes = bytes[..starts[1]].to_vec();
        bytes.extend(encode_record(&record(seq), stamp).unwrap());
        bytes.extend(encode_record(&record(9), stamp).unwrap());
        let decoded = decode(&bytes).unwrap();
        assert_eq!(decoded.records, [record(8), record(9)]);
        assert_eq!(decoded.damaged.len(), 1);
    }
}

#[test]
fn any_bytes_are_read_without_a_panic() {
    use proptest::prelude::*;
    let mut runner = proptest::test_runner::TestRunner::new(ProptestConfig::with_cases(2_000));
    let run = runner.run(&proptest::collection::vec(any::<u8>(), 0..400), |bytes| {
        let _ = decode(&bytes);
        Ok(())
    });
    run.unwrap();
}

#[test]
fn files_of_other_programs_are_recognised() {
    for foreign in [
        "use_sim_time: true\n",
        "# my parameters\nrate: 10\n",
        "journal:\n- lunch\n",
        "<launch/>",
        "\u{7f}ELF",
    ] {
        let error = decode(foreign.as_bytes()).unwrap_err();
        assert_eq!(error, FormatError::NotACheckpoint, "{foreign}");
    }
    // Files that a crash of the computer may leave count as checkpoints.
    for ours in [&b""[..], &[0; 4096], b"# rosrescue check"] {
        assert_eq!(
            decode(ours).unwrap().checkpoint.unwrap_err(),
            SnapshotError::Header
        );
    }
}

#[test]
fn another_format_is_recognised() {
    let with_version = |version: u32| {
        let line = format!("# rosrescue checkpoint v{version} whatever=this says header=");
        let crc = crc32c::crc32c(line.as_bytes());
        format!("{line}{crc:08x}\n- other: true\n").into_bytes()
    };
    for version in [1, 3] {
        assert_eq!(
            decode(&with_version(version)).unwrap_err(),
            FormatError::OtherVersion { version }
        );
    }
    // With a wrong check sum it counts as a damaged checkpoint.
    let mut bytes = with_version(3);
    bytes[30] ^= 1;
    assert_eq!(
        decode(&bytes).unwrap().checkpoint.unwrap_err(),
        SnapshotError::Header
    );
}

fn label(origin: Origin) -> Label {
    let at = 1_764_115_200_123;
    Label { at, origin }
}

/// A checkpoint file whose session and records also say which writes the master has not run yet.
fn file_with_pending_writes() -> Vec<u8> {
    let mut checkpoint = checkpoint(7);
    checkpoint.session.incarnation = 2;
    checkpoint.session.delivered = 5;
    let (incarnation, at) = (3, 6);
    checkpoint.session.announced = Some(Announced { incarnation, at });
    let pending = |seq| match record(seq).entry {
        RecordContent::Call { call, .. } => call,
        RecordContent::Session(_) => unreachable!(),
    };
    let write = |seq| PendingWrite {
        seq,
        call: pending(seq),
    };
    checkpoint.pending = vec![write(6), write(7)];
    let encoded = encode_checkpoint(&checkpoint, 1).unwrap();
    let mut session = checkpoint.session;
    session.delivered = 8;
    session.at = label(Origin::Unknown).at;
    let entries = [
        RecordContent::Call {
            call: pending(8),
            pending: true,
            label: label(Origin::At([10, 0, 0, 5].into())),
        },
        RecordContent::Session(session.into()),
        RecordContent::labelled(pending(10), label(Origin::Rosrescue)),
        RecordContent::labelled(pending(11), label(Origin::At([127, 0, 0, 1].into()))),
        RecordContent::labelled(pending(12), label(Origin::Unknown)),
        record(13).entry,
    ];
    let mut bytes = encoded.bytes;
    for (seq, entry) in (8..).zip(entries) {
        bytes.extend(encode_record(&Record { seq, entry }, encoded.stamp).unwrap());
    }
    bytes
}

fn golden(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden");
    folder.join(name)
}

/// Files of this format can still be read, and new files are written in exactly the same way.
#[test]
fn golden_files_are_read_and_written_unchanged() {
    let files = [
        ("checkpoint-v2.yaml", file(2, 1).0, 2),
        ("checkpoint-v2-pending.yaml", file_with_pending_writes(), 6),
    ];
    for (name, bytes, records) in files {
        let path = golden(name);
        if std::env::var_os("BLESS").is_some() {
            std::fs::write(&path, &bytes).unwrap();
        }
        let golden = std::fs::read(path).unwrap();
        let decoded = decode(&golden).unwrap();
        assert!(decoded.damaged.is_empty() && decoded.torn.is_none());
        assert_eq!(
            (decoded.checkpoint.is_ok(), decoded.records.len()),
            (true, records)
        );
        assert_eq!(
            String::from_utf8(bytes).unwrap(),
            String::from_utf8(golden).unwrap()
        );
    }
}
