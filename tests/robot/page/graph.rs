//! Tests of the page's graph, in a real Chromium: people can read it, and it shows trouble at once.

use serde_json::Value;

use super::browser::{assert_clean, condition_is, draws, open, paper_robot};
use crate::support::{Browser, FakeNode, Mode, Robot};

/// The size of the smallest letters in the graph, in pixels of the screen.
const SMALLEST: &str = "Math.min(...[...document.querySelectorAll('#picture text, #picture button')].map((of) => \
    parseFloat(getComputedStyle(of).fontSize) * (of.getScreenCTM?.().a ?? 1)))";
/// Smallest letters that people can read.
const READABLE: f64 = 11.0;
const NODES: &str = "document.querySelectorAll('#picture .node').length";

/// A robot whose nodes have no processes, and whose master is never thought dead because the computer is busy. After
/// that, nodes would be checked, and count as dead.
fn paper(count: usize) -> Robot {
    let patient = ["--stand-in-after", "30000", "--probe-timeout", "30000"];
    let robot = Robot::start_with(Mode::Core, &[&["--no-rosout"][..], &patient].concat());
    paper_robot(&robot.client(), count);
    robot
}

fn click(of: &str) -> String {
    format!("{of}.dispatchEvent(new MouseEvent('click', {{bubbles: true}}))")
}

#[track_caller]
fn assert_readable(browser: &mut Browser, when: &str) {
    let smallest = browser.js(SMALLEST).as_f64().unwrap();
    assert!(smallest >= READABLE, "{smallest} px {when}");
}

#[test]
fn labels_of_45_nodes_can_be_read_on_any_screen() {
    let robot = paper(45);
    let mut browser = Browser::start(&robot.scratch);
    for (width, height) in [(1280, 900), (390, 844)] {
        browser.open("about:blank");
        browser.screen(width, height, false);
        open(&mut browser, &robot);
        browser.shows("all nodes", &format!("{NODES} === 45"));
        assert_readable(&mut browser, &format!("at {width} pixels"));
        browser.js("document.querySelector('#graph-topics').click()");
        browser.shows("topics, too", &draws("topic", "/camera/n0/out"));
        assert_readable(&mut browser, &format!("with topics at {width} pixels"));
        // What does not fit is scrolled in the graph, not in the page.
        assert_eq!(browser.js("document.documentElement.scrollWidth"), width);
        assert_clean(&browser, &robot);
    }
}

#[test]
fn of_many_nodes_an_overview_comes_first_and_then_one_nodes_neighbours() {
    // More than `LARGE` in `layout.js`.
    let robot = paper(130);
    let mut browser = Browser::start(&robot.scratch);
    browser.screen(1280, 900, false);
    open(&mut browser, &robot);
    browser.shows(
        "a tile for each node",
        &format!("document.querySelector('#picture .overview') && {NODES} === 130"),
    );
    assert_readable(&mut browser, "in the overview");
    browser.js(&click(&draws("node", "/arm/n2")));
    browser.shows(
        "the neighbours of a node",
        &format!("!document.querySelector('#picture .overview') && {NODES} > 2 && {NODES} < 20"),
    );
    assert!(browser.js(&draws("node", "/arm/n2")) != Value::Null);
    assert_readable(&mut browser, "in a neighbourhood");
    browser.js("document.querySelector('#graph-back').click()");
    browser.shows("all nodes again", &format!("{NODES} === 130"));

    // The whole graph, with all namespaces open.
    browser.js("document.querySelector('#graph-overview').click()");
    for space in ["arm", "base", "camera", "lidar", "planner"] {
        let space = draws("space", &format!("/{space}"));
        browser.shows("a folded namespace", &space);
        browser.js(&click(&space));
        browser.shows("it is open", &format!("!{space}"));
    }
    browser.shows("all nodes are drawn", &format!("{NODES} === 130"));
    assert_readable(&mut browser, "in the whole graph");

    // A few keys lead to each part of the page and to each node.
    for part in ["graph", "time", "lists"] {
        browser.open("about:blank");
        open(&mut browser, &robot);
        browser.shows("the overview", &format!("{NODES} === 130"));
        let mut keys = 0;
        while browser.js("document.activeElement.hash") != format!("#{part}") {
            browser.press("Tab");
            keys += 1;
            assert!(keys <= 5, "no link to {part}");
        }
        browser.press("Enter");
        browser.shows(
            "it has the focus",
            &format!("document.activeElement.id === '{part}'"),
        );
    }
    // One stop for all of the tiles.
    browser.js("document.querySelector('#graph-everything').focus()");
    browser.press("Tab");
    browser.shows("a tile", "document.activeElement.closest('#picture')");
    browser.press("Tab");
    browser.shows(
        "no other tile",
        "!document.activeElement.closest('#picture')",
    );
    assert_clean(&browser, &robot);
}

