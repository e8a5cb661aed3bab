//! The wall clock jumps: by years when a robot without a clock battery finds a time server, by seconds when
//! it is corrected. rosrescue must not depend on it. It runs under libfaketime, which changes the wall clock
//! that it reads and leaves the monotonic clock alone.

use std::fs;
use std::ops::Deref;
use std::path::PathBuf;
use std::thread;
use std::time::{Duration, Instant};

use crate::support::{
    Control, Failing, Failures, FakeNode, PATIENCE, Rosmaster, Scratch, Setup, State, alive,
    eventually, holds, params, signal, status, unreadable,
};

/// A wall clock that is wrong by a given number of seconds.
struct WallClock {
    file: PathBuf,
}

const DAY: i64 = 86_400;
/// Forward by 20 years, back to 63 days ago, then several times by 13 seconds, and to about 1970, where a
/// robot without a clock battery starts. The clock of a kernel is never before that.
const JUMPS: [i64; 7] = [
    20 * 365 * DAY,
    -63 * DAY,
    -63 * DAY - 13,
    -63 * DAY - 26,
    -63 * DAY - 39,
    -56 * 365 * DAY,
    0,
];

impl WallClock {
    fn new(scratch: &Scratch) -> Self {
        let clock = Self {
            file: scratch.path("wall-clock"),
        };
        clock.jump(0);
        clock
    }

    fn jump(&self, seconds: i64) {
        let half = self.file.with_extension("half");
        fs::write(&half, format!("{seconds:+}\n")).unwrap();
        fs::rename(half, &self.file).unwrap();
    }

    fn rule(&self, setup: Setup) -> Setup {
        let library = fs::read_dir("/usr/lib")
            .unwrap()
            .flatten()
            .map(|folder| folder.path().join("faketime/libfaketimeMT.so.1"))
            .find(|library| library.exists())
            .expect("libfaketime is not installed: `tests/run.sh` installs it");
        setup
            .env("LD_PRELOAD", library)
            .env("FAKETIME_TIMESTAMP_FILE", &self.file)
            .env("FAKETIME_NO_CACHE", "1")
            .env("FAKETIME_DONT_FAKE_MONOTONIC", "1")
    }
}

/// A robot whose rosrescue reads a [`WallClock`].
struct Robot {
    failing: Failing,
    clock: WallClock,
}

impl Deref for Robot {
    type Target = Failing;

    fn deref(&self) -> &Failing {
        &self.failing
    }
}

impl Robot {
    fn core(options: &[&str]) -> Self {
        Self::start(|scratch, port, failures| failures.core(scratch, port).args(options))
    }

    fn start(setup: impl FnOnce(&Scratch, u16, &Failures) -> Setup) -> Self {
        let mut clock = None;
        let failing = Failing::start(|scratch, port, failures| {
            let setup = setup(scratch, port, failures);
            clock.insert(WallClock::new(scratch)).rule(setup)
        });
        let clock = clock.unwrap();
        Self { failing, clock }
    }

    fn await_recovery(&self, dead: u32) {
        let client = self.client();
        eventually("a new master has the state", || {
            let status = status(&client);
            status["open"] == true && status["last_recovery"]["master_pid"] != dead
        });
    }

    /// The length of the outage in rosrescue's last report, minus the real length, in seconds.
    fn clock_error(&self) -> f64 {
        let report = &status(&self.client())["last_recovery"];
        report["detected_at"].as_f64().unwrap() - rosrescue::clock::wall_time()
    }
}

#[test]
fn recovery_does_not_depend_on_the_wall_clock() {
    let robot = Robot::core(&[]);
    let client = robot.client();
    let node = FakeNode::start("/fake");
    node.publish(&client, "/topic", "std_msgs/String");
    client.set_param("/kept", "yes");
    let before = robot.state();
    // The other tests here make the small steps.
    let [far, back, .., oldest, right] = JUMPS;
    let jumps = [far, back, oldest, right];
    for jump in jumps {
        let start = Instant::now();
        robot.clock.jump(jump);
        let dead = robot.kill_master();
        // The mirror or the new master answers these calls, whatever the clock does.
        client.set_param("/held", 1);
        client.ok("deleteParam", params!["/test", "/held"]);
        robot.await_recovery(dead);
        before.assert_same(
            &State::read(&robot.bare()),
            &format!("after a jump to {jump:+} s"),
        );
        let took = start.elapsed().as_secs_f64();
        let report = &status(&client)["last_recovery"];
        for phase in ["absence_ms", "inspection_ms", "injection_ms", "total_ms"] {
            let ms = report["phases"][phase].as_f64().unwrap();
            assert!(
                (0.0..=took * 1e3).contains(&ms),
                "{phase} {ms} of {took} s ({jump:+})"
            );
        }
        // Checks that the clock was wrong in this run.
        let error = robot.clock_error();
        let took = start.elapsed().as_secs_f64();
        assert!(
            (error - jump as f64).abs() < took + 1.0,
            "the clock was wrong by {error} s instead of {jump} s"
        );
    }
    assert_eq!(status(&client)["deaths"], jumps.len());
}

