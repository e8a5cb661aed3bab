//! PyYAML, the YAML reader that most programs use.

use std::io::Write;
use std::process::{Command, Stdio};

use proptest::prelude::*;
use ros1_master::xmlrpc::Value;

use super::catalogue::{catalogue, values};
use super::{file_with, in_array, in_struct, nested};

const PYTHON: &str = "/usr/bin/python3";

/// Prints the values that PyYAML reads, with types, in a notation for comparison.
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
        return {'dateTime.iso8601': 'date:', 'int': 'digits:', 'bigdecimal': 'decimal:'}[kind] + text.encode().hex()
    if t is list: return '[' + ' '.join(map(show, v)) + ']'
    raise TypeError(t)

for name in sys.stdin.read().split():
    with open(name, 'rb') as f: content = f.read()
    document = yaml.safe_load(content)
    assert list(yaml.safe_load_all(content)) == [document] or b'.nan' in content
    journal = document['journal']
    assert journal[0]['pending'] is True
    assert (journal[0]['t'], journal[0]['from']) == (1764115200123, 'rosrescue')
    print(show(document['parameters']), show(document['pending'][0]['setParam'][2]), show(journal[0]['setParam'][2]))
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
        Value::BigDecimal(text) => format!("decimal:{}", hex(text.as_bytes())),
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

/// Writes one file per value, and compares how PyYAML reads them.
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
        assert_eq!(line, format!("{{str:70={value}}} {value} {value}"));
    }
}

#[test]
fn python_reads_every_kind_of_value_alike() {
    // `shown` can convert integers of at most 40 digits. A separate test has the longest ones.
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
    let values: Vec<Value> = (0..150)
        .map(|_| values().new_tree(&mut runner).unwrap().current())
        .collect();
    // `shown` can convert integers of 128 bits.
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
