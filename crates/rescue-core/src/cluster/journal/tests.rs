//! Tests that records and snapshots fit into etcd's limits and are read back as they were written.

use super::*;
use crate::checkpoint::format::{Checkpoint, RecordContent, Session};
use ros1_master::master::{Method, Request};

/// The largest value for one transaction, with room for the keys and the leader's `alive`.
const REQUEST_BYTES: usize = 1_500_000;

fn record(seq: u64, bytes: usize) -> Record {
    let params = ["/n".into(), format!("/p{seq}"), "x".repeat(bytes)];
    let entry = RecordContent::call(Request::new(Method::SetParam, params));
    Record { seq, entry }
}

/// Writes all `records`, as a leader does, and reads them back, as a follower does.
fn through(records: &[Record]) -> (Vec<Record>, usize) {
    let keys = Keys::new("robot");
    let (mut rest, mut progress) = (records, Progress::default());
    progress.seq = records[0].seq - 1;
    let (mut read, mut entries) = (Vec::new(), 0);
    while !rest.is_empty() {
        let batch = pack(&keys, rest).unwrap();
        let entry = batch.entry.unwrap();
        let (key, value) = (entry.key, entry.value);
        assert!(value.len() <= BATCH_BYTES);
        let whole = match Manifest::read(&value) {
            None => value,
            Some(manifest) => {
                let range = keys.parts(&manifest);
                let mut parts = parts(&keys, &rest[0]).unwrap();
                assert_eq!(batch.count, 1);
                assert!(parts.is_sorted_by_key(|part| part.key.clone()));
                assert!(parts.iter().all(|part| range.contains(&part.key)));
                assert!(parts.iter().all(|part| part.value.len() < REQUEST_BYTES));
                let behind = keys.behind(manifest.seq);
                assert!(parts.iter().all(|part| behind[1].contains(&part.key)));
                let parts: Vec<_> = parts.drain(..).map(|part| part.value).collect();
                let whole = manifest.assemble(&keys, &parts).unwrap();
                let lacking = parts.split_last().unwrap().1;
                assert!(matches!(
                    manifest.assemble(&keys, lacking),
                    Err(JournalError::Damaged { .. })
                ));
                whole
            }
        };
        let found = decode_records(&key, &whole).unwrap();
        assert_eq!(keys.seq_of(&key), found.last().map(|record| record.seq));
        read.extend(progress.take(found, whole.len()).unwrap());
        rest = &rest[batch.count..];
        entries += 1;
    }
    (read, entries)
}

#[test]
fn what_is_written_is_read_whatever_its_size() {
    let small: Vec<_> = (7..5007).map(|seq| record(seq, 10)).collect();
    let (read, entries) = through(&small);
    assert_eq!(read, small);
    assert!(entries < 5, "{entries}");
    let sizes = [
        1,
        BATCH_BYTES - 100,
        BATCH_BYTES,
        10,
        BATCH_BYTES / 2,
        BATCH_BYTES / 2,
        20 << 20,
        3,
    ];
    let mixed: Vec<_> = sizes
        .iter()
        .zip(1..)
        .map(|(bytes, seq)| record(seq, *bytes))
        .collect();
    let (read, entries) = through(&mixed);
    assert!(read == mixed && entries < 8, "{entries}");
    let session = Session {
        id: "s".to_owned(),
        ..Session::default()
    };
    let session = Record {
        seq: 1,
        entry: RecordContent::Session(session.into()),
    };
    assert_eq!(through(std::slice::from_ref(&session)).0, [session]);
}

#[test]
fn a_record_that_is_too_large_is_refused_with_a_reason() {
    let keys = Keys::new("robot");
    let error = pack(&keys, &[record(1, RECORD_BYTES_MAX)]).unwrap_err();
    assert!(matches!(error, JournalError::TooLarge { .. }));
    assert!(error.to_string().contains("in parts"), "{error}");
    assert_eq!(check_size(20 << 20), Ok(()));
    assert_eq!(pack(&keys, &[]), Ok(JournalBatch::default()));
}

#[test]
fn what_a_mirror_has_is_left_out_and_what_it_lacks_is_noticed() {
    let mut progress = Progress::after_snapshot(5, 100);
    let numbers =
        |records: Vec<Record>| records.iter().map(|record| record.seq).collect::<Vec<_>>();
    let of = |seqs: Range<u64>| seqs.map(|seq| record(seq, 1)).collect::<Vec<_>>();
    assert_eq!(progress.take(of(4..8), 1).map(numbers), Ok(vec![6, 7]));
    assert_eq!(progress.take(of(4..8), 1).map(numbers), Ok(vec![]));
    let gap = JournalError::Gap {
        expected: 8,
        found: 9,
    };
    assert_eq!(progress.take(of(9..10), 1).map(numbers), Err(gap));
    assert_eq!(progress.seq, 7);
}

