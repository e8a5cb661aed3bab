//! The parameters of a checkpoint can be loaded with `rosparam load`.

use std::process::Command;

use crate::support::{Rosmaster, Scratch, find_program};
use rosrescue::checkpoint::format::{Checkpoint, encode_checkpoint};
use rosrescue::xmlrpc::{Struct, Value};

/// Takes the parameters out, loads them as a user would, and says what the master returns.
const LOAD: &str = r#"
import subprocess, sys, yaml, xmlrpc.client, os
rosparam, checkpoint, file = sys.argv[1:]
parameters = yaml.safe_load(open(checkpoint, 'rb'))['parameters']
yaml.safe_dump(parameters, open(file, 'w'))
subprocess.check_call([sys.executable, rosparam, 'load', file])
master = xmlrpc.client.ServerProxy(os.environ['ROS_MASTER_URI'])
code, _, found = master.getParam('/test', '/')
assert code == 1

def same(a, b):
    if isinstance(a, dict): return type(b) is dict and a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list): return type(b) is list and len(a) == len(b) and all(map(same, a, b))
    if isinstance(b, xmlrpc.client.Binary): return b.data == a
    if isinstance(b, xmlrpc.client.DateTime): return b == xmlrpc.client.DateTime(a)
    if a != a: return b != b
    return type(a) is type(b) and a == b and str(a) == str(b)

assert same(parameters, found), (parameters, found)
print(len(found))
"#;

#[test]
fn parameters_are_loaded_by_rosparam() {
    let scratch = Scratch::new();
    let texts = [
        "no",
        "on",
        "1:30",
        "=",
        "1.0",
        "",
        " x ",
        "2024-01-31",
        "~",
        "a\nb\t\"c\"",
        "é\u{85}",
    ];
    let mut params: Struct = texts
        .iter()
        .enumerate()
        .map(|(nth, text)| (format!("text_{nth}"), Value::from(*text)))
        .collect();
    let odd_keys = Struct::from([
        // Not `a/b`, `~x` and the empty one: rosparam itself resolves keys as names.
        ("1".to_owned(), 1.into()),
        ("x: #y".to_owned(), 2.into()),
        (
            "on".to_owned(),
            Value::from(vec![1.5, -0.0, 1e300, f64::INFINITY]),
        ),
    ]);
    params.extend([
        ("odd".to_owned(), Value::Struct(odd_keys)),
        ("yes".to_owned(), true.into()),
        ("empty".to_owned(), Value::Array(Vec::new())),
        (
            "when".to_owned(),
            Value::DateTime("20240131T12:00:00".to_owned()),
        ),
        ("bytes".to_owned(), Value::Base64(vec![0, 255, 10])),
        (
            "numbers".to_owned(),
            Value::from(vec![i32::MIN, 0, i32::MAX]),
        ),
    ]);
    let count = params.len();
    let mut checkpoint = Checkpoint::default();
    checkpoint.snapshot.params = params;
    let path = scratch.path("latest-chkpt.yaml");
    std::fs::write(&path, encode_checkpoint(&checkpoint, 1).unwrap().bytes).unwrap();

    let master = Rosmaster::start(&scratch);
    let mut python = Command::new("/usr/bin/python3");
    scratch.prepare(&mut python);
    let output = python
        .env("ROS_MASTER_URI", master.client().uri())
        .args(["-c", LOAD])
        .arg(find_program("rosparam"))
        .args([&path, &scratch.path("parameters.yaml")])
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{text}");
    assert_eq!(
        String::from_utf8_lossy(&output.stdout).trim(),
        count.to_string()
    );
}
