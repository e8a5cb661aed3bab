//! Values of parameters, which may be passwords, never appear in the log or on the status page.

use std::fs;

use ros1_master::xmlrpc::{Call, Value};

use crate::support::{
    Mode, Robot, encode_call, eventually, eventually_some, http_request, params, request, tree,
};

const SECRET: &str = "hunter2";

/// Logs every call, with values at every place where they can be, and through an outage.
#[test]
fn values_are_never_logged() {
    let mut robot = Robot::start_with(Mode::Core, &["-v"]);
    let client = robot.client();
    client.set_param("/alone", SECRET);
    client.set_param("/tree", tree! { "password" => SECRET });
    let several = [
        Call::new("setParam", params!["/c", "/m", SECRET]),
        Call::new("getParam", params!["/c", "/m"]),
        Call::new("noSuchMethod", params!["/c", SECRET]),
    ];
    client
        .call("system.multicall", Call::multicall(several).params)
        .unwrap();
    assert_eq!(client.param("/alone"), Some(SECRET.into()));
    // Calls that cannot be decoded, or that the master refuses.
    let call = String::from_utf8(encode_call("setParam", params!["/c", "/odd", SECRET])).unwrap();
    let typed = call.replace(SECRET, &format!("<int>{SECRET}</int>"));
    let document = &call[call.find("<methodCall").unwrap()..];
    let doctype = format!("<!DOCTYPE methodCall>{document}");
    for body in [&typed, &doctype, &call.replace("</params>", "")] {
        client.exchange(&http_request(body.as_bytes())).unwrap();
    }
    for header in ["Content-Type: text/plain", "Content-Encoding: br"] {
        let bytes = request("POST / HTTP/1.1", &[header], call.as_bytes());
        client.exchange(&bytes).unwrap();
    }
    // A change that the mirror does not know: a divergence. The calls above make rosrescue read the master, perhaps just
    // before it compares the answer.
    let mut number = 0;
    eventually("a divergence has been noticed", || {
        number += 1;
        let key = format!("/past/{number}");
        robot.bare().set_param(&key, SECRET);
        let api = "http://127.0.0.1:1/";
        let answer = client.ok("subscribeParam", params!["/c", api, key.as_str()]);
        assert_eq!(answer, SECRET.into());
        robot.counter("divergences") > 0
    });
    // Values that cannot be restored, and values that wait for the new master.
    client.set_param(
        "/large",
        tree! { "password" => SECRET, "number" => Value::BigInt("9".repeat(30)) },
    );
    let dead = robot.master_pid();
    robot.kill_master_at_once(dead);
    client.set_param("/alone", format!("{SECRET}2"));
    robot.await_recovery(dead);
    assert_eq!(client.param("/alone"), Some(format!("{SECRET}2").into()));

    for path in ["/", "/status.json", "/metrics"] {
        let page = request(&format!("GET {path} HTTP/1.1"), &[], b"");
        let page = client.exchange(&page).unwrap().text();
        assert!(!page.contains(SECRET), "{path}: {page}");
    }
    let checkpoint = robot.rescue.checkpoint();
    let report = eventually_some("a report is written", || {
        let files = fs::read_dir(checkpoint.parent().unwrap()).unwrap();
        let paths = files.map(|file| file.unwrap().path());
        let mut reports = paths.filter(|path| path.to_str().unwrap().contains(".report-"));
        fs::read_to_string(reports.next()?)
            .ok()
            .filter(|report| report.contains("/large"))
    });
    assert!(!report.contains(SECRET), "{report}");
    let log = robot.rescue.output();
    assert!(
        log.iter().any(|line| line.contains("setParam")),
        "every call is logged: {log:?}"
    );
    let leak = log.iter().find(|line| line.contains(SECRET));
    assert!(leak.is_none(), "{leak:?}");
}
