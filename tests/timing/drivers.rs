//! Drivers of robots that log at 10 Hz and run `diagnostic_updater` at 4 Hz. Both call `subscribeParam` each
//! time, because rospy does not cache a parameter that is not set. None of their loops stalls, whatever
//! happens to the master, and no exception reaches them.
//!
//! The limit is [`PASS`], or [`NOISE`] times what the same driver takes at the same time with an undisturbed
//! bare rosmaster if that is longer, because starting rosmasters takes all cores of a small computer. If a driver stalls
//! and the undisturbed one is not [`CALM`] either, the computer is busy and the event is repeated.
//!
//! `ROSRESCUE_LOOP_SECONDS` sets the length of a crash loop; the full length is 600. `ROSRESCUE_HANGS` sets how often a
//! master hangs; on a computer without other load none of 20 should make a pass longer than 150 ms.

use std::{
    thread::sleep,
    time::{Duration, Instant},
};

use crate::support::{
    Library, Mode, Node, Robot, Rosmaster, Scratch, eventually, in_both_modes, signal, stop,
};
use rustix::process::Signal;

/// Maximum time of one pass of a driver's loop, in milliseconds. If drivers had to wait for the master, they
/// would stall for at least 350. On a computer with little other load no pass takes more than 15.
const PASS: f64 = 300.0;
/// The same limit with a master that hangs, for drivers that read and then write: the mirror answers after 100 ms. A
/// driver that had to wait once for its read and once for its write would take at least 200, and one that had to wait
/// until the master counts as hung at least 1,600.
const PASS_HUNG: f64 = 190.0;
/// Number of hangs within [`MEMORY`] after which rosrescue stands in as soon as after the first one.
const FREE: usize = 5;
/// How long a hang counts, with a reserve.
const MEMORY: Duration = Duration::from_secs(63);
/// How many times longer a pass may take than the longest one of an undisturbed driver.
const NOISE: f64 = 3.0;
/// The longest pass of an undisturbed driver on a computer with little other load, in milliseconds, with a reserve.
const CALM: f64 = 40.0;
/// How often an event takes place on a busy computer until no driver stalls.
const ATTEMPTS: usize = 5;
/// Pause between two kills.
const PAUSE: Duration = Duration::from_secs(2);
/// Default length of a crash loop, and its least number of kills.
const LOOP_SECONDS: u64 = 10;
const KILLS: usize = 5;
/// How long there is no master: many times as long as a pass may take.
const WITHOUT_MASTER: Duration = Duration::from_secs(4);

/// Drivers with rosrescue, and one driver with a bare rosmaster.
struct Drivers {
    drivers: [Node; 2],
    undisturbed: Node,
    _master: Rosmaster,
    _scratch: Scratch,
}

impl Drivers {
    fn start(robot: &Robot) -> Self {
        Self::start_with(robot, &[])
    }

    fn start_with(robot: &Robot, arguments: &[&str]) -> Self {
        let drivers = ["__name:=driver_a", "__name:=driver_b"];
        let scratch = Scratch::new();
        let master = Rosmaster::start(&scratch);
        let driver = |scratch, port, name| {
            let arguments = [&[name], arguments].concat();
            Node::start(scratch, Library::Rospy, port, "driver", &arguments)
        };
        Self {
            drivers: drivers.map(|name| driver(&robot.scratch, robot.port(), name)),
            undisturbed: driver(&scratch, master.port, "__name:=undisturbed"),
            _master: master,
            _scratch: scratch,
        }
    }

    fn all(&self) -> impl Iterator<Item = &Node> {
        self.drivers.iter().chain([&self.undisturbed])
    }

    /// Waits until every driver has made passes for another second.
    #[track_caller]
    fn go_on(&self) {
        for driver in self.all() {
            let before = driver.said("pass").len();
            eventually("a driver makes more passes", || {
                driver.said("pass").len() >= before + 5
            });
        }
    }

    /// Panics if a pass takes longer than `limit` while `event` takes place, or if anything fails.
    #[track_caller]
    fn assert_no_stall(&mut self, what: &str, limit: f64, mut event: impl FnMut()) {
        // `is_calm` panics if drivers stall on a computer that is not busy.
        if !(1..=ATTEMPTS).any(|_| self.is_calm(what, limit, &mut event)) {
            println!("{what}: this computer was too busy to measure anything, {ATTEMPTS} times");
        }
    }