#[test]
fn hold_and_probes_do_not_depend_on_the_wall_clock() {
    let options = [
        "--hold",
        "2",
        "--probe-interval",
        "100",
        "--probe-timeout",
        "1000",
        "--probe-count",
        "3",
    ];
    let robot = Robot::start(|scratch, port, _| {
        // rosmaster is started first, because rosrescue waits for it. The scratch folder ends it.
        std::mem::forget(Rosmaster::start_at(scratch, port));
        Setup::proxy(scratch, port).args(options)
    });
    let client = robot.client();
    let pid = robot.bare().master_pid().unwrap();
    let mut jumps = JUMPS.into_iter().cycle();
    let mut jump = || robot.clock.jump(jumps.next().unwrap());
    // A master that answers does not count as hung.
    assert!(holds(Duration::from_secs(2), || {
        jump();
        status(&client)["open"] == true
    }));
    // A master that hangs counts as hung after three probes of a second.
    let (start, control) = (Instant::now(), Control::start());
    crate::support::stop(pid);
    eventually("the hung master is noticed", || {
        jump();
        status(&client)["open"] == false
    });
    let found = start.elapsed();
    // On a busy computer, earlier probes may have been late already. A jump would end them at once.
    assert!(found > Duration::from_millis(900), "{found:?}");
    let allowed = control.allows(Duration::from_secs(15));
    assert!(found < allowed, "{found:?}; allowed are {allowed:?}");
    // A call that only a master understands is held for two seconds, not shorter and not much longer.
    let start = Instant::now();
    let waiting = thread::spawn({
        let client = client.clone();
        move || {
            let answer = client.exchange(&unreadable("/late", 1));
            (answer.is_err(), start.elapsed())
        }
    });
    eventually("the held call ends", || {
        jump();
        waiting.is_finished()
    });
    let (given_back, held) = waiting.join().unwrap();
    assert!(given_back);
    assert!(held > Duration::from_millis(1_900), "{held:?}");
    assert!(held < PATIENCE, "{held:?}");
    signal(pid, rustix::process::Signal::CONT);
    client.set_param("/late", 2);
    eventually("the master serves calls again", || {
        jump();
        status(&client)["open"] == true
    });
    assert_eq!(robot.bare().param("/late"), Some(2.into()));
    assert!(alive(pid));
    assert_eq!(client.master_pid(), Some(pid));
}

#[test]
fn pauses_between_restarts_do_not_depend_on_the_wall_clock() {
    let robot = Robot::core(&[]);
    let client = robot.client();
    let before = robot.failures.starts().len();
    robot.failures.set("at once");
    robot.kill_master();
    let mut jumps = JUMPS.into_iter().cycle();
    let control = Control::start();
    eventually("the status reports a crash loop", || {
        robot.clock.jump(jumps.next().unwrap());
        robot.failures.starts().len() >= before + 7
    });
    let reserve = control.allows(Duration::from_secs(5)).as_secs_f64();
    // Five restarts at once, then after pauses that double: 0.5 s, 1 s.
    let starts = robot.failures.starts().split_off(before);
    for (number, pause) in [(5, 0.5), (6, 1.0)] {
        let took = starts[number] - starts[number - 1];
        assert!(
            (pause..pause + reserve).contains(&took),
            "{number}: {took} s"
        );
    }
    assert!(starts[4] - starts[0] < 2.0 * reserve, "{starts:?}");
    robot.failures.clear();
    eventually("the crash loop is over", || {
        robot.clock.jump(jumps.next().unwrap());
        status(&client)["crash_loop"] == false
    });
}

/// Kept files are numbered, so none replaces another.
#[test]
fn kept_files_do_not_replace_each_other_when_the_wall_clock_jumps() {
    let mut robot = Robot::core(&["--restore", "never"]);
    let mut jumps = JUMPS.into_iter();
    for number in 1..=3 {
        robot
            .client()
            .set_param(&format!("/session{number}"), number);
        robot.clock.jump(jumps.next().unwrap());
        assert!(robot.failing.rescue.terminate().success());
        robot.failing.rescue.start_again();
        robot.failing.rescue.wait_serving();
    }
    let checkpoint = robot.failing.rescue.checkpoint();
    let stem = checkpoint.file_name().unwrap().to_string_lossy() + ".";
    let mut names: Vec<_> = fs::read_dir(robot.scratch.log_dir())
        .unwrap()
        .flatten()
        .filter_map(|file| {
            let name = file.file_name().into_string().unwrap();
            name.strip_prefix(&*stem).map(str::to_owned)
        })
        .filter(|name| name.starts_with("session-"))
        .collect();
    names.sort();
    // For each session its file, and possibly its previous generation.
    assert!(names.len() >= 3, "{names:?}");
    for number in 1..=3 {
        let key = format!("\"session{number}\": {number}");
        let kept = names.iter().filter(|name| {
            let path = format!("{stem}{name}");
            let text = fs::read_to_string(robot.scratch.log_dir().join(path)).unwrap();
            text.contains(&key)
        });
        assert!(kept.count() >= 1, "session {number}: {names:?}");
    }
}
