//! A checkpoint is YAML that rosrescue, PyYAML and rosparam read alike.

// The lints exempt only `#[test]` functions, not their helpers.
mod catalogue;
mod python;

use self::catalogue::{catalogue, values};
use proptest::prelude::*;
use rescue_core::checkpoint::format::{
    Announced, Checkpoint, DEPTH_MAX, EncodeError, Label, Origin, PendingWrite, Record,
    RecordContent, Session, decode, encode_checkpoint, encode_record,
};
use ros1_master::{
    master::{Displaced, Method, OrderedMap, Request, ServiceEntry, Snapshot, SnapshotNode},
    xmlrpc::{Struct, Value},
};

const LABEL: Label = Label {
    at: 1_764_115_200_123,
    origin: Origin::Rosrescue,
};

fn nested(levels: usize, wrap: impl Fn(Value) -> Value) -> Value {
    (0..levels).fold(Value::Int(1), |value, _| wrap(value))
}

fn in_array(value: Value) -> Value {
    Value::Array(vec![value])
}

fn in_struct(value: Value) -> Value {
    Value::Struct(Struct::from([("k".to_owned(), value)]))
}

/// A state that has `value` as a parameter, set by a pending write.
fn with_value(value: &Value) -> Checkpoint {
    let delete = Request::new(Method::DeleteParam, [Value::Nil; 0]);
    let calls = [set_param(value), delete].into_iter();
    let pending = (4_999_999_999..).zip(calls);
    Checkpoint {
        pending: pending
            .map(|(seq, call)| PendingWrite { seq, call })
            .collect(),
        ..with_params(Struct::from([("p".to_owned(), value.clone())]))
    }
}

fn set_param(value: &Value) -> Request {
    let params = ["/n".into(), "/p".into(), value.clone()];
    Request::new(Method::SetParam, params)
}

fn with_params(params: Struct) -> Checkpoint {
    let ids = |ids: &[&str]| ids.iter().map(|id| (*id).to_owned()).collect::<Vec<_>>();
    Checkpoint {
        seq: 5_000_000_000,
        session: Session {
            id: "4f6c\n\"x\"".to_owned(),
            boot_id: "no".to_owned(),
            closed: true,
            mark: "/rosrescue_mark".to_owned(),
            master_uri: Some("http://127.0.0.1:11312/".to_owned()),
            started: "2024-01-31 12:00:00".to_owned(),
            incarnation: 3,
            delivered: 4_999_999_999,
            announced: Some(Announced {
                incarnation: 5,
                at: 4_999_999_998,
            }),
            term: 1_800_000,
            cluster_journal: 3,
            cluster_seq: 1_700_000,
            port: 11_312,
            at: 1_764_115_200_000,
        },
        snapshot: Snapshot {
            nodes: OrderedMap::from([
                (
                    "/b".to_owned(),
                    SnapshotNode {
                        api: "http://h:1/".to_owned(),
                        ..Default::default()
                    },
                ),
                (
                    "/a: ".to_owned(),
                    SnapshotNode {
                        api: "no".to_owned(),
                        taken_over_services: ids(&["/s", "on"]),
                        from: Some([10, 0, 0, 7].into()),
                    },
                ),
            ]),
            topic_types: OrderedMap::from([("/t".to_owned(), "*".to_owned())]),
            publishers: OrderedMap::from([("/t".to_owned(), ids(&["/b", "/a: "]))]),
            subscribers: OrderedMap::default(),
            services: OrderedMap::from([(
                "/s".to_owned(),
                ServiceEntry {
                    node: "/b".to_owned(),
                    api: "rosrpc://h:2".to_owned(),
                },
            )]),
            had_services: true,
            param_subscribers: OrderedMap::from([("/p/".to_owned(), ids(&["~"]))]),
            params,
        },
        pending: Vec::new(),
        displaced: vec![
            Displaced {
                node: "/b".to_owned(),
                api: "http://h:9/".to_owned(),
                pid: Some(7),
                topics: ids(&["/t", "yes"]),
                from: Some([10, 0, 0, 7].into()),
            },
            Displaced {
                node: "/c".to_owned(),
                api: "http://h:8/".to_owned(),
                pid: None,
                topics: Vec::new(),
                from: None,
            },
        ],
        follows: false,
    }
}

