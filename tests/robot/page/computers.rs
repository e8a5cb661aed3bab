//! Tests of the page's panel about several computers, in a real Chromium.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::thread;

use serde_json::{Value, json};

use crate::support::{Browser, Client, Mode, Robot, request, status};

/// Serves the page of a real rosrescue with `events` instead of its own events, until the end of the test program.
fn page_with(client: Client, events: String) -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    thread::spawn(move || {
        for stream in listener.incoming().flatten() {
            let (client, events) = (client.clone(), events.clone());
            thread::spawn(move || relay(stream, &client, &events));
        }
    });
    port
}

fn relay(stream: TcpStream, client: &Client, events: &str) -> Option<()> {
    let mut stream = BufReader::new(stream);
    let mut first = String::new();
    stream.read_line(&mut first).ok()?;
    let mut line = String::new();
    while line != "\r\n" {
        line.clear();
        stream.read_line(&mut line).ok()?;
    }
    let html = "Accept: text/html";
    let answer = match first.contains(" /events ") {
        true => format!("HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\n\r\n{events}"),
        false => {
            let answer = client
                .exchange(&request(first.trim_end(), &[html], b""))
                .ok()?;
            let header = |name| answer.header(name).unwrap_or_default();
            format!(
                "{}\r\nConnection: close\r\nContent-Type: {}\r\nContent-Security-Policy: {}\r\n\r\n{}",
                "HTTP/1.1 200 OK",
                header("content-type"),
                header("content-security-policy"),
                answer.text()
            )
        }
    };
    stream.get_mut().write_all(answer.as_bytes()).ok()?;
    if first.contains(" /events ") {
        // Ends when the browser disconnects.
        let _ = stream.read_to_end(&mut Vec::new());
    }
    Some(())
}

fn events(status: &Value, gate: &str, cluster: &Value) -> String {
    let now = json!({"gate": gate, "version": 1, "registrations": 1, "counters": status["counters"],
                     "pending_writes": 0, "journal": status["journal"], "cluster": cluster});
    format!("event: status\ndata: {status}\n\nevent: now\ndata: {now}\n\n")
}

#[test]
fn several_computers_are_listed_and_one_that_is_cut_off_is_loud() {
    let robot = Robot::start(Mode::Core);
    let mut status = status(&robot.client());
    let time = status["started"].clone();
    let computer = |name: &str, role: &str, behind: u64, away: bool| {
        json!({"name": name, "uri": format!("http://{name}:11311/"), "version": "0.2.0", "role": role,
               "behind": behind, "heard": time, "away": away})
    };
    let mut cluster = json!({
        "name": "pc-2", "role": "following", "since": time,
        "leader": {"name": "pc-1", "uri": "http://pc-1:11311/", "version": "0.2.0", "term": 7, "since": time},
        "leaderless_since": null, "seq": 9, "behind": 2, "uncommitted": 0, "etcd_trouble": null,
        "computers": [computer("pc-1", "leading", 0, false), computer("pc-2", "following", 2, false),
                      computer("<b>pc-3", "following", 5, true)],
        "takeovers": 1, "lost_writes": 0, "times_cut_off": 0,
        "last_takeover": {"at": time, "seconds": 2.04, "from": "pc-3", "in_order": false},
    });
    let mut browser = Browser::start(&robot.scratch);
    browser.screen(390, 844, false);
    let panel = |browser: &mut Browser| {
        let text = browser.js("document.querySelector('#computers').innerText");
        text.as_str().unwrap().to_owned()
    };

    let port = page_with(robot.client(), events(&status, "elsewhere", &cluster));
    browser.open(&format!("http://127.0.0.1:{port}/"));
    browser.shows(
        "each computer has a row",
        "document.querySelectorAll('#computers-list tr').length === 3",
    );
    let text = panel(&mut browser);
    for shown in [
        "leader: pc-1 since ",
        "term 7",
        "2 records behind",
        "this computer",
        "<b>pc-3",
        "AWAY",
        "last takeover by pc-2",
        "from pc-3, in 2.0 s",
    ] {
        assert!(text.contains(shown), "{shown} in {text}");
    }
    assert_eq!(
        browser.js("document.querySelector('#computers').dataset.is"),
        ""
    );
    assert_eq!(browser.js("document.documentElement.scrollWidth"), 390);

    cluster["role"] = "alone".into();
    cluster["uncommitted"] = 3.into();
    cluster["etcd_trouble"] = json!({"since": time, "why": "etcd has no majority"});
    status["condition"]["name"] = "alone".into();
    let port = page_with(robot.client(), events(&status, "open", &cluster));
    browser.open(&format!("http://127.0.0.1:{port}/"));
    browser.shows(
        "it is loud",
        "document.querySelector('#computers').dataset.is === 'bad' && \
         document.querySelector('#condition').dataset.is === 'bad'",
    );
    let text = panel(&mut browser);
    for shown in [
        "pc-2 is CUT OFF since",
        "etcd has no majority",
        "3 changes of pc-2 not in etcd yet",
    ] {
        assert!(text.contains(shown), "{shown} in {text}");
    }
    assert_eq!(browser.complaints(), Vec::<String>::new());

    // The page of a single computer has no such panel.
    browser.open(&format!("http://127.0.0.1:{}/", robot.port()));
    browser.shows(
        "the page is live",
        "document.querySelector('#journal').textContent !== '–'",
    );
    assert_eq!(
        browser.js("document.querySelector('#computers').hidden"),
        true
    );
}