#[test]
fn a_death_recolours_a_box_where_it_is_and_marks_the_time_line() {
    let mut robot = Robot::start_with(Mode::Core, &["--no-rosout"]);
    let client = robot.client();
    let old = FakeNode::start("/again");
    old.publish(&client, "/scan", "x/Y");
    drop(old);
    let new = FakeNode::start("/again");
    new.publish(&client, "/scan", "x/Y");
    let doomed = FakeNode::start("/doomed");
    doomed.publish(&client, "/scan", "x/Y");
    let viewer = FakeNode::start("/viewer");
    viewer.subscribe(&client, "/scan", "x/Y");
    let mut browser = Browser::start(&robot.scratch);
    browser.screen(390, 844, true);
    open(&mut browser, &robot);
    browser.shows("the graph", "document.querySelector('#picture .line')");
    browser.js("window.drawn = document.querySelector('#picture svg'); window.layouts = performance.getEntriesByName('layout').length; 0");
    let same = "window.drawn === document.querySelector('#picture svg') \
                && performance.getEntriesByName('layout').length === window.layouts";
    let dead = format!(
        "{same} && {}.classList.contains('dead')",
        draws("node", "/doomed")
    );
    drop(doomed);
    browser.shows("the dead node is red in the same picture", &dead);
    // It comes before everything else, with its name.
    browser.shows("the condition is another one", &condition_is("Nodes died"));
    let banner = browser.js("document.querySelector('#condition').innerText");
    let banner = banner.as_str().unwrap();
    assert!(banner.contains("/doomed since"), "{banner}");
    assert_eq!(
        browser.js("document.querySelector('#condition').dataset.is"),
        "warn"
    );
    let first = "document.querySelector('#trouble').getBoundingClientRect()";
    browser.shows(
        "it is named on the first screen, right after the condition",
        &format!(
            "document.querySelector('#condition + #trouble').innerText.includes('/doomed') && {first}.bottom < 844"
        ),
    );
    let mark = |lane: &str| format!("document.querySelector('#lanes .{lane} .mark')");
    browser.shows("its mark on the time line", &mark("died"));
    let marked = browser.js(&format!("{}.dataset.at", mark("died")));

    // The rescue unregisters it.
    robot.crash_master();
    browser.shows(
        "it is unregistered",
        "document.querySelector('#trouble').innerText.includes('unregistered')",
    );
    browser.shows("and still where it was", &dead);

    // The time line marks deaths, restarts and rescues.
    browser.screen(1280, 900, false);
    for (lane, text) in [
        ("restarted", "/again restarted"),
        ("died", "/doomed died"),
        ("rescued", "rescue in "),
    ] {
        let shown = format!("{}.ariaLabel.includes('{text}')", mark(lane));
        browser.shows(&format!("a mark of {lane}"), &shown);
    }
    // The log has the node's end, which changed the state.
    let moved = format!("{}.dataset.at !== {marked}", mark("died"));
    browser.shows("the mark is where the node was unregistered", &moved);
    browser.js(&format!("{}.click()", mark("died")));
    browser.shows(
        "a mark shows what it changed",
        "document.querySelector('#time-changes').innerText.includes('node /doomed')",
    );
    assert_clean(&browser, &robot);
}
