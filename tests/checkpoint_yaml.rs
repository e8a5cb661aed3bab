//! A checkpoint is YAML that means the same to us, to PyYAML and to rosparam.

// The lints know `#[test]` functions only, not their helpers.
#![allow(clippy::expect_used, clippy::indexing_slicing, clippy::unwrap_used)]

use std::io::Write;
use std::process::{Command, Stdio};

use indexmap::IndexMap;
use proptest::prelude::*;
use rosrescue::master::{ServiceEntry, Snapshot, SnapshotNode};
use rosrescue::record::{
    Checkpoint, DEPTH_MAX, EncodeError, Entry, Record, Session, decode, encode_checkpoint,
    encode_record,
};
use rosrescue::xmlrpc::{Call, Struct, Value};

const PYTHON: &str = "/usr/bin/python3";

/// Texts that some YAML reader or other takes for something else.
const TEXTS: &[&str] = &[
    "",
    " ",
    "  both  ",
    "no",
    "No",
    "on",
    "OFF",
    "y",
    "yes",
    "true",
    "null",
    "~",
    "Null",
    "1:30",
    "=",
    "<<",
    "1.0",
    "1",
    "-1",
    "0x10",
    "0o17",
    "017",
    "1_000",
    "1e3",
    ".inf",
    ".nan",
    "+1",
    "2024-01-31",
    "2024-01-31 12:00:00",
    "a: b",
    "a #b",
    "#",
    "- a",
    "-",
    "?",
    ":",
    "!tag",
    "&a",
    "*a",
    "%YAML",
    "---",
    "...",
    "@",
    "`",
    "|",
    ">",
    "{}",
    "[]",
    ",",
    "'",
    "\"",
    "\\",
    "\\n",
    "a\nb",
    "a\r\nb",
    "\r",
    "\t",
    "\ttab\t",
    "\n",
    "\n\n",
    "]]>",
    "<value/>",
    "\u{7f}",
    "\u{80}",
    "\u{85}",
    "\u{a0}",
    "\u{ad}",
    "\u{2028}",
    "\u{2029}",
    "\u{202e}",
    "\u{feff}",
    "\u{feff}bom",
    "\u{fffe}",
    "\u{ffff}",
    "\u{fdd0}",
    "\u{1fffe}",
    "\u{10ffff}",
    "\u{1f916}",
    "é",
    "日本",
    "\u{e000}",
    "\u{fffd}",
    "\0",
    "\u{1}",
    "\u{1b}",
    "journal:",
    "\njournal:\n",
    "- {seq: 1, call: \"x\", params: []} #00000000 00000000",
    "/a/b",
    "~private",
    "$(arg x)",
    "deg(90)",
    "rad(1.0)",
    "é\nü\u{85}",
    "trailing\\",
];

const NUMBERS: &[f64] = &[
    0.0,
    -0.0,
    1.0,
    -1.5,
    0.1,
    1e300,
    -1e300,
    1e16,
    1e15,
    1.5e-7,
    5e-324,
    2.2250738585072014e-308,
    f64::MAX,
    f64::MIN,
    f64::EPSILON,
    f64::INFINITY,
    f64::NEG_INFINITY,
    f64::NAN,
    123_456_789.123,
];