#[test]
fn a_snapshot_is_due_when_the_journal_has_outgrown_it() {
    let mut progress = Progress::after_snapshot(0, 3 << 20);
    progress.take(vec![record(1, 1)], 2 << 20).unwrap();
    assert!(!progress.wants_snapshot());
    progress.take(vec![record(2, 1)], 2 << 20).unwrap();
    assert!(progress.wants_snapshot());
    let mut progress = Progress::default();
    for seq in 1..1000 {
        progress.take(vec![record(seq, 1)], 60).unwrap();
    }
    assert!(!progress.wants_snapshot());
    progress.take(vec![record(1000, 1)], 60).unwrap();
    assert!(progress.wants_snapshot());
    // The parts of a large value are in etcd until the next snapshot, although its entry only names them.
    let mut progress = Progress::default();
    progress.take(vec![record(1, 2 << 20)], 0).unwrap();
    assert!(progress.wants_snapshot());
}

#[test]
fn a_snapshot_is_the_checkpoint_in_parts() {
    let keys = Keys::new("/fleet/robot/");
    let state = Checkpoint {
        seq: 9,
        ..Checkpoint::default()
    };
    let bytes = format::encode_checkpoint(&state, 1).unwrap().bytes;
    let (parts, name) = snapshot(&keys, 9, &bytes);
    assert_eq!(name.key, "/fleet/robot/snapshot");
    let manifest = Manifest::read(&name.value).unwrap();
    let range = keys.parts(&manifest);
    assert!(parts.iter().all(|part| range.contains(&part.key)));
    assert!(
        parts
            .iter()
            .all(|part| !keys.snapshots_before(9).contains(&part.key))
    );
    assert!(
        parts
            .iter()
            .all(|part| keys.snapshots_before(10).contains(&part.key))
    );
    let parts: Vec<_> = parts.into_iter().map(|part| part.value).collect();
    let whole = manifest.assemble(&keys, &parts).unwrap();
    assert_eq!(format::decode(&whole).unwrap().checkpoint, Ok(state));
}

/// Seed 30851209: the parts of the first state arrived after those of the second one.
#[test]
fn two_values_with_one_number_share_no_part() {
    let keys = Keys::new("robot");
    let [first, second] = [b"first", b"other"].map(|bytes| snapshot(&keys, 10, bytes));
    let range = keys.parts(&Manifest::read(&second.1.value).unwrap());
    assert!(first.0.iter().all(|part| !range.contains(&part.key)));
    assert!(second.0.iter().all(|part| range.contains(&part.key)));
}

#[test]
fn what_another_program_wrote_is_said_so() {
    for value in [
        "hello",
        "- {seq: 1, call: \"getPid\", params: []} #00000000 12345678\n",
        "- {seq: 1",
    ] {
        let error = decode_records("/robot/journal/1", value.as_bytes()).unwrap_err();
        assert!(error.to_string().contains("/robot/journal/1"), "{error}");
    }
    assert_eq!(Manifest::read(b"blob seq=1 bytes=x crc32c=0\n"), None);
}

#[test]
fn the_journal_after_a_record_is_the_rest() {
    let keys = Keys::new("r");
    let after = keys.journal_after(9);
    assert!(!after.contains(&keys.journal(9)) && after.contains(&keys.journal(10)));
    assert!(after.contains(&keys.journal(u64::MAX)) && !after.contains(&keys.leader()));
    let [journal, _] = keys.behind(9);
    // The last entry stays.
    assert!(journal.contains(&keys.journal(8)) && !journal.contains(&keys.journal(9)));
}

#[test]
fn the_rest_of_the_keys_lacks_only_the_known_journal() {
    let keys = Keys::new("robot");
    let rest = keys.small_after(7);
    let has = |key: &String| rest.iter().any(|range| range.contains(key));
    let others = [
        keys.leader(),
        keys.alive(),
        keys.snapshot(),
        keys.member("a"),
    ];
    assert!(others.iter().all(has));
    assert!((1..8).all(|seq| !has(&keys.journal(seq))));
    assert!([8, 9, u64::MAX].iter().all(|&seq| has(&keys.journal(seq))));
    assert!(rest.iter().all(|range| keys.small().contains(&range.start)));
}

/// A leader must notice deletions by others, and not those of what its snapshot replaces.
#[test]
fn what_a_snapshot_replaces_holds_no_later_record() {
    let keys = Keys::new("robot");
    let held = |key: &str| keys.record_of(key);
    let (blobs, put) = (
        parts(&keys, &record(5, BATCH_BYTES)).unwrap(),
        keys.journal(5),
    );
    assert_eq!((held(&blobs[0].key), held(&put)), (Some(5), Some(5)));
    let (parts, manifest) = snapshot(&keys, 5, b"state");
    assert!(parts.iter().all(|part| held(&part.key) > Some(5)));
    assert!(held(&manifest.key) > Some(5));
    let (earlier, _) = snapshot(&keys, 4, b"state");
    assert!(keys.snapshots_before(5).contains(&earlier[0].key));
    assert!(held(&earlier[0].key) <= Some(5));
    for other in [
        keys.leader(),
        keys.member("base"),
        "/other/journal/5".to_owned(),
    ] {
        assert_eq!(held(&other), None, "{other}");
    }
}
