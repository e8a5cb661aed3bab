//! Measures writes that notify nodes. rosmaster's threads do the notifying, under the same Python lock as its
//! answers.

use std::{thread, time::Duration};

use serde::Serialize;

use crate::shared::support::{
    Client, Rescue, Rosmaster, Scratch, Setup, free_port,
    links::{self, Place, Plan},
    writers::{SUBSCRIBERS, Subscriber, WRITERS, write},
};

/// Maximum pause between two calls of a writer.
const PAUSE: Duration = Duration::from_millis(4);

/// The master to measure. The number is that of the threads that notify: 3 in a usual rosmaster, 32 in that
/// of rosrescue.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Subject {
    Bare(&'static [&'static str]),
    Core(&'static [&'static str]),
    Proxy,
}

const SUBJECTS: [Subject; 5] = [
    Subject::Bare(&[]),
    Subject::Bare(&["-w", "32"]),
    Subject::Core(&[]),
    Subject::Core(&["--numworkers", "3"]),
    Subject::Proxy,
];

/// The results of one subject.
#[derive(Debug, Serialize)]
pub(crate) struct Writes {
    pub(crate) name: String,
    /// The time of each call in all turns, sorted, in milliseconds.
    pub(crate) calls_ms: Vec<f64>,
    pub(crate) calls_per_second: f64,
    /// Number of notifications that had arrived when the last call was answered.
    pub(crate) notifications: usize,
}

/// How long rospy nodes took until all had registered, in milliseconds.
#[derive(Debug, Serialize)]
pub(crate) struct Starts {
    pub(crate) name: String,
    pub(crate) ms: Vec<f64>,
}

/// The results of both measurements.
#[derive(Debug, Serialize)]
pub(crate) struct Notify {
    pub(crate) writes: Vec<Writes>,
    pub(crate) starts: Vec<Starts>,
}

/// Measures each subject for `seconds` in each of `turns` turns, and as many starts of rospy nodes.
pub(crate) fn measure(seconds: f64, turns: usize) -> Notify {
    let time = Duration::from_secs_f64(seconds);
    let mut writes: Vec<_> = SUBJECTS
        .iter()
        .map(|subject| Writes {
            name: subject.name(),
            calls_ms: Vec::new(),
            calls_per_second: 0.0,
            notifications: 0,
        })
        .collect();
    for turn in 0..turns {
        for place in 0..SUBJECTS.len() {
            let place = (place + turn) % SUBJECTS.len();
            let (calls, notifications) = SUBJECTS[place].write(time);
            let name = &writes[place].name;
            eprintln!(
                "{name}: {} calls, {notifications} notifications in {time:?}",
                calls.len()
            );
            writes[place].notifications += notifications;
            let ms = calls.iter().map(|time| time.as_secs_f64() * 1e3);
            writes[place].calls_ms.extend(ms);
        }
    }
    for writes in &mut writes {
        writes.calls_ms.sort_by(f64::total_cmp);
        writes.calls_per_second = writes.calls_ms.len() as f64 / seconds / turns as f64;
    }
    let places = [Place::Bare, Place::Core, Place::Proxy];
    let mut ms = places.map(|_| Vec::new());
    for turn in 0..turns {
        for place in 0..places.len() {
            let place = (place + turn) % places.len();
            let start = links::start(places[place], &Plan::default(), turn as u64);
            eprintln!(
                "{:?}: rospy nodes have registered after {:.0?}",
                places[place], start.time
            );
            ms[place].push(start.time.as_secs_f64() * 1e3);
        }
    }
    let starts = ["bare rosmaster", "rosrescue core", "rosrescue proxy"]
        .into_iter()
        .zip(ms);
    let starts = starts.map(|(name, ms)| Starts {
        name: name.to_owned(),
        ms,
    });
    Notify {
        writes,
        starts: starts.collect(),
    }
}

impl Subject {
    fn name(self) -> String {
        let (name, arguments) = match self {
            Self::Bare(arguments) => ("bare rosmaster", arguments),
            Self::Core(arguments) => ("rosrescue core", arguments),
            Self::Proxy => ("rosrescue proxy", [].as_slice()),
        };
        let arguments = arguments.join(" ");
        match arguments.is_empty() {
            true => name.to_owned(),
            false => format!("{name} `{arguments}`"),
        }
    }

    /// Runs six writers for `time`. Returns the times of their calls, and how many notifications had arrived
    /// then.
    fn write(self, time: Duration) -> (Vec<Duration>, usize) {
        let scratch = Scratch::new();
        let port = free_port();
        let master = |arguments: &[&str]| {
            let master = Rosmaster::start_with(&scratch, port, |command| {
                command.args(arguments);
            });
            Some(master)
        };
        let (_master, rescue) = match self {
            Self::Bare(arguments) => (master(arguments), None),
            Self::Core(arguments) => {
                let setup = Setup::core(&scratch, port).arg("--no-rosout");
                (None, Some(setup.args(arguments)))
            }
            Self::Proxy => (master(&[]), Some(Setup::proxy(&scratch, port))),
        };
        let rescue = rescue.map(|setup| setup.guarded().start());
        let client = &rescue
            .as_ref()
            .map_or_else(|| Client::new(port), Rescue::client);
        let subscribers = Subscriber::start_all(client);
        let calls = thread::scope(|scope| {
            let start = |writer| scope.spawn(move || write(client, writer, 1, PAUSE, time));
            let writers: Vec<_> = (0..WRITERS).map(start).collect();
            let calls = writers.into_iter().map(|writer| writer.join().unwrap());
            calls.flatten().collect()
        });
        (calls, subscribers.iter().map(Subscriber::count).sum())
    }
}

impl Writes {
    /// The share of all notifications that had arrived.
    pub(crate) fn told(&self) -> f64 {
        self.notifications as f64 / (SUBSCRIBERS * self.calls_ms.len()) as f64
    }
}