    /// Whether no pass takes longer than `limit` while `event` takes place. Panics if one does on a computer that is not
    /// busy, or if anything fails.
    #[track_caller]
    fn is_calm(&mut self, what: &str, limit: f64, event: impl FnOnce()) -> bool {
        self.go_on();
        let before: Vec<_> = self.all().map(|driver| driver.said("pass").len()).collect();
        event();
        self.go_on();
        let longest: Vec<f64> = self
            .all()
            .zip(before)
            .map(|(driver, before)| {
                let passes = driver.said("pass");
                let passes = passes[before..].iter().map(|ms| ms.parse::<f64>().unwrap());
                passes.fold(0.0, f64::max)
            })
            .collect();
        let allowed = limit.max(NOISE * longest[2]);
        println!(
            "{what}: longest passes {longest:?} ms, the last one undisturbed; allowed {allowed}"
        );
        for driver in &mut self.drivers {
            assert_eq!(driver.exited(), None, "{}", driver.log());
            let log = driver.output().join("\n");
            for bad in ["Traceback", "Error", "xception"] {
                assert!(!log.contains(bad), "{bad}:\n{}", driver.log());
            }
        }
        let is_calm = longest[..2].iter().all(|ms| *ms <= allowed);
        assert!(
            is_calm || longest[2] > CALM,
            "{what}: passes of {longest:?} ms"
        );
        is_calm
    }
}

#[test]
fn no_driver_stalls_while_there_is_no_master() {
    let _turn = crate::turn();
    let mut robot = Robot::start(Mode::Proxy);
    let mut drivers = Drivers::start(&robot);
    drivers.assert_no_stall("no master for a while", PASS, || {
        let dead = robot.master_pid();
        robot.kill_master();
        sleep(WITHOUT_MASTER);
        robot.revive_master();
        robot.await_recovery(dead);
    });
}

in_both_modes!(no_driver_stalls_while_the_master_dies_again_and_again);

fn no_driver_stalls_while_the_master_dies_again_and_again(mode: Mode) {
    let _turn = crate::turn();
    let seconds = std::env::var("ROSRESCUE_LOOP_SECONDS");
    let seconds = seconds.map_or(LOOP_SECONDS, |text| text.parse().unwrap());
    let mut robot = Robot::start(mode);
    let mut drivers = Drivers::start(&robot);
    let mut kills = 0;
    drivers.assert_no_stall(&format!("{mode:?}, a crash loop"), PASS, || {
        let end = Instant::now() + Duration::from_secs(seconds);
        while Instant::now() < end || kills < KILLS {
            let next = Instant::now() + PAUSE;
            // A core also pauses by itself in a crash loop.
            if robot.bare().master_pid().is_some() {
                robot.kill_master();
                robot.revive_master();
                kills += 1;
            }
            sleep(next.saturating_duration_since(Instant::now()));
        }
    });
    println!("{kills} kills");
    eventually("the last master serves", || robot.is_open());
    let state = robot.settled_state();
    for name in ["/driver_a", "/driver_b"] {
        assert!(state.knows(name), "{state}");
    }
}

in_both_modes!(no_driver_stalls_behind_a_master_that_hangs);

fn no_driver_stalls_behind_a_master_that_hangs(mode: Mode) {
    let _turn = crate::turn();
    let hangs = std::env::var("ROSRESCUE_HANGS");
    let hangs = hangs.map_or(1, |text| text.parse().unwrap());
    let options = ["--stand-in-after", "100", "--probe-timeout", "500"];
    let robot = Robot::start_with(mode, &options);
    let mut drivers = Drivers::start_with(&robot, &["writes"]);
    let mut ends = Vec::<Instant>::new();
    for hang in 1..=hangs {
        drivers.assert_no_stall(&format!("{mode:?}, hang {hang} of 5 s"), PASS_HUNG, || {
            let master = robot.master_pid();
            if let Some(end) = ends.iter().rev().nth(FREE - 1) {
                sleep(MEMORY.saturating_sub(end.elapsed()));
            }
            stop(master);
            sleep(Duration::from_secs(5));
            signal(master, Signal::CONT);
            robot.await_gate();
            ends.push(Instant::now());
        });
    }
}