/// A file that holds `value` as a parameter and in a record, both still to be delivered to the master.
fn file_with(value: &Value) -> Result<Vec<u8>, EncodeError> {
    let checkpoint = with_value(value);
    let encoded = encode_checkpoint(&checkpoint, 3)?;
    let entry = RecordContent::Call {
        call: set_param(value),
        pending: true,
        label: LABEL,
    };
    let mut file = encoded.bytes;
    file.extend(encode_record(
        &Record {
            seq: checkpoint.seq + 1,
            entry,
        },
        encoded.stamp,
    )?);
    Ok(file)
}

fn assert_round_trip(value: &Value) {
    let file = file_with(value).unwrap();
    let decoded = decode(&file).unwrap();
    let text: String = String::from_utf8_lossy(&file).chars().take(2_000).collect();
    let checkpoint = decoded
        .checkpoint
        .unwrap_or_else(|error| panic!("{error}\n{text}"));
    assert_eq!(checkpoint, with_value(value), "{text}");
    let [
        Record {
            seq: 5_000_000_001,
            entry:
                RecordContent::Call {
                    call,
                    pending: true,
                    label: LABEL,
                },
        },
    ] = decoded.records.as_slice()
    else {
        panic!("{:?}\n{text}", decoded.damaged);
    };
    assert!(call.params()[2] == *value, "the value has changed:\n{text}");
}

#[test]
fn every_kind_of_value_is_read_back_unchanged() {
    for value in catalogue() {
        assert_round_trip(&value);
    }
    assert_round_trip(&Value::Array(catalogue()));
}

#[test]
fn every_character_is_read_back_unchanged() {
    let all: Vec<char> = (0..=0x10_ffff).filter_map(char::from_u32).collect();
    for some in all.chunks(100_000) {
        assert_round_trip(&Value::String(some.iter().collect()));
    }
}

#[test]
fn a_write_that_the_master_has_run_is_not_pending() {
    let encoded = encode_checkpoint(&Checkpoint::default(), 1).unwrap();
    let record = Record {
        seq: 1,
        entry: RecordContent::call(set_param(&1.into())),
    };
    let line = encode_record(&record, encoded.stamp).unwrap();
    let file = [encoded.bytes, line].concat();
    assert!(!String::from_utf8_lossy(&file).contains("pending"));
    assert_eq!(decode(&file).unwrap().records, [record]);
}

#[test]
fn a_session_record_is_read_back_unchanged() {
    let encoded = encode_checkpoint(&Checkpoint::default(), 1).unwrap();
    let session = Session {
        id: "x".to_owned(),
        master_uri: None,
        incarnation: 2,
        delivered: u64::MAX / 2,
        ..Session::default()
    };
    let record = Record {
        seq: 1,
        entry: RecordContent::Session(session.into()),
    };
    let mut file = encoded.bytes;
    file.extend(encode_record(&record, encoded.stamp).unwrap());
    let decoded = decode(&file).unwrap();
    assert_eq!(decoded.checkpoint.unwrap(), Checkpoint::default());
    assert_eq!(decoded.records, [record]);
}

#[test]
fn nothing_is_written_that_is_too_deep_to_read() {
    // The key `p` takes one level.
    for wrap in [in_array, in_struct] {
        assert_round_trip(&nested(DEPTH_MAX - 1, wrap));
        let error = file_with(&nested(DEPTH_MAX + 1, wrap)).unwrap_err();
        assert_eq!(error, EncodeError::TooDeep { limit: DEPTH_MAX });
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2_000))]

    #[test]
    fn any_value_is_read_back_unchanged(value in values()) {
        assert_round_trip(&value);
    }
}
