//! Checks that must hold for any bytes that a computer finds in etcd, or gets from another computer.

use rescue_core::{
    checkpoint::format::{Record, RecordContent},
    cluster::{
        journal::{self, Keys, Manifest},
        merge::{
            ChangeSubject,
            wire::{Ask, MergeAnswer},
        },
    },
};
use ros1_master::{
    master::{Method, Request},
    xmlrpc::{decode_reply, encode_reply},
};

use super::seal_records::sealed_records;

/// Reads the bytes as a key and a value of the journal, and as the request by which partition writes are sent, and its
/// answer.
pub(crate) fn check(bytes: &[u8]) {
    let keys = Keys::new("robot");
    if let Ok(text) = std::str::from_utf8(bytes) {
        let key = format!("{}{text}", keys.prefix());
        for key in [text, &key] {
            let seq = keys.seq_of(key);
            assert!(seq.is_none() || keys.record_of(key) == seq);
        }
    }
    for value in [bytes.to_vec(), sealed_records(bytes, 0)] {
        if let Ok(records) = journal::decode_records("a key", &value) {
            records.iter().for_each(|record| write(&keys, record));
        }
    }
    if let Some(manifest) = Manifest::read(bytes) {
        assert!(!keys.parts(&manifest).is_empty());
        drop(manifest.assemble(&keys, &[bytes.to_vec()]));
    }
    if let Ok(request) = Request::decode(bytes)
        && let Some(ask) = Ask::read(&request)
    {
        let again =
            Request::decode(&ask.to_request().encode()).expect("cannot read our own request");
        assert_eq!(Ask::read(&again).as_ref(), Some(&ask));
        for call in &ask.calls {
            drop(ChangeSubject::changed_by(call));
        }
    }
    if let Ok(reply) = decode_reply(bytes) {
        for count in 0..3 {
            if let Some(answer) = MergeAnswer::read(&reply, count) {
                let again = decode_reply(&encode_reply(&answer.to_reply()));
                let again = again.expect("cannot read our own answer");
                assert!(MergeAnswer::read(&again, count).is_some(), "{answer:?}");
            }
        }
    }
}

/// Panics if what a follower has read cannot be written by a leader.
fn write(keys: &Keys, record: &Record) {
    // An entry that cannot be run is written as nil.
    if matches!(&record.entry, RecordContent::Call { call, .. } if *call.method() == Method::Multicall)
    {
        return;
    }
    let batch =
        journal::pack(keys, std::slice::from_ref(record)).expect("cannot write what was read");
    let value = batch.entry.expect("nothing was written").value;
    if Manifest::read(&value).is_none() {
        let again = journal::decode_records("a key", &value).expect("cannot read our own record");
        assert_eq!(again.as_slice(), std::slice::from_ref(record));
    }
}
