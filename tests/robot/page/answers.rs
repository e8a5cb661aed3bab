//! The answers of the pages, without a browser.

use std::fs;
use std::path::Path;
use std::process::Command;

use serde_json::Value;

use crate::support::{
    Client, Mode, Response, Robot, Scratch, Setup, Wire, eventually, feed, request, tree,
};

const SECRET: &str = "hunter2";

fn get(client: &Client, path: &str, headers: &[&str]) -> Response {
    let page = request(&format!("GET {path} HTTP/1.1"), headers, b"");
    client.exchange(&page).unwrap()
}

fn json(client: &Client, path: &str) -> Value {
    let page = get(client, path, &[]);
    assert_eq!(page.code, 200, "{path}");
    serde_json::from_slice(&page.body).unwrap()
}

/// Connects a listener to `/events`.
fn listen(port: u16) -> (Wire, Response) {
    let mut wire = Wire::connect("127.0.0.1", port).unwrap();
    wire.send(&request("GET /events HTTP/1.1", &[], b""))
        .unwrap();
    let head = wire.head().unwrap();
    (wire, head)
}

#[test]
fn a_browser_gets_the_page_and_curl_gets_text() {
    let robot = Robot::start(Mode::Core);
    let client = robot.client();
    let text = get(&client, "/", &["Accept: */*"]);
    assert_eq!(
        text.header("content-type"),
        Some("text/plain; charset=utf-8")
    );
    assert!(text.text().starts_with("protected"), "{}", text.text());
    let html = get(
        &client,
        "/",
        &["Accept: text/html,application/xhtml+xml,*/*;q=0.8"],
    );
    assert_eq!(
        html.header("content-type"),
        Some("text/html; charset=utf-8")
    );
    for (path, kind) in [
        ("/page.js", "text/javascript"),
        ("/page.css", "text/css"),
        ("/graph.js", "text/javascript"),
        ("/layout.js", "text/javascript"),
        ("/overview.js", "text/javascript"),
        ("/dagre.js", "text/javascript"),
        ("/state.json", "application/json"),
        ("/history.json", "application/json"),
    ] {
        let page = get(&client, path, &[]);
        assert_eq!(
            (page.code, page.header("content-type")),
            (200, Some(kind)),
            "{path}"
        );
        let policy = page.header("content-security-policy").unwrap();
        assert!(policy.starts_with("default-src 'none'; script-src 'self'"));
        assert!(!policy.contains("unsafe"));
        assert_eq!(page.header("x-content-type-options"), Some("nosniff"));
    }
    let (live, ready) = (get(&client, "/live", &[]), get(&client, "/ready", &[]));
    assert_eq!((live.code, ready.code), (200, 200));
    assert_eq!(get(&client, "/favicon.ico", &[]).code, 404);
    // A page of another site could take the few places for listeners.
    for path in ["/events", "/state.json", "/history.json"] {
        let refused = get(&client, path, &["Origin: http://evil.example"]);
        assert_eq!(refused.code, 403);
    }
}

#[test]
fn no_answer_holds_a_hidden_value() {
    let robot = Robot::start_with(Mode::Core, &["--hide-values", "^/login|pin$"]);
    let client = robot.client();
    let list = ros1_master::xmlrpc::Value::Array(vec![tree! { "pin" => SECRET }]);
    client.set_param("/login", tree! { "user" => SECRET });
    client.set_param(
        "/door",
        tree! { "PIN" => SECRET, "list" => list, "password" => "shown" },
    );
    let (mut wire, _) = listen(robot.port());
    for path in [
        "/",
        "/status.json",
        "/metrics",
        "/state.json",
        "/state.json?params=/login",
        "/state.json?params=/door",
        "/state.json?search=pin",
        "/state.json?search=log",
        "/state.json?search=hunter2",
        "/history.json",
    ] {
        let page = get(&client, path, &["Accept: text/html"]).text();
        assert!(
            !page.replace("filter=hunter2", "").contains(SECRET),
            "{path}: {page}"
        );
    }
    let door = json(&client, "/state.json?params=/door");
    assert!(door.to_string().contains("shown"), "{door}");
    assert!(!String::from_utf8_lossy(&wire.some().unwrap()).contains(SECRET));
}

#[test]
fn an_invalid_pattern_is_refused_with_one_sentence() {
    let scratch = Scratch::new();
    for command in ["core", "proxy"] {
        let mut rescue = Setup::bare(&scratch, [command, "--hide-values", "a(b"])
            .env("ROSRESCUE_MASTER", "http://127.0.0.1:1")
            .spawn();
        assert_eq!(rescue.wait_output().code(), Some(2));
        let said = rescue.stderr().join("\n");
        assert!(
            said.contains("--hide-values") && said.contains("unclosed group"),
            "{said}"
        );
    }
}

#[test]
fn many_parameters_are_sent_in_parts() {
    let robot = Robot::start_with(Mode::Core, &["--no-rosout"]);
    let client = robot.client();
    let many =
        (0..20_000).map(|index| (format!("p{index}"), ros1_master::xmlrpc::Value::Int(index)));
    client.set_param("/many", ros1_master::xmlrpc::Value::Struct(many.collect()));
    client.set_param("/few", 1);
    let page = get(&client, "/state.json", &[]);
    assert!(page.body.len() < 10_000, "{} bytes", page.body.len());
    let state: Value = serde_json::from_slice(&page.body).unwrap();
    let many = state["params"]["members"].as_array().unwrap();
    let many = many.iter().find(|member| member["name"] == "many").unwrap();
    assert_eq!(many["count"], 20_000);
    let part = json(&client, "/state.json?params=%2Fmany");
    assert_eq!(part["members"].as_array().unwrap().len(), 1000);
    assert_eq!(part["more"], 19_000);
    assert_eq!(
        json(&client, "/state.json?search=p17777")["members"][0]["value"],
        "17777"
    );
    assert_eq!(get(&client, "/state.json?params=/none", &[]).code, 404);
}

