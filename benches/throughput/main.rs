//! What rosrescue costs in daily life: calls through it against calls to a bare rosmaster.
//!
//! `cargo bench --bench throughput` prints calls a second and how long a call takes as Markdown. Both
//! masters are started in the same way and take turns; each client has one keep-alive connection and
//! calls as fast as it is answered. A plain relay before the bare master shows what any hop costs.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a bench ends at the first thing that goes wrong"
)]

mod relay;
#[path = "../shared/mod.rs"]
mod shared;

use std::{
    sync::Barrier,
    thread,
    time::{Duration, Instant},
};

use clap::Args;
use rosrescue::xmlrpc::Value;

use crate::shared::{
    machine,
    second::SecondMaster,
    support::{Client, Scratch, Setup, encode_call, eventually, free_port, http_request, params},
};

/// Compares rosrescue with a bare rosmaster.
#[derive(Debug, Args)]
struct Options {
    /// Numbers of connections at the same time
    #[arg(long, value_name = "COUNT,…", value_delimiter = ',', default_values_t = [1, 8, 64])]
    connections: Vec<usize>,
    /// Turns that each of the three has for each line of the table
    #[arg(long, value_name = "COUNT", default_value_t = 3)]
    turns: u32,
    /// Length of a turn in seconds
    #[arg(long, value_name = "SECONDS", default_value_t = 1.0)]
    seconds: f64,
}

fn main() {
    let Some(options) = shared::options::<Options>("throughput") else {
        return;
    };
    let scratch = Scratch::new();
    let master_port = free_port();
    let rescue = Setup::core(&scratch, master_port).start();
    let own = Client::new(master_port).master_pid().expect("a process id");
    let port = free_port();
    let mut command = SecondMaster::command(own, port, &scratch.path("bare"));
    let _bare = SecondMaster::spawn(&mut command);
    let bare = Client::new(port);
    eventually("the bare master answers", || bare.master_pid().is_some());
    let relayed = Client::new(relay::start(port).expect("a relay"));
    let proxied = rescue.client();
    for master in [&bare, &proxied] {
        master.set_param("/throughput/value", 1);
    }

    println!(
        "Calls a second; median and 99 % of their times in ms. On {}.\n",
        machine::describe()
    );
    println!(
        "| call | connections | bare rosmaster | plain relay | rosrescue | rosrescue / bare |"
    );
    println!("|---|--:|--:|--:|--:|--:|");
    for method in ["getPid", "getParam", "setParam", "registerPublisher"] {
        for &connections in &options.connections {
            let requests: Vec<_> = (0..connections)
                .map(|number| request(method, number))
                .collect();
            let mut calls = [const { Vec::new() }; 3];
            for _ in 0..options.turns {
                for (master, calls) in [&bare, &relayed, &proxied].into_iter().zip(&mut calls) {
                    calls.extend(turn(master, &requests, options.seconds));
                }
            }
            let ratio = calls[2].len() as f64 / calls[0].len() as f64;
            let seconds = options.seconds * f64::from(options.turns);
            let cells = calls.map(|calls| cell(calls, seconds)).join(" | ");
            println!("| {method} | {connections} | {cells} | {ratio:.2} |");
        }
    }
}

/// What client `number` sends.
fn request(method: &str, number: usize) -> Vec<u8> {
    let node = format!("/node_{number}");
    let parameters = match method {
        "getPid" => params![node],
        "getParam" => params![node, "/throughput/value"],
        "setParam" => {
            let key = format!("/throughput/of{node}");
            params![node, key, 1]
        }
        "registerPublisher" => {
            let (topic, api) = (
                format!("{node}/topic"),
                format!("http://127.0.0.1:{}/", 1 + number),
            );
            params![node, topic, "std_msgs/String", api]
        }
        other => panic!("no parameters for {other}"),
    };
    http_request(&encode_call(method, parameters))
}

/// How long each call took that was made within the time by as many clients as there are requests.
fn turn(master: &Client, requests: &[Vec<u8>], seconds: f64) -> Vec<Duration> {
    let start = Barrier::new(requests.len());
    let time = Duration::from_secs_f64(seconds);
    let client = |request: &[u8]| {
        let mut wire = master.connect().expect("a connection");
        let mut call = || {
            wire.send(request).expect("a call");
            wire.response().expect("an answer")
        };
        let first = call().reply();
        let rosrescue::xmlrpc::Reply::Value(Value::Array(fields)) = &first else {
            panic!("{first:?}");
        };
        assert_eq!(fields[0], Value::Int(1), "{first:?}");
        start.wait();
        let (begin, mut calls) = (Instant::now(), Vec::new());
        loop {
            let before = Instant::now();
            assert_eq!(call().code, 200);
            if begin.elapsed() > time {
                return calls;
            }
            calls.push(before.elapsed());
        }
    };
    thread::scope(|scope| {
        let clients: Vec<_> = requests
            .iter()
            .map(|request| scope.spawn(|| client(request)))
            .collect();
        let calls = clients
            .into_iter()
            .map(|client| client.join().expect("a client"));
        calls.flatten().collect()
    })
}

fn cell(mut calls: Vec<Duration>, seconds: f64) -> String {
    calls.sort();
    let at = |share: f64| {
        let place = (calls.len() as f64 * share) as usize;
        calls[place.min(calls.len() - 1)].as_secs_f64() * 1e3
    };
    let rate = calls.len() as f64 / seconds;
    format!("{rate:.0}/s, {:.2}, {:.2}", at(0.5), at(0.99))
}
