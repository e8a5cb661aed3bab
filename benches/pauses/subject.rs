//! A master with nodes and clients, and what the clients notice of its death.

use std::{
    fmt,
    thread::sleep,
    time::{Duration, Instant},
};

use clap::ValueEnum;

use crate::shared::{
    caller::{Caller, Seen},
    injection::injection,
    nodes,
    second::SecondMaster,
    support::{
        Client, FakeNode, Mode, Robot, Rosmaster, Scratch, State, encode_call, eventually,
        free_port, http_request, params,
    },
};

/// The time in which pauses are observed. It is longer than any recovery, and the bench waits for the recovery in any
/// case.
const SPAN: Duration = Duration::from_millis(500);
/// The parameter that the reader reads.
const READ: &str = "/pauses/value";
/// The parameter that the writer sets.
const WRITTEN: &str = "/pauses/count";
/// The parameter to which the logger subscribes again and again. It is not set.
const UNSET: &str = "/rosout_disable_topics_generation";
/// Pause between two registrations of a publisher while there is no master.
const REGISTRATIONS: Duration = Duration::from_secs(1);
/// Pause between two checks whether a subscriber was notified, which is the accuracy of that result.
const LOOK: Duration = Duration::from_micros(200);

/// Which program restarts the master.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Kind {
    /// `rosrescue core`.
    Core,
    /// `rosrescue proxy`.
    Proxy,
    /// A loop in this bench
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

/// What each client saw in one span of time.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Window {
    pub(crate) read: Seen,
    pub(crate) write: Seen,
    /// The client whose writes change nothing.
    pub(crate) idle: Seen,
}

#[derive(Debug)]
enum Master {
    Guarded(Box<Robot>),
    Bare(Scratch, Option<Box<Rosmaster>>, u16),
}

impl Master {
    fn start(kind: Kind) -> Self {
        match kind {
            Kind::Core => Self::Guarded(Box::new(Robot::start_for_outages(Mode::Core))),
            Kind::Proxy => Self::Guarded(Box::new(Robot::start_for_outages(Mode::Proxy))),
            Kind::Bare => {
                let scratch = Scratch::new();
                let master = Rosmaster::start(&scratch);
                let port = master.port;
                Self::Bare(scratch, Some(Box::new(master)), port)
            }
        }
    }

    /// A client of the port that nodes use.
    fn client(&self) -> Client {
        match self {
            Self::Guarded(robot) => robot.client(),
            Self::Bare(_, _, port) => Client::new(*port),
        }
    }

    fn robot(&mut self) -> &mut Robot {
        match self {
            Self::Guarded(robot) => robot,
            Self::Bare(..) => panic!("a bare master has no rosrescue"),
        }
    }

    /// Kills the master with SIGKILL. Another one is started at once.
    fn kill(&mut self) {
        match self {
            Self::Guarded(robot) => {
                let dead = robot.master_pid();
                robot.kill_master_at_once(dead);
                robot.revive_proxied_master();
                robot.await_recovery(dead);
            }
            Self::Bare(scratch, master, port) => {
                if let Some(mut dead) = master.take() {
                    dead.kill();
                }
                *master = Some(Box::new(Rosmaster::start_at(scratch, *port)));
            }
        }
    }
}

/// A master in use.
#[derive(Debug)]
pub(crate) struct Subject {
    // Fields are dropped in this order.
    reader: Caller,
    writer: Caller,
    logger: Caller,
    nodes: Vec<FakeNode>,
    master: Master,
    kind: Kind,
}

impl Subject {
    /// Starts a master with `count` nodes.
    pub(crate) fn start(kind: Kind, count: usize) -> Self {
        let master = Master::start(kind);
        let client = master.client();
        client.set_param(READ, 1);
        let nodes = nodes::synthetic(&client, count);
        let own = nodes[0].api.clone();
        let name = nodes[0].name.clone();
        let reader = |_| encode_call("getParam", params!["/pauses", READ]);
        let writer = |number| encode_call("setParam", params!["/pauses", WRITTEN, number]);
        let logger = move |_| {
            encode_call(
                "subscribeParam",
                params![name.as_str(), own.as_str(), UNSET],
            )
        };
        Self {
            reader: Caller::start(client.clone(), reader),
            writer: Caller::start(client.clone(), writer),
            logger: Caller::start(client, logger),
            nodes,
            master,
            kind,
        }
    }

    pub(crate) fn kill_master(&mut self) {
        self.master.kill();
    }

    /// What the clients observe while `event` takes place and as long as it has consequences.
    pub(crate) fn window(&mut self, event: impl FnOnce(&mut Self)) -> Window {
        let begin = Instant::now();
        event(self);
        let after = Instant::now();
        eventually("all clients have been answered", || {
            [&self.reader, &self.writer, &self.logger]
                .iter()
                .all(|caller| caller.answered_since(after))
        });
        sleep(SPAN.saturating_sub(begin.elapsed()));
        Window {
            read: self.reader.seen_since(begin),
            write: self.writer.seen_since(begin),
            idle: self.logger.seen_since(begin),
        }
    }

    /// Sets the parameter again if rosrescue does not restore it.
    pub(crate) fn repair(&mut self) {
        if self.kind == Kind::Bare {
            self.master.client().set_param(READ, 1);
        }
    }

    /// The time in milliseconds of one compact multicall that gives the master's state to another rosmaster,
    /// started in the same way. Nothing is read back or compared.
    pub(crate) fn bare_injection(&mut self) -> f64 {
        let robot = self.master.robot();
        let request = http_request(&injection(&robot.state()));
        let port = free_port();
        let log = robot.scratch.path("bare");
        let mut command = SecondMaster::command(robot.master_pid(), port, &log);
        let _master = SecondMaster::spawn(&mut command);
        let client = Client::new(port);
        eventually("a second rosmaster answers", || {
            client.master_pid().is_some()
        });
        let mut wire = client.connect().expect("a connection");
        let begin = Instant::now();
        wire.send(&request).expect("a call");
        wire.response().expect("an answer");
        ms(begin.elapsed())
    }

    /// What the clients observe while there is no master for `away`. Also the times, in milliseconds, from each
    /// publisher's registration during the outage until a subscriber knows it.
    pub(crate) fn outage(&mut self, away: Duration) -> (Window, Vec<f64>) {
        let client = self.master.client();
        let subscriber = FakeNode::start("/pauses_subscriber");
        let mut notified = Vec::new();
        let dead = self.master.robot().master_pid();
        let window = self.window(|subject| {
            let robot = subject.master.robot();
            robot.kill_master();
            eventually("the mirror stands in", || !robot.is_open());
            let end = Instant::now() + away;
            for number in 0.. {
                let next = Instant::now() + REGISTRATIONS;
                if next > end {
                    break;
                }
                let topic = format!("/pauses/topic_{number}");
                subscriber.subscribe(&client, &topic, "std_msgs/String");
                let publisher = &subject.nodes[number % subject.nodes.len()];
                let begin = Instant::now();
                publisher.publish(&client, &topic, "std_msgs/String");
                while subscriber.updates(&topic).is_empty() {
                    sleep(LOOK);
                }
                notified.push(ms(begin.elapsed()));
                sleep(next.saturating_duration_since(Instant::now()));
            }
            sleep(end.saturating_duration_since(Instant::now()));
        });
        let robot = self.master.robot();
        robot.revive_master();
        robot.await_recovery(dead);
        let (mirror, held) = (State::read(&robot.client()), robot.state());
        let counted = mirror.with_params_of(&held);
        counted.assert_same(&held, "after the outage");
        (window, notified)
    }
}

fn ms(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}
