//! The page's time line: the state at an earlier moment, and what differs between two moments.

use serde_json::Value;

use super::browser::{assert_clean, draws, open};
use crate::support::{
    Browser, Client, FailingDisk, FakeNode, Mode, Robot, Scratch, Setup, Trouble, eventually,
    eventually_some, free_port, params, request, tree,
};

/// The status and the body of `/state.json` with this query.
fn state(client: &Client, query: &str) -> (u16, String) {
    let page = request(&format!("GET /state.json?{query} HTTP/1.1"), &[], b"");
    let page = client.exchange(&page).unwrap();
    (page.code, page.text())
}

/// The same. Asks again while rosrescue reads an earlier state for the browser, as the page does.
fn state_in_turn(client: &Client, query: &str) -> (u16, String) {
    eventually_some("rosrescue reads an earlier state", || {
        Some(state(client, query)).filter(|(code, _)| *code != 503)
    })
}

/// Moves a slider, like a user.
fn drag(browser: &mut Browser, slider: &str, value: &str) {
    browser.js(&format!(
        "document.querySelector('#{slider}').value = {value};\
         document.querySelector('#{slider}').dispatchEvent(new Event('input'))"
    ));
}

#[test]
fn the_time_line_shows_an_earlier_robot_and_what_has_changed() {
    let robot = Robot::start_with(Mode::Core, &["--no-rosout"]);
    let client = robot.client();
    let old = FakeNode::start("/old");
    old.publish(&client, "/scan", "x/Y");
    let viewer = FakeNode::start("/viewer");
    viewer.subscribe(&client, "/scan", "x/Y");
    client.set_param("/arm", tree! { "gain" => 1, "password" => "geheim" });
    let mut then = String::new();
    eventually("the log has the last of them", || {
        let (code, text) = state_in_turn(&client, "at=now");
        let json: Value = serde_json::from_str(&text).unwrap_or_default();
        then = json["at"].to_string();
        code == 200 && text.contains("gain")
    });
    // The fields of the time line have whole seconds.
    eventually("the clock has moved on", || {
        client.set_param("/tick", 1);
        client.ok("deleteParam", params!["/test", "/tick"]);
        let (_, text) = state_in_turn(&client, "at=now");
        let json: Value = serde_json::from_str(&text).unwrap();
        json["at"].as_f64().unwrap().floor() > then.parse::<f64>().unwrap().floor()
    });
    client.ok(
        "unregisterPublisher",
        params!["/old", "/scan", old.api.as_str()],
    );
    let new = FakeNode::start("/new");
    new.publish(&client, "/scan", "x/Y");
    client.set_param("/arm", tree! { "gain" => 2, "password" => "heikel" });

    let mut browser = Browser::start(&robot.scratch);
    browser.screen(1280, 900, false);
    open(&mut browser, &robot);
    browser.js("document.querySelector('#graph-topics').click()");
    browser.shows("the present robot", &draws("node", "/new"));
    let ask = |field: &str| {
        format!(
            "(() => {{ const [at, field] = [new Date(1000 * {then}), document.querySelector('#{field}')];\
             field.value = new Date(at - 60000 * at.getTimezoneOffset()).toISOString().slice(0, 19);\
             field.dispatchEvent(new Event('change')) }})()"
        )
    };
    browser.js(&ask("clock-at"));
    browser.shows("the node of that time", &draws("node", "/old"));
    browser.shows(
        "not the present one",
        &format!("!{}", draws("node", "/new")),
    );
    browser.shows(
        "the page says that this is not live",
        "document.querySelector('#time-note').textContent.startsWith('NOT LIVE')",
    );
    for (kind, name) in [("node", "/old"), ("topic", "/scan")] {
        browser.shows(
            "what has changed is marked",
            &format!("{}.classList.contains('changed')", draws(kind, name)),
        );
    }
    browser.shows(
        "what is the same is not",
        &format!(
            "!{}.classList.contains('changed')",
            draws("node", "/viewer")
        ),
    );
    browser.shows(
        "one line of two is marked",
        "document.querySelectorAll('#picture .line.changed').length === 1",
    );
    for text in ["/arm/gain: 1 -> 2", "node /new at"] {
        browser.shows(
            "the changes are listed",
            &format!("document.querySelector('#time-changes').textContent.includes('{text}')"),
        );
    }
    browser.shows(
        "the list has the node of that time",
        "document.querySelector('#list tr.changed').textContent.includes('/old')",
    );
    browser.js("document.querySelector('#tab-params').click()");
    browser.shows(
        "the parameters",
        "(document.querySelector('#list details').open = true) \
         && document.querySelector('#list').innerText.includes('gain: 1')",
    );
    browser.shows(
        "the changed one is marked",
        "document.querySelector('#list li.param.changed').textContent === 'gain: 1'",
    );

    // Only the comparison.
    browser.js("document.querySelector('#time-now').click()");
    browser.shows("now again", &draws("node", "/new"));
    browser.shows(
        "nothing is marked",
        "!document.querySelector('.changed') && !document.querySelector('#time-changes li')",
    );
    browser.js(&ask("clock-with"));
    browser.shows(
        "the present robot is marked",
        &format!("{}.classList.contains('changed')", draws("node", "/new")),
    );
    assert_clean(&browser, &robot);
    // Before the log begins. The browser reports the answer as an error.
    drag(&mut browser, "time-at", "0");
    browser.shows(
        "there is nothing",
        "document.querySelector('#time-note').textContent.includes('the log begins at')",
    );
    browser.shows("no node", &format!("!{}", draws("node", "/new")));
    drag(&mut browser, "time-at", "2000");
    browser.shows("the right end is now", &draws("node", "/new"));
    let markup = browser.js("document.documentElement.outerHTML");
    let markup = markup.as_str().unwrap();
    assert!(!markup.contains("geheim") && !markup.contains("heikel"));

    let (code, text) = state_in_turn(&client, "at=1999-01-01");
    assert!(code == 404 && text.contains("the log begins at"), "{text}");
    assert_eq!(state_in_turn(&client, "at=soon").0, 400);
    let (_, text) = state_in_turn(&client, "at=now&with=now&search=password");
    assert!(
        text.contains("\"hidden\":true") && !text.contains("heikel"),
        "{text}"
    );
}

#[test]
fn a_disk_that_does_not_answer_holds_up_one_earlier_state_and_no_call() {
    let scratch = Scratch::new();
    let disk = FailingDisk::new(&scratch);
    let setup = Setup::core(&scratch, free_port()).arg("--no-rosout");
    let rescue = disk.under(setup).start();
    let client = rescue.client();
    client.set_param("/before", 1);
    assert_eq!(state(&client, "at=now").0, 200);
    disk.begin(Trouble::HangsOnOpen);
    let (sender, answers) = std::sync::mpsc::sync_channel(2);
    for _ in 0..2 {
        let (sender, client) = (sender.clone(), client.clone());
        std::thread::spawn(move || sender.send(state(&client, "at=now")));
    }
    assert_eq!(answers.recv().unwrap().0, 503, "the other one is read");
    client.set_param("/during", 1);
    assert_eq!(client.param("/during"), Some(1.into()));
    assert_eq!(state(&client, "").0, 200);
    disk.heal();
    let (code, text) = answers.recv().unwrap();
    assert!(code == 200 && text.contains("before"), "{text}");
}