fn catalogue() -> Vec<Value> {
    let mut values: Vec<Value> = TEXTS.iter().map(|text| Value::from(*text)).collect();
    values.extend(TEXTS.iter().map(|text| Value::DateTime((*text).to_owned())));
    values.extend(NUMBERS.iter().map(|number| Value::Double(*number)));
    values.extend([i32::MIN, -1, 0, 1, 8, 60, i32::MAX].map(Value::Int));
    values.extend(
        [
            "2147483648",
            "-2147483649",
            "9223372036854775808",
            "-18446744073709551616",
        ]
        .map(|digits| Value::BigInt(digits.to_owned())),
    );
    values.push(Value::BigInt("7".repeat(4_000)));
    values.push(Value::BigInt("7".repeat(5_000)));
    for odd in ["5", "-0", "007", "", "x", "1: {", "00000000000000000001"] {
        values.push(Value::BigInt(odd.to_owned()));
    }
    for moment in [
        "20240131T12:00:00",
        "20240229T00:00:00",
        "20230229T00:00:00",
        "99991231T23:59:59",
        "00010101T00:00:00",
        "00000101T00:00:00",
        "20240131T24:00:00",
        "2024-01-31T12:00:00",
        "20240131T12:00:00Z",
        "20240131t12:00:00",
        "+0240131T12:00:00",
        "2024-131T12:00:00",
    ] {
        values.push(Value::DateTime(moment.to_owned()));
    }
    values.push(Value::Base64(Vec::new()));
    values.push(Value::Base64((0..=255).collect()));
    values.extend([Value::Nil, Value::Bool(true), Value::Bool(false)]);
    values.extend([Value::Array(vec![]), Value::Struct(Struct::new())]);
    values.push(Value::Struct(
        TEXTS
            .iter()
            .enumerate()
            .map(|(nth, key)| ((*key).to_owned(), Value::Int(nth as i32)))
            .collect(),
    ));
    values.push(Value::from("long ".repeat(2_000)));
    for length in [900, 990, 1_000, 1_010, 1_020, 1_024, 1_030, 5_000] {
        let value = Value::from(vec![Value::Struct(Struct::from([(
            "k".repeat(length),
            1.into(),
        )]))]);
        values.push(Value::Struct(Struct::from([("k".repeat(length), value)])));
        values.push(Value::Struct(Struct::from([
            (
                "\u{e9}".repeat(length),
                Value::Struct(Struct::from([("in".to_owned(), 1.into())])),
            ),
            ("next".to_owned(), 2.into()),
        ])));
    }
    values
}

fn nested(levels: usize, wrap: impl Fn(Value) -> Value) -> Value {
    (0..levels).fold(Value::Int(1), |value, _| wrap(value))
}

fn in_array(value: Value) -> Value {
    Value::Array(vec![value])
}

fn in_struct(value: Value) -> Value {
    Value::Struct(Struct::from([("k".to_owned(), value)]))
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
        },
        snapshot: Snapshot {
            nodes: IndexMap::from([
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
                    },
                ),
            ]),
            topic_types: IndexMap::from([("/t".to_owned(), "*".to_owned())]),
            publishers: IndexMap::from([("/t".to_owned(), ids(&["/b", "/a: "]))]),
            subscribers: IndexMap::new(),
            services: IndexMap::from([(
                "/s".to_owned(),
                ServiceEntry {
                    node: "/b".to_owned(),
                    api: "rosrpc://h:2".to_owned(),
                },
            )]),
            param_subscribers: IndexMap::from([("/p/".to_owned(), ids(&["~"]))]),
            params,
        },
    }
}

/// One file that holds `value` as a parameter and in a record.
fn file_with(value: &Value) -> Result<Vec<u8>, EncodeError> {
    let checkpoint = with_params(Struct::from([("p".to_owned(), value.clone())]));
    let encoded = encode_checkpoint(&checkpoint, 3)?;
    let entry = Entry::Call(Call::new(
        "setParam",
        vec!["/n".into(), "/p".into(), value.clone()],
    ));
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
    assert_eq!(
        checkpoint,
        with_params(Struct::from([("p".to_owned(), value.clone())])),
        "{text}"
    );
    let [
        Record {
            seq: 5_000_000_001,
            entry: Entry::Call(call),
        },
    ] = decoded.records.as_slice()
    else {
        panic!("{:?}\n{text}", decoded.damaged);
    };
    assert!(call.params[2] == *value, "another value came back:\n{text}");
}

#[test]
fn every_kind_of_value_comes_back() {
    for value in catalogue() {
        assert_round_trip(&value);
    }
    assert_round_trip(&Value::Array(catalogue()));
}

#[test]
fn every_character_comes_back() {
    let all: Vec<char> = (0..=0x10_ffff).filter_map(char::from_u32).collect();
    for some in all.chunks(100_000) {
        assert_round_trip(&Value::String(some.iter().collect()));
    }
}

