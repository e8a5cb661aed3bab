//! The parameters of a checkpoint can be loaded with `rosparam load`.

// The lints know `#[test]` functions only, not their helpers.
#![allow(clippy::expect_used, clippy::unwrap_used)]

use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use rosrescue::record::{Checkpoint, encode_checkpoint};
use rosrescue::xmlrpc::{Struct, Value};

const PYTHON: &str = "/usr/bin/python3";

/// A real rosmaster that ends with the test.
struct Master {
    child: Child,
    port: u16,
}

impl Master {
    fn start(scratch: &Path) -> Self {
        let free = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        let port = free.local_addr().unwrap().port();
        drop(free);
        let child = ros(scratch, port)
            .args(["/usr/bin/rosmaster", "--core", "-p", &port.to_string()])
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let deadline = Instant::now() + Duration::from_secs(30);
        while TcpStream::connect((Ipv4Addr::LOCALHOST, port)).is_err() {
            assert!(Instant::now() < deadline, "rosmaster does not listen");
            sleep(Duration::from_millis(20));
        }
        Self { child, port }
    }
}

impl Drop for Master {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn ros(scratch: &Path, port: u16) -> Command {
    let mut command = Command::new(PYTHON);
    command
        .env("ROS_MASTER_URI", format!("http://127.0.0.1:{port}"))
        .env("ROS_IP", "127.0.0.1")
        .env("ROS_HOME", scratch)
        .env("ROS_LOG_DIR", scratch);
    command
}

/// Takes the parameters out, loads them as a user would, and says what the master returns.
const LOAD: &str = r#"
import subprocess, sys, yaml, xmlrpc.client, os
checkpoint, file = sys.argv[1:]
parameters = yaml.safe_load(open(checkpoint, 'rb'))['parameters']
yaml.safe_dump(parameters, open(file, 'w'))
subprocess.check_call([sys.executable, '/usr/bin/rosparam', 'load', file])
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
    let folder = tempfile::tempdir().unwrap();
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
    let path = folder.path().join("latest-chkpt.yaml");
    std::fs::write(&path, encode_checkpoint(&checkpoint, 1).unwrap().bytes).unwrap();

    let master = Master::start(folder.path());
    let output = ros(folder.path(), master.port)
        .args(["-c", LOAD])
        .args([&path, &folder.path().join("parameters.yaml")])
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{text}");
    assert_eq!(
        String::from_utf8_lossy(&output.stdout).trim(),
        count.to_string()
    );
}
