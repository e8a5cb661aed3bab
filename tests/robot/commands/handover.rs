//! `rosrescue handover`: how it reacts to a rosrescue's answers.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;

use ros1_master::xmlrpc::{self, Reply, Value};
use serde_json::{Value as Json, json};

use crate::support::{Mode, Robot, Tool, free_port, status};

/// A simulated rosrescue of several computers. pc-1 leads until it is asked to hand over.
#[derive(Clone)]
struct Story {
    /// The status of a real rosrescue.
    status: Json,
    /// The answer to the request.
    answer: Reply,
    /// The leader and its term after this many status requests since the handover request. There is no leader before
    /// that.
    next: Option<(usize, &'static str, u64)>,
}

/// Serves `story` at a free port until the end of the test program.
fn tell(story: Story) -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    let looks = AtomicUsize::new(0);
    thread::spawn(move || {
        for stream in listener.incoming().flatten() {
            let _ = story.serve(stream, &looks);
        }
    });
    port
}

impl Story {
    /// Answers a request. `looks` counts the status requests, and is 0 before the handover request.
    fn serve(&self, stream: TcpStream, looks: &AtomicUsize) -> std::io::Result<()> {
        let mut stream = BufReader::new(stream);
        let mut first = String::new();
        stream.read_line(&mut first)?;
        let mut length = 0;
        loop {
            let mut line = String::new();
            stream.read_line(&mut line)?;
            if let Some(value) = line.to_ascii_lowercase().strip_prefix("content-length:") {
                length = value.trim().parse().unwrap();
            }
            if line.trim().is_empty() {
                break;
            }
        }
        let mut body = vec![0; length];
        stream.read_exact(&mut body)?;
        let answer = if first.starts_with("POST") {
            let call = xmlrpc::decode_call(&body).unwrap();
            assert_eq!(call.method, "rosrescue/handover");
            assert_eq!(call.params.len(), 2, "{call:?}");
            looks.store(1, Ordering::SeqCst);
            xmlrpc::encode_reply(&self.answer)
        } else {
            let asked = looks.load(Ordering::SeqCst);
            if asked > 0 {
                looks.fetch_add(1, Ordering::SeqCst);
            }
            self.status_after(asked).to_string().into_bytes()
        };
        let head = format!(
            "HTTP/1.1 200 OK\r\nConnection: close\r\nContent-Length: {}\r\n\r\n",
            answer.len()
        );
        stream
            .get_mut()
            .write_all(&[head.as_bytes(), &answer].concat())
    }

    fn status_after(&self, looks: usize) -> Json {
        let next = self.next.filter(|(after, ..)| looks > *after);
        let (leader, term) = next.map_or(("pc-1", 7), |(_, leader, term)| (leader, term));
        let leaderless = (looks > 0 && next.is_none()).then_some(1e9);
        let computer = |name: &str| {
            let uri = format!("http://{name}:11311/");
            json!({"name": name, "uri": uri, "version": "0", "role": "following", "behind": 0,
                   "heard": 1e9, "away": false})
        };
        let mut status = self.status.clone();
        status["cluster"] = json!({
            "name": "pc-2", "role": "following", "since": 1e9,
            "leader": {"name": leader, "uri": "http://pc-1:11311/", "version": "0", "term": term, "since": 1e9},
            "leaderless_since": leaderless, "seq": 9, "behind": 0, "uncommitted": 0, "etcd_trouble": null,
            "computers": [computer("pc-1"), computer("pc-2"), computer("pc-3")],
            "takeovers": 0, "last_takeover": null, "lost_writes": 0, "times_cut_off": 0,
        });
        status
    }
}

#[test]
fn it_waits_until_another_computer_leads_and_says_which() {
    let robot = Robot::start(Mode::Core);
    let done = Reply::Value(Value::Array(vec![1.into(), "".into(), "pc-1".into()]));
    let refused = "pc-3 is too far behind";
    let refused = Reply::Value(Value::Array(vec![0.into(), refused.into(), "".into()]));
    let status = status(&robot.client());
    let ran = |answer: &Reply, next, arguments: &[&str]| {
        let story = Story {
            status: status.clone(),
            answer: answer.clone(),
            next,
        };
        let arguments = [&["handover"], arguments].concat();
        Tool::rosrescue(&robot.scratch, tell(story), &arguments)
    };

    let shown = |arguments: &[&str]| {
        let answer = done.clone();
        let status = status.clone();
        let story = Story {
            status,
            answer,
            next: None,
        };
        Tool::rosrescue(&robot.scratch, tell(story), arguments).ended(0)
    };
    let text = shown(&["status"]);
    assert!(
        text.contains("\nleader      pc-1 at http://pc-1:11311/, since "),
        "{text}"
    );
    assert!(
        text.contains("\n            pc-2 (this one) is following\n"),
        "{text}"
    );
    let text = shown(&["top", "--count", "1"]);
    assert!(
        text.contains("\ncomputers: pc-1 is following; pc-2"),
        "{text}"
    );

    let good = ran(&done, Some((3, "pc-2", 8)), &[]).ended(0);
    assert!(
        good.starts_with("pc-1 led, pc-2 leads now, after "),
        "{good}"
    );
    let json = ran(&done, Some((0, "pc-3", 8)), &["--to", "pc-3", "--json"]).json(0);
    assert_eq!(json["handed_over"], true);
    assert_eq!(
        (&json["from"], &json["to"]),
        (&json!("pc-1"), &json!("pc-3"))
    );
    let already = ran(&refused, None, &["--to", "pc-1"]).ended(0);
    assert_eq!(already, "pc-1 leads already");

    let back = ran(&done, Some((2, "pc-1", 9)), &[]).ended(1);
    assert!(
        back.contains("no other computer took over: pc-1 still leads"),
        "{back}"
    );
    let other = ran(&done, Some((2, "pc-3", 8)), &["--to", "pc-2"]).ended(1);
    assert!(other.contains("pc-3 leads now instead of pc-2"), "{other}");
    let nobody = ran(&done, None, &["--timeout", "4"]);
    assert!(
        nobody.stdout.contains("no computer leads after"),
        "{nobody:?}"
    );
    assert!(
        nobody.stderr.contains("no computer leads after "),
        "{nobody:?}"
    );
    nobody.ended(1);
    let refused = ran(&refused, None, &[]);
    assert!(
        refused
            .stderr
            .contains("the leader refused the handover: pc-3 is too far behind")
    );
    refused.ended(1);

    for name in ["pc-4", "p c"] {
        let unknown = ran(&done, None, &["--to", name]);
        assert!(unknown.stderr.contains(name), "{unknown:?}");
        unknown.ended(2);
    }
}

#[test]
fn a_single_computer_cannot_hand_over() {
    let robot = Robot::start(Mode::Core);
    let alone = Tool::rosrescue(&robot.scratch, robot.port(), &["handover"]);
    assert!(alone.stderr.contains("runs without --cluster"), "{alone:?}");
    alone.ended(1);
    Tool::rosrescue(&robot.scratch, free_port(), &["handover"]).ended(3);
}