#[test]
fn a_session_record_comes_back() {
    let encoded = encode_checkpoint(&Checkpoint::default(), 1).unwrap();
    let session = Session {
        id: "x".to_owned(),
        master_uri: None,
        ..Session::default()
    };
    let record = Record {
        seq: 1,
        entry: Entry::Session(session),
    };
    let mut file = encoded.bytes;
    file.extend(encode_record(&record, encoded.stamp).unwrap());
    let decoded = decode(&file).unwrap();
    assert_eq!(decoded.checkpoint.unwrap(), Checkpoint::default());
    assert_eq!(decoded.records, [record]);
}

#[test]
fn what_is_written_is_never_too_deep_to_read() {
    // The key `p` is a level of its own.
    for wrap in [in_array, in_struct] {
        assert_round_trip(&nested(DEPTH_MAX - 1, wrap));
        let error = file_with(&nested(DEPTH_MAX + 1, wrap)).unwrap_err();
        assert_eq!(error, EncodeError::TooDeep { limit: DEPTH_MAX });
    }
}

fn values() -> impl Strategy<Value = Value> {
    let text = || {
        prop_oneof![
            any::<String>(),
            proptest::sample::select(TEXTS).prop_map(str::to_owned)
        ]
    };
    let leaf = prop_oneof![
        Just(Value::Nil),
        any::<bool>().prop_map(Value::Bool),
        any::<i32>().prop_map(Value::Int),
        "-?[1-9][0-9]{10,40}".prop_map(Value::BigInt),
        // NaN has one spelling on the wire and here.
        any::<f64>().prop_map(|n| Value::Double(if n.is_nan() { f64::NAN } else { n })),
        any::<u64>()
            .prop_map(f64::from_bits)
            .prop_map(|n| { Value::Double(if n.is_nan() { f64::NAN } else { n }) }),
        text().prop_map(Value::String),
        text().prop_map(Value::DateTime),
        proptest::collection::vec(any::<u8>(), 0..20).prop_map(Value::Base64),
    ];
    leaf.prop_recursive(5, 40, 6, move |inner| {
        prop_oneof![
            proptest::collection::vec(inner.clone(), 0..6).prop_map(Value::Array),
            proptest::collection::vec((text(), inner), 0..6)
                .prop_map(|members| Value::Struct(members.into_iter().collect())),
        ]
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2_000))]

    #[test]
    fn any_value_comes_back(value in values()) {
        assert_round_trip(&value);
    }
}

/// What PyYAML sees, with its types, in a notation of our own.
const DESCRIBE: &str = r#"
import base64, datetime, struct, sys, yaml

def show(v):
    if v is None: return 'nil'
    t = type(v)
    if t is bool: return 'bool:%d' % v
    if t is int: return 'int:%s' % hex(v)
    if t is float: return 'nan' if v != v else 'float:' + struct.pack('>d', v).hex()
    if t is str: return 'str:' + v.encode().hex()
    if t is bytes: return 'bytes:' + v.hex()
    if t is datetime.datetime: return 'date:' + v.strftime('%4Y%m%dT%H:%M:%S').encode().hex()
    if t is dict: return '{' + ' '.join(show(k) + '=' + show(w) for k, w in v.items()) + '}'
    if t is list and len(v) == 1 and type(v[0]) is tuple:
        (kind, text), = v
        return {'dateTime.iso8601': 'date:', 'int': 'digits:'}[kind] + text.encode().hex()
    if t is list: return '[' + ' '.join(map(show, v)) + ']'
    raise TypeError(t)

for name in sys.stdin.read().split():
    with open(name, 'rb') as f: content = f.read()
    document = yaml.safe_load(content)
    assert list(yaml.safe_load_all(content)) == [document] or b'.nan' in content
    journal = document['journal'] or []
    print(show(document['parameters']), show(journal[0]['params'][2] if journal else None))
