//! Measures deaths of rosrescue itself: of the worker alone, and of worker and master at once. Without a death it
//! measures what the computer's load does to callers.

use std::{process::Command, time::Duration};

use clap::ValueEnum;
use rustix::process::Signal;

use crate::{
    KILLS_A_LIFE,
    shared::{
        caller::{Caller, Seen},
        nodes,
        support::{
            Client, FakeNode, Process, Rescue, Scratch, Setup, encode_call, eventually, free_port,
            params, signal, status,
        },
    },
};

/// Pause between two deaths, so that each one happens while the robot works normally.
const REST: Duration = Duration::from_millis(500);

/// The processes to kill.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Victims {
    Nobody,
    Worker,
    Both,
}

/// How long callers are watched without a death.
const WATCH: Duration = Duration::from_secs(2);

/// What a reader and a writer saw of one death.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Death {
    pub(crate) read: Seen,
    pub(crate) write: Seen,
}

struct Stage {
    reader: Caller,
    writer: Caller,
    rescue: Rescue,
    bare: Client,
    _nodes: Vec<FakeNode>,
    _scratch: Scratch,
}

impl Stage {
    fn start(count: usize) -> Self {
        let (scratch, master_port) = (Scratch::new(), free_port());
        // The default, unlike in most tests.
        let setup = Setup::core(&scratch, master_port).env("ROSRESCUE_STAND_IN_AFTER", "100");
        let setup = setup.arg("--no-rosout");
        let rescue = setup.guarded().start();
        let client = rescue.client();
        client.set_param("/deaths/value", 1);
        let nodes = nodes::synthetic(&client, count);
        let read = |_| encode_call("getParam", params!["/deaths", "/deaths/value"]);
        let write = |number| encode_call("setParam", params!["/deaths", "/deaths/count", number]);
        Self {
            reader: Caller::start(client.clone(), read),
            writer: Caller::start(client, write),
            rescue,
            bare: Client::new(master_port),
            _nodes: nodes,
            _scratch: scratch,
        }
    }

    fn worker(&self) -> u32 {
        let pid = status(&self.rescue.client())["pid"].as_u64();
        u32::try_from(pid.expect("a process id")).expect("a process id")
    }

    fn kill(&self, victims: Victims) -> Death {
        std::thread::sleep(REST);
        let (worker, master) = (self.worker(), self.bare.master_pid().expect("a master"));
        let begin = std::time::Instant::now();
        if victims == Victims::Nobody {
            std::thread::sleep(WATCH);
        } else {
            if victims == Victims::Both {
                signal(master, Signal::KILL);
            }
            signal(worker, Signal::KILL);
            eventually("calls pass to a master again", || {
                let client = self.rescue.client();
                let served = client.master_pid().is_some() && status(&client)["open"] == true;
                let other = victims == Victims::Worker || self.bare.master_pid() != Some(master);
                served && other && self.worker() != worker
            });
        }
        Death {
            read: self.reader.seen_since(begin),
            write: self.writer.seen_since(begin),
        }
    }
}

/// Measures deaths of `victims`, with registered nodes and with `load` busy processes beside them.
pub(crate) fn measure(victims: Victims, count: usize, nodes: usize, load: usize) -> Vec<Death> {
    let busy = |_| {
        let mut command = Command::new("sh");
        Process::start("busy", command.args(["-c", "while :; do :; done"]))
    };
    let _busy: Vec<_> = (0..load).map(busy).collect();
    let mut deaths = Vec::new();
    while deaths.len() < count {
        let stage = Stage::start(nodes);
        for _ in 0..KILLS_A_LIFE.min(count - deaths.len()) {
            let death = stage.kill(victims);
            eprintln!(
                "{victims:?}: read {:.1}, write {:.1}",
                death.read.pause, death.write.pause
            );
            deaths.push(death);
        }
    }
    deaths
}
