//! The best that anybody could do: the same rosmaster started by somebody who knows everything before,
//! and brought to the state by a single call.

use std::{
    thread::sleep,
    time::{Duration, Instant},
};

use rosrescue::xmlrpc::{self, Value};

use crate::{
    robot::Robot,
    shared::{
        injection::injection,
        second::SecondMaster,
        support::{Wire, free_port, http_request},
    },
};

/// Pause between two looks at whether the port is open. A shorter one slows down what is waited for.
const PAUSE: Duration = Duration::from_millis(1);
/// How long a rosmaster may take to listen.
const PATIENCE: Duration = Duration::from_secs(30);

/// In milliseconds.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Limit {
    /// From the start of the process to its open port.
    pub(crate) start: f64,
    /// From there to the reply to one compact multicall that brings the whole state.
    pub(crate) injection: f64,
}

impl Limit {
    /// From nothing to the whole state.
    pub(crate) fn total(self) -> f64 {
        self.start + self.injection
    }
}

/// Starts a second rosmaster just as rosrescue started the robot's and brings it to the same state.
/// Nothing is looked at or compared. No node notices: in this order no master calls any.
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
            Err(error) => assert!(begin.elapsed() < PATIENCE, "no rosmaster: {error}"),
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
