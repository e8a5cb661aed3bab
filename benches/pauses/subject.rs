//! A master with clients and a stream, and what they see of its death.

use std::{
    fmt,
    thread::sleep,
    time::{Duration, Instant},
};

use clap::ValueEnum;

use crate::{
    caller::Caller,
    shared::support::{
        Client, FakeNode, Library, Mode, Node, Robot, Rosmaster, Scratch, State, encode_call,
        eventually, params,
    },
};

/// A span in which pauses are looked for: longer than any recovery, which is waited for in any case.
const SPAN: Duration = Duration::from_millis(500);
/// What the reader reads.
const PARAM: &str = "/pauses/value";

/// Who is in charge of the master.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Kind {
    /// `rosrescue core`.
    Core,
    /// `rosrescue proxy`.
    Proxy,
    /// Nobody but whoever starts it again.
    Bare,
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Core => "`rosrescue core`",
            Self::Proxy => "`rosrescue proxy`",
            Self::Bare => "bare rosmaster",
        })
    }
}

/// What was seen in one span. Times in milliseconds.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Window {
    pub(crate) read: f64,
    pub(crate) registration: f64,
    pub(crate) stream: f64,
    /// Calls that got no answer.
    pub(crate) failed: usize,
    /// Reads of a parameter that was set and is not any more.
    pub(crate) unset: usize,
    /// The nodes of the stream are unknown to the master.
    pub(crate) forgotten: bool,
}

#[derive(Debug)]
enum Master {
    Guarded(Box<Robot>),
    Bare(Scratch, Option<Rosmaster>, u16),
}

impl Master {
    fn start(kind: Kind) -> Self {
        match kind {
            Kind::Core => Self::Guarded(Box::new(Robot::start(Mode::Core))),
            Kind::Proxy => Self::Guarded(Box::new(Robot::start(Mode::Proxy))),
            Kind::Bare => {
                let scratch = Scratch::new();
                let master = Rosmaster::start(&scratch);
                let port = master.port;
                Self::Bare(scratch, Some(master), port)
            }
        }
    }

    /// What the nodes use.
    fn client(&self) -> Client {
        match self {
            Self::Guarded(robot) => robot.client(),
            Self::Bare(_, _, port) => Client::new(*port),
        }
    }

    fn node(&self, node: &str, arguments: &[&str]) -> Node {
        match self {
            Self::Guarded(robot) => robot.node(Library::Roscpp, node, arguments),
            Self::Bare(scratch, _, port) => {
                Node::start(scratch, Library::Roscpp, *port, node, arguments)
            }
        }
    }

    /// SIGKILL, and another one at once.
    fn kill(&mut self) {
        match self {
            Self::Guarded(robot) => {
                let dead = robot.master_pid();
                robot.kill_master();
                robot.revive_master();
                robot.await_recovery(dead);
            }
            Self::Bare(scratch, master, port) => {
                if let Some(mut dead) = master.take() {
                    dead.kill();
                }
                *master = Some(Rosmaster::start_at(scratch, *port));
            }
        }
    }
}

/// A master in use.
#[derive(Debug)]
pub(crate) struct Subject {
    // In the order of the drops.
    reader: Caller,
    registrar: Caller,
    /// Who the registrar registers: it answers when it is asked for a sign of life.
    _node: FakeNode,
    listener: Node,
    talker: Node,
    master: Master,
    kind: Kind,
}

impl Subject {
    pub(crate) fn start(kind: Kind) -> Self {
        let master = Master::start(kind);
        let client = master.client();
        client.set_param(PARAM, 1);
        let talker = master.node("talker", &["200", "quiet"]);
        // It says its longest pause every tenth of a second.
        let listener = master.node("listener", &["20"]);
        listener.wait_messages("/talker", 3);
        let node = FakeNode::start("/pauses");
        node.claim_publication("/pauses/topic", Some("std_msgs/String"));
        let topic = params![
            "/pauses",
            "/pauses/topic",
            "std_msgs/String",
            node.api.as_str()
        ];
        Self {
            reader: Caller::start(
                client.clone(),
                &encode_call("getParam", params!["/pauses", PARAM]),
            ),
            registrar: Caller::start(client, &encode_call("registerPublisher", topic)),
            _node: node,
            listener,
            talker,
            master,
            kind,
        }
    }

    pub(crate) fn kill_master(&mut self) {
        self.master.kill();
    }

    /// What the clients see while `event` takes place and for as long as it has consequences.
    pub(crate) fn window(&mut self, event: impl FnOnce(&mut Self)) -> Window {
        let said = self.listener.said("pause").len();
        let begin = Instant::now();
        event(self);
        let after = Instant::now();
        eventually("both clients are answered", || {
            [&self.reader, &self.registrar]
                .iter()
                .all(|caller| caller.answered_since(after))
        });
        sleep(SPAN.saturating_sub(begin.elapsed()));
        let (read, registered) = (
            self.reader.seen_since(begin),
            self.registrar.seen_since(begin),
        );
        // The line that is due next still tells of this span.
        let now = self.listener.said("pause").len();
        eventually("the stream flows", || {
            self.listener.said("pause").len() > now
        });
        let pauses = self.listener.said("pause");
        let pauses = pauses[said..].iter().map(|line| {
            let ms = line.split(' ').nth(1).expect("a number");
            ms.parse::<f64>().expect("a number")
        });
        let state = State::read(&self.master.client());
        self.listener.assert_no_gap("/talker");
        self.talker.assert_no_link_lost();
        Window {
            read: read.pause,
            registration: registered.pause,
            stream: pauses.fold(0.0, f64::max),
            failed: read.failed + registered.failed,
            unset: read.refused,
            forgotten: !["/talker", "/listener"]
                .iter()
                .all(|node| state.knows(node)),
        }
    }

    /// Sets the parameter again where that is nobody else's duty.
    pub(crate) fn repair(&mut self) {
        if self.kind == Kind::Bare {
            self.master.client().set_param(PARAM, 1);
        }
    }
}
