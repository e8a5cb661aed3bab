//! The new master dies at every single call of the injection, alone or in the middle of more deaths.
//! The one that lives has the exact state, whatever came before.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

mod support;

use rosrescue::xmlrpc::{Call, Value};
use support::{
    Client, Rescue, Scratch, Setup, State, Zygote, eventually, free_port, params, status,
};

/// Calls that a master gets before the injection: the look.
const LOOK: usize = 5;

/// rosrescue proxy before masters that this test starts.
struct Ward {
    rescue: Rescue,
    zygote: Zygote,
    port: u16,
    #[allow(dead_code, reason = "its drop ends everything")]
    scratch: Scratch,
}

impl Ward {
    fn new() -> Self {
        let scratch = Scratch::new();
        let mut zygote = Zygote::new(&scratch);
        let port = free_port();
        zygote.start(port, "");
        // Nobody is asked for signs of life: the nodes are names only.
        let rescue = Setup::proxy(&scratch, port)
            .args(["--census-timeout", "10", "--hold", "60"])
            .start();
        Self {
            rescue,
            zygote,
            port,
            scratch,
        }
    }

    fn bare(&self) -> Client {
        Client::new(self.port)
    }

    fn await_open(&self, pid: u32) {
        let client = self.rescue.client();
        eventually("the gate is open to the new master", || {
            let status = status(&client);
            status["open"] == true && status["last_recovery"]["master_pid"] == pid
        });
    }

    /// A master that has the state when this returns.
    fn live(&mut self) -> u32 {
        let pid = self.zygote.start(self.port, "");
        self.await_open(pid);
        pid
    }

    fn assert_nothing_set_aside(&self) {
        let status = status(&self.rescue.client());
        assert_eq!(status["set_aside"].as_array().map(Vec::len), Some(0));
    }

    /// A master that dies of this.
    fn die(&mut self, sickness: &str) {
        let pid = self.zygote.start(self.port, sickness);
        self.zygote.wait(pid);
    }
}

/// Calls that make a state for which an injection takes some 300.
fn state() -> Vec<Call> {
    let mut calls = Vec::new();
    let mut add = |method: &str, params: &[&str]| {
        let params = params.iter().map(|text| Value::from(*text)).collect();
        calls.push(Call::new(method, params));
    };
    for i in 0..5 {
        // Addresses of an unusable scheme: nobody can be called back, so nobody is found dead.
        let (node, api) = (format!("/n{i}"), format!("rosrpc://n{i}:1/"));
        for j in 0..16 {
            add(
                "registerPublisher",
                &[&node, &format!("/t{i}_{}", j % 14), "a/B", &api],
            );
            add(
                "registerSubscriber",
                &[&node, &format!("/t{j}_{i}"), "a/B", &api],
            );
        }
        for j in 0..3 {
            let service_api = format!("rosrpc://n{i}:{j}");
            add(
                "registerService",
                &[&node, &format!("/s{i}_{j}"), &service_api, &api],
            );
        }
        for j in 0..5 {
            add("subscribeParam", &[&node, &api, &format!("/p{j}")]);
        }
    }
    for i in 0..20 {
        let key = format!("/p{}/q{i}", i % 7);
        calls.push(Call::new("setParam", params!["/n0", key, i]));
    }
    calls
}

/// rosrescue with a state, and the state.
fn ward_with_state() -> (Ward, State) {
    let ward = Ward::new();
    let client = ward.rescue.client();
    for call in state() {
        client.ok(&call.method, call.params);
    }
    let before = State::read(&ward.bare());
    (ward, before)
}

#[test]
fn at_every_call() {
    let (mut ward, before) = ward_with_state();
    let mut pid = ward.bare().master_pid().unwrap();
    let mut number = LOOK;
    loop {
        number += 1;
        ward.zygote.kill(pid);
        let sick = ward.zygote.start(ward.port, &format!("call {number}"));
        let client = ward.rescue.client();
        let mut lives = None;
        eventually("the master has died or has the state", || {
            let status = status(&client);
            let whole = status["open"] == true && status["last_recovery"]["master_pid"] == sick;
            lives = (whole || !support::alive(sick)).then_some(whole);
            lives.is_some()
        });
        if lives == Some(true) {
            ward.zygote.kill(sick);
            break;
        }
        ward.zygote.wait(sick);
        pid = ward.live();
        let when = format!("after a death at call {number}");
        before.assert_same(&State::read(&ward.bare()), &when);
    }
    ward.live();
    before.assert_same(&State::read(&ward.bare()), "at the end");
    println!("{} calls in an injection", number - LOOK - 1);
    assert!(
        number - LOOK >= 300,
        "the injection had only {number} calls"
    );
    ward.assert_nothing_set_aside();
}

/// From the third death on the state is given entry by entry.
#[test]
fn many_times_in_a_row() {
    let (mut ward, before) = ward_with_state();
    let mut pid = ward.bare().master_pid().unwrap();
    for (number, deaths) in (LOOK + 1..340).step_by(9).zip((3..=7).cycle()) {
        ward.zygote.kill(pid);
        // At the same call, or at another one each time.
        for death in 0..deaths {
            let call = match deaths % 2 {
                0 => number,
                _ => LOOK + 1 + (number * (death + 1) * 31) % 250,
            };
            ward.die(&format!("call {call}"));
        }
        pid = ward.live();
        let when = format!("after {deaths} deaths about call {number}");
        before.assert_same(&State::read(&ward.bare()), &when);
    }
    ward.assert_nothing_set_aside();
}

/// Somebody else starts the masters: their crash loop is said too, and a record that kills is found.
#[test]
fn a_record_that_kills_the_masters_of_others() {
    let (mut ward, before) = ward_with_state();
    let client = ward.rescue.client();
    let pid = ward.bare().master_pid().unwrap();
    ward.zygote.kill(pid);
    for _ in 0..4 {
        ward.die("name /s2_1");
    }
    assert_eq!(status(&client)["crash_loop"], false);
    let pid = ward.zygote.start(ward.port, "name /s2_1");
    ward.await_open(pid);
    let mut after = before.clone();
    after.services.retain(|(name, _)| name != "/s2_1");
    after.service_apis.retain(|(name, _)| name != "/s2_1");
    after.assert_same(&State::read(&ward.bare()), "without the service that kills");
    let status = status(&client);
    assert_eq!(status["set_aside"][0], "the service `/s2_1` of `/n2`");
    assert_eq!(status["deaths"], 5);
    assert_eq!(
        status["crash_loop"], false,
        "five deaths in a minute are none"
    );
}

#[test]
fn the_crash_loop_of_somebody_elses_master() {
    let (mut ward, before) = ward_with_state();
    let client = ward.rescue.client();
    let mut pid = ward.bare().master_pid().unwrap();
    for _ in 0..6 {
        ward.zygote.kill(pid);
        pid = ward.live();
    }
    eventually("the status says crash loop", || {
        status(&client)["crash_loop"] == true
    });
    ward.rescue.wait_line("the crash loop", |line| {
        line.contains("crash loop: the master has died")
    });
    before.assert_same(&State::read(&ward.bare()), "in the crash loop");
    eventually("it is over", || status(&client)["crash_loop"] == false);
    assert_eq!(status(&client)["open"], true);
}