#[test]
fn a_limited_number_of_listeners_gets_every_change() {
    let mut robot = Robot::start(Mode::Core);
    let mut listeners: Vec<_> = (0..16).map(|_| listen(robot.port())).collect();
    for (_, head) in &listeners {
        assert_eq!(head.header("content-type"), Some("text/event-stream"));
    }
    let (_, refused) = listen(robot.port());
    assert_eq!(refused.code, 503);
    let (wire, _) = &mut listeners[0];
    let mut heard = String::new();
    let mut hears = |what: &str, words: &[&str]| {
        eventually(what, || {
            heard += &String::from_utf8_lossy(&wire.some().unwrap());
            words.iter().all(|word| heard.contains(word))
        });
    };
    hears(
        "the status and the figures",
        &["event: status\n", "event: now\n", r#""name":"protected""#],
    );
    robot.client().set_param("/new", 1);
    robot.crash_master();
    hears(
        "the rescue",
        &[r#""standing_in"#, r#""outcome":"injected""#],
    );
    // A listener that disconnects makes room.
    listeners.truncate(15);
    eventually("there is room again", || listen(robot.port()).1.code == 200);
    assert!(robot.rescue.terminate().success(), "nobody is waited for");
}

/// Events for them go into the kernel's buffers, which hold hours of them.
#[test]
fn listeners_that_never_read_do_not_keep_others_out() {
    let robot = Robot::start_with(Mode::Core, &["--no-rosout"]);
    let _listeners: Vec<_> = (0..16).map(|_| listen(robot.port())).collect();
    eventually("there is room for another one", || {
        listen(robot.port()).1.code == 200
    });
}

/// A dashboard with a wrong metric shows nothing, and an alert with a wrong metric never fires.
#[track_caller]
fn assert_every_metric_of_the_examples_exists(metrics: &str) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    // The metrics of several computers are only in the source.
    let source = fs::read_to_string(root.join("src/status/metrics.rs")).unwrap();
    let mut seen = 0;
    for file in ["grafana/rosrescue.json", "prometheus/alerts.yaml"] {
        let file = root.join("examples").join(file);
        let text = fs::read_to_string(&file).unwrap();
        for (at, _) in text.match_indices("rosrescue_") {
            let rest = text.split_at(at).1;
            let end = rest.find(|c: char| !c.is_ascii_lowercase() && c != '_');
            let name = rest.split_at(end.unwrap()).0;
            let is_there = [" ", "{"]
                .iter()
                .any(|end| metrics.contains(&format!("\n{name}{end}")));
            let of_several = name.strip_prefix("rosrescue_").is_some_and(|name| {
                name.starts_with("cluster_") && source.contains(&format!("\"{name}\""))
            });
            assert!(
                is_there || of_several,
                "{} names {name}, which is not in:\n{metrics}",
                file.display()
            );
            seen += 1;
        }
    }
    assert!(seen > 25, "{seen}");
}

/// Runs a command that finds nothing wrong with `text`.
#[track_caller]
fn accepts(command: &mut Command, text: &str) {
    let output = feed(command, text.as_bytes());
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && said.is_empty(), "{said}");
}

#[test]
fn the_metrics_follow_the_conventions_and_those_of_the_examples_exist() {
    let mut robot = Robot::start_with(Mode::Core, &["--no-rosout"]);
    let client = robot.client();
    client.set_param("/one", 1);
    robot.crash_master();
    let plain = get(&client, "/metrics", &[]);
    let text = plain.text();
    assert_every_metric_of_the_examples_exists(&text);
    accepts(Command::new("promtool").args(["check", "metrics"]), &text);
    let alerts = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/examples/prometheus/alerts.yaml"
    );
    accepts(
        Command::new("promtool").args(["check", "rules", alerts]),
        "",
    );
    for line in [
        "rosrescue_build_info{version=\"",
        "rosrescue_worker_restarts_total 0",
        "rosrescue_call_duration_seconds_bucket{class=\"write\",le=\"+Inf\"} ",
        "process_cpu_seconds_total ",
        "process_resident_memory_bytes ",
        "process_virtual_memory_bytes ",
        "process_threads ",
        "process_open_fds ",
        "process_max_fds ",
        "process_start_time_seconds ",
    ] {
        assert!(text.contains(&format!("\n{line}")), "{line}\n{text}");
    }
    let writes = text.lines().find_map(|line| {
        line.strip_prefix("rosrescue_call_duration_seconds_count{class=\"write\"} ")
    });
    assert!(writes.is_some_and(|count| count != "0"), "{text}");
    // As Prometheus asks for it.
    let accept =
        "Accept: application/openmetrics-text;version=1.0.0;q=0.5,text/plain;version=0.0.4;q=0.3";
    let open = get(&client, "/metrics", &[accept]);
    assert_eq!(
        open.header("content-type"),
        Some("application/openmetrics-text; version=1.0.0; charset=utf-8")
    );
    let parse = "import sys; from prometheus_client.openmetrics.parser import text_string_to_metric_families as parse; \
                 assert len(list(parse(sys.stdin.read()))) > 40";
    accepts(
        Command::new("/usr/bin/python3").args(["-c", parse]),
        &open.text(),
    );
}
