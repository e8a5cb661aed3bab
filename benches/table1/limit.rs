//! The best possible recovery: the same rosmaster, started by a program that knows everything in advance and
//! gives it the state in a single call.

use std::{
    thread::sleep,
    time::{Duration, Instant},
};

use ros1_master::xmlrpc::{self, Value};

use crate::{
    robot::Robot,
    shared::{
        injection::injection,
        second::SecondMaster,
        support::{Wire, free_port, http_request},
    },
};

/// Pause between two checks whether the port is open. A shorter pause would slow down what is measured.
const PAUSE: Duration = Duration::from_millis(1);
/// Maximum time for a rosmaster to listen.
const PATIENCE: Duration = Duration::from_secs(30);

/// The times of the best possible recovery, in milliseconds.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Limit {
    /// From the start of the process to its open port.
    pub(crate) start: f64,
    /// From the open port to the reply to one compact multicall with the whole state.
    pub(crate) injection: f64,
}

impl Limit {
    /// From the start of the process to the whole state.
    pub(crate) fn total(self) -> f64 {
        self.start + self.injection
    }
}

/// Starts a second rosmaster exactly as rosrescue has started the robot's, and gives it the same state.
/// Nothing is read back or compared. No node notices, because a master notifies no node when calls come in
/// this order.
pub(crate) fn measure(robot: &Robot) -> Limit {
    let request = http_request(&injection(&robot.state()));
    let port = free_port();
    let log = robot.scratch.path("limit");
    let mut command = SecondMaster::command(robot.master_pid(), port, &log);

    let begin = Instant::now();
    let _master = SecondMaster::spawn(&mut command);
    let mut wire = loop {
        match Wire::connect("127.0.0.1", port) {
            Ok(wire) => break wire,
            Err(error) => assert!(
                begin.elapsed() < PATIENCE,
                "rosmaster does not listen: {error}"
            ),
        }
        sleep(PAUSE);
    };
    let start = begin.elapsed();
    wire.send(&request).expect("a call");
    let reply = wire.response().expect("an answer");
    let total = begin.elapsed();

    let results = reply.reply();
    let failed = |result: &&Value| result.as_array().is_none();
    let xmlrpc::Reply::Value(Value::Array(results)) = &results else {
        panic!("{results:?}");
    };
    assert_eq!(results.iter().find(failed), None);
    let ms = |duration: Duration| duration.as_secs_f64() * 1e3;
    Limit {
        start: ms(start),
        injection: ms(total.saturating_sub(start)),
    }
}