"#;

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn shown(value: &Value) -> String {
    match value {
        Value::Nil => "nil".to_owned(),
        Value::Bool(truth) => format!("bool:{}", u8::from(*truth)),
        Value::Int(n) if *n < 0 => format!("int:-{:#x}", i64::from(*n).unsigned_abs()),
        Value::Int(n) => format!("int:{n:#x}"),
        Value::BigInt(digits) => match digits.parse::<i128>() {
            Ok(n) if n.to_string() != *digits || i32::try_from(n).is_ok() => {
                format!("digits:{}", hex(digits.as_bytes()))
            }
            Ok(n) if n < 0 => format!("int:-{:#x}", n.unsigned_abs()),
            Ok(n) => format!("int:{n:#x}"),
            Err(_) => format!("digits:{}", hex(digits.as_bytes())),
        },
        Value::Double(n) if n.is_nan() => "nan".to_owned(),
        Value::Double(n) => format!("float:{:016x}", n.to_bits()),
        Value::String(text) => format!("str:{}", hex(text.as_bytes())),
        Value::DateTime(text) => format!("date:{}", hex(text.as_bytes())),
        Value::Base64(bytes) => format!("bytes:{}", hex(bytes)),
        Value::Array(elements) => {
            format!(
                "[{}]",
                elements.iter().map(shown).collect::<Vec<_>>().join(" ")
            )
        }
        Value::Struct(members) => {
            let member = |(name, value): (&String, &Value)| {
                format!("str:{}={}", hex(name.as_bytes()), shown(value))
            };
            format!(
                "{{{}}}",
                members.iter().map(member).collect::<Vec<_>>().join(" ")
            )
        }
    }
}

fn python(script: &str, input: &str) -> String {
    let mut child = Command::new(PYTHON)
        .args(["-c", script])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    child
        .stdin
        .take()
        .unwrap()
        .write_all(input.as_bytes())
        .unwrap();
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", output.status);
    String::from_utf8(output.stdout).unwrap()
}

/// Writes one file per value and compares what PyYAML makes of them.
fn assert_python_agrees(values: &[Value]) {
    let folder = tempfile::tempdir().unwrap();
    let mut names = String::new();
    for (nth, value) in values.iter().enumerate() {
        let path = folder.path().join(nth.to_string());
        std::fs::write(&path, file_with(value).unwrap()).unwrap();
        names += &format!("{}\n", path.display());
    }
    let output = python(DESCRIBE, &names);
    assert_eq!(output.lines().count(), values.len());
    for (value, line) in values.iter().zip(output.lines()) {
        let value = shown(value);
        assert_eq!(line, format!("{{str:70={value}}} {value}"));
    }
}

#[test]
fn python_reads_every_kind_of_value_alike() {
    // Integers of 40 digits at most, which `shown` can convert; the longest are looked at apart.
    let values: Vec<Value> = catalogue()
        .into_iter()
        .filter(|value| !matches!(value, Value::BigInt(digits) if digits.len() == 4_000))
        .collect();
    assert_python_agrees(&values);
    assert_python_agrees(&[nested(200, in_array), nested(200, in_struct)]);
}

#[test]
fn python_reads_random_values_alike() {
    use proptest::strategy::ValueTree;
    use proptest::test_runner::TestRunner;
    let mut runner = TestRunner::default();
    let values: Vec<Value> = (0..400)
        .map(|_| values().new_tree(&mut runner).unwrap().current())
        .collect();
    // `shown` knows integers of 128 bits.
    let few_digits = |value: &Value| !format!("{value:?}").contains("BigInt");
    assert_python_agrees(&values.into_iter().filter(few_digits).collect::<Vec<_>>());
}

#[test]
fn python_reads_the_longest_integer() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("long");
    std::fs::write(&path, file_with(&Value::BigInt("7".repeat(4_000))).unwrap()).unwrap();
    let script = "import sys, yaml; \
                  print(yaml.safe_load(open(sys.stdin.read(), 'rb'))['parameters']['p'])";
    assert_eq!(
        python(script, path.to_str().unwrap()).trim(),
        "7".repeat(4_000)
    );
}
