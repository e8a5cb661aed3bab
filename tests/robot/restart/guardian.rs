//! The guardian: whatever happens to the worker, the port stays open and a new worker serves it.

use std::collections::BTreeSet;
use std::fs::{self, OpenOptions};
use std::io::{ErrorKind, Write};
use std::os::unix::fs::{OpenOptionsExt, symlink};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use crate::support::{
    Client, FakeNode, Finish, Rescue, Rosmaster, Scratch, Setup, State, alive, behind, eventually,
    eventually_some, find_program, free_port, holds, params, signal, status, within,
};
use rustix::fs::OFlags;
use rustix::process::Signal;

/// Pause between two calls of a client.
const PACE: Duration = Duration::from_millis(3);

/// The one process that has had this text in its environment since it started.
fn process_with(scratch: &Scratch, word: &str) -> Option<u32> {
    let has = |pid: &u32| {
        let environment = fs::read(format!("/proc/{pid}/environ")).unwrap_or_default();
        String::from_utf8_lossy(&environment).contains(word)
    };
    let mut found = scratch.survivors().into_iter().map(|(pid, _)| pid);
    found.find(has)
}

/// The worker, once there is one other than `dead`.
#[track_caller]
fn worker_after(scratch: &Scratch, dead: u32) -> u32 {
    eventually_some("there is a worker", || {
        process_with(scratch, "ROSRESCUE_GUARDIAN=").filter(|pid| *pid != dead)
    })
}

#[track_caller]
fn worker(scratch: &Scratch) -> u32 {
    worker_after(scratch, 0)
}

/// The process that runs `program`.
#[track_caller]
fn process_of(scratch: &Scratch, program: &str) -> u32 {
    let found = || {
        let mut processes = scratch.survivors().into_iter();
        processes.find(|(_, command)| command.contains(program))
    };
    eventually_some(program, found).0
}

/// The sockets that a process has open.
fn sockets(pid: u32) -> BTreeSet<PathBuf> {
    let open = fs::read_dir(format!("/proc/{pid}/fd")).unwrap().flatten();
    let open = open.filter_map(|entry| fs::read_link(entry.path()).ok());
    open.filter(|link| link.starts_with("socket:") || link.to_string_lossy().starts_with("socket:"))
        .collect()
}

/// `rosrescue core` with its guardian, once everything that roscore provides is there.
#[track_caller]
fn core(scratch: &Scratch) -> Rescue {
    let rescue = Setup::core(scratch, free_port()).guarded().start();
    let client = rescue.client();
    client.await_roscore_params();
    // rosout subscribes as its last step, and makes no further calls to the master.
    eventually("rosout is running", || {
        State::try_read(&client).is_ok_and(|state| !state.subscribers_of("/rosout").is_empty())
    });
    rescue
}

/// Makes calls one after another, each with a new connection, until `done`. A call that is cut off is
/// repeated. Returns the longest time from the first connection of a call to its answer.
fn call_until(done: &AtomicBool, client: &Client) -> Duration {
    let mut longest = Duration::ZERO;
    while !done.load(Ordering::Relaxed) {
        let start = Instant::now();
        loop {
            match client.status("getParam", params!["/caller", "/kept"]) {
                Ok((code, _, value)) => {
                    assert_eq!((code, value), (1, "yes".into()));
                    break;
                }
                Err(error) => assert_ne!(error.kind(), ErrorKind::ConnectionRefused),
            }
        }
        longest = longest.max(start.elapsed());
        thread::sleep(PACE);
    }
    longest
}

#[test]
fn a_worker_restarts_although_the_configuration_file_is_broken_meanwhile() {
    let scratch = Scratch::new();
    let file = scratch.path("rosrescue.toml");
    fs::write(&file, "hold = 3\nno-rosout = true\n").unwrap();
    let setup = Setup::core(&scratch, free_port()).env("ROSRESCUE_CONFIG", &file);
    let rescue = setup.guarded().start();
    fs::write(&file, "hold = [").unwrap();
    let dead = worker(&scratch);
    signal(dead, Signal::KILL);
    let new = worker_after(&scratch, dead);
    eventually("calls pass again", || {
        status(&rescue.client())["open"] == true
    });
    let words = fs::read_to_string(format!("/proc/{new}/cmdline")).unwrap();
    assert!(words.contains("--hold=3\0--no-rosout"), "{words}");
}

/// A worker that had served calls is restarted at once, however often it dies.
#[test]
fn a_killed_worker_costs_no_connection_and_no_state() {
    let scratch = Scratch::new();
    let rescue = core(&scratch);
    let client = rescue.client();
    client.set_param("/kept", "yes");
    let node = FakeNode::start("/node");
    node.publish(&client, "/topic", "std_msgs/String");
    let rosout = process_of(&scratch, "rosout/rosout");
    let master = client.master_pid().unwrap();
    assert_eq!(status(&client)["guarded"], true);
    let before = State::read(&client);

    let done = AtomicBool::new(false);
    let longest = thread::scope(|scope| {
        let finish = Finish(&done);
        let callers: Vec<_> = (0..4)
            .map(|_| scope.spawn(|| call_until(&done, &client)))
            .collect();
        let mut dead = 0;
        for _ in 0..8 {
            let alive = worker_after(&scratch, dead);
            signal(alive, Signal::KILL);
            dead = alive;
            worker_after(&scratch, dead);
            eventually("calls pass again", || status(&client)["open"] == true);
        }
        drop(finish);
        let longest = callers.into_iter().map(|caller| caller.join().unwrap());
        longest.max().unwrap()
    });
    println!("the longest wait of a call: {longest:?}");
    assert_eq!(
        client.master_pid(),
        Some(master),
        "the master must be adopted"
    );
    assert_eq!(process_of(&scratch, "rosout/rosout"), rosout);
    before.assert_same(&State::read(&client), "after eight deaths");
    assert_eq!(node.received("publisherUpdate").len(), 0);
    let said = rescue.stderr().join("\n");
    assert_eq!(said.matches("restarting it at once").count(), 5, "{said}");
    assert_eq!(said.matches("the worker keeps dying").count(), 3, "{said}");
    assert_eq!(said.matches("pause=0ns").count(), 3, "{said}");
}

/// rosout takes some time to register. Until then the next worker recognises it by its process.
#[test]
fn a_rosout_that_was_just_started_is_adopted() {
    let scratch = Scratch::new();
    let mut rescue = Setup::core(&scratch, free_port()).guarded().start();
    rescue.wait_line("the log says that rosout is started", |line| {
        line.contains("started rosout")
    });
    let dead = worker(&scratch);
    signal(dead, Signal::KILL);
    worker_after(&scratch, dead);
    let client = rescue.client();
    eventually("rosout is running", || {
        State::try_read(&client).is_ok_and(|state| state.knows("/rosout"))
    });
    let said = rescue.stderr().join("\n");
    assert_eq!(said.matches("started rosout").count(), 1, "{said}");
    assert_eq!(rescue.terminate().code(), Some(0));
    assert_eq!(scratch.survivors(), vec![]);
}

#[test]
fn the_guardian_and_its_children_get_the_sockets_memory_and_priorities_that_they_need() {
    let scratch = Scratch::new();
    let rescue = core(&scratch);
    assert_only_the_worker_has_the_sockets(&scratch, rescue.pid());
    assert_little_memory(rescue.pid());
    assert_ended_last(rescue.pid());
    assert_run_before_the_nodes(&scratch, &rescue);
}

/// The guardian passes its sockets to the worker only.
#[track_caller]
fn assert_only_the_worker_has_the_sockets(scratch: &Scratch, guardian: u32) {
    let shared = |pid| {
        let common: BTreeSet<_> = sockets(pid)
            .intersection(&sockets(guardian))
            .cloned()
            .collect();
        common.len()
    };
    // The sockets of IPv4 and, if there is one, IPv6.
    assert!(shared(worker(scratch)) >= 1);
    assert_eq!(
        process_with(scratch, "GLIBC_TUNABLES="),
        Some(worker(scratch))
    );
    for program in ["rosmaster --core", "rosout/rosout"] {
        let pid = process_of(scratch, program);
        assert_eq!(shared(pid), 0, "{program} has inherited a socket");
        let environment = fs::read(format!("/proc/{pid}/environ")).unwrap();
        let environment = String::from_utf8_lossy(&environment);
        assert!(!environment.contains("LISTEN_FDS"), "{program}");
        assert!(!environment.contains("ROSRESCUE_GUARDIAN"), "{program}");
        assert!(!environment.contains("GLIBC_TUNABLES"), "{program}");
    }
}

#[track_caller]
fn assert_little_memory(guardian: u32) {
    let memory = fs::read_to_string(format!("/proc/{guardian}/smaps_rollup")).unwrap();
    let line = memory
        .lines()
        .find(|line| line.starts_with("Private_Dirty"));
    println!("memory of the guardian: {}", line.unwrap());
    let kib: u64 = line
        .unwrap()
        .split_whitespace()
        .nth(1)
        .unwrap()
        .parse()
        .unwrap();
    // Most of this memory is relocations by the linker, which are larger in a debug build.
    assert!(kib < 3072, "the guardian uses {kib} KiB");
}

/// If the system permits it, the kernel ends nodes before the guardian when memory runs out.
#[track_caller]
fn assert_ended_last(guardian: u32) {
    const SCORE: &str = "oom_score_adj";
    let own = fs::read_to_string(format!("/proc/self/{SCORE}")).unwrap();
    let script = format!(
        "[ $(cat /proc/$$/{SCORE}) != 0 ] || echo -500 2>&- >/proc/$$/{SCORE}; cat /proc/$$/{SCORE}"
    );
    let permitted = Command::new("sh").args(["-c", &script]).output().unwrap();
    let expected = String::from_utf8(permitted.stdout).unwrap();
    let score = fs::read_to_string(format!("/proc/{guardian}/{SCORE}")).unwrap();
    assert_eq!(score, expected, "the test's own value was {own}");
}

/// On a busy computer rosrescue runs first, then the master, then the nodes, to which rosout belongs.
#[track_caller]
fn assert_run_before_the_nodes(scratch: &Scratch, rescue: &Rescue) {
    let allowed = match own_nice_value() {
        0 if may_take_priority() => [-20, -20, -10, 0],
        // The user has chosen a value.
        own => [own; 4],
    };
    let values = || {
        let [master, rosout] = ["rosmaster", "rosout"].map(|name| process_of(scratch, name));
        [rescue.pid(), worker(scratch), master, rosout].map(nice_value)
    };
    assert_eq!(values(), allowed);
    let dead = worker(scratch);
    let master = rescue.client().master_pid().unwrap();
    signal(master, Signal::KILL);
    signal(dead, Signal::KILL);
    worker_after(scratch, dead);
    let client = rescue.client();
    eventually("another master answers", || {
        client.master_pid().is_some_and(|pid| pid != master) && status(&client)["open"] == true
    });
    assert_eq!(values(), allowed, "after the death of worker and master");
}

/// A `rosrescue core` that has lost its rosmaster program and its worker, so that new workers end before they serve
/// calls. Returned as soon as the guardian pauses, with the path of the missing program.
#[track_caller]
fn paused(scratch: &Scratch) -> (Rescue, PathBuf) {
    let program = scratch.path("rosmaster");
    symlink(find_program("rosmaster"), &program).unwrap();
    let setup = Setup::core(scratch, free_port()).guarded();
    let mut rescue = setup.arg("--rosmaster").arg(&program).start();
    rescue.client().set_param("/kept", "yes");
    fs::remove_file(&program).unwrap();
    signal(worker(scratch), Signal::KILL);
    rescue.wait_line("the log says that the guardian pauses", |line| {
        line.contains("pause=500ms")
    });
    (rescue, program)
}

/// A terminal that was stopped with Ctrl-S takes no lines, and neither does a pipe whose reader stands still.
#[test]
fn a_log_that_takes_no_lines_holds_up_neither_calls_nor_restarts() {
    let scratch = Scratch::new();
    let pipe = scratch.path("lines");
    let setup = Setup::core(&scratch, free_port())
        .guarded()
        .env("LOG", &pipe)
        .wrapped(|own| {
            let mut shell = Command::new("sh");
            shell.args(["-c", r#"mkfifo "$LOG" && exec "$0" "$@" 2<>"$LOG""#]);
            behind(shell, own)
        });
    let mut rescue = setup.start();
    let client = rescue.client();
    let flags = OFlags::NONBLOCK.bits().cast_signed();
    let log = OpenOptions::new()
        .write(true)
        .custom_flags(flags)
        .open(pipe);
    let mut log = log.unwrap();
    // The kernel takes short lines when it has no room for long ones.
    for length in [4096, 1] {
        while log.write(&vec![b'\n'; length]).is_ok() {}
    }
    let limit = Duration::from_secs(20);
    let dead = client.master_pid().unwrap();
    signal(dead, Signal::KILL);
    within(limit, "a write", || client.set_param("/a", 1));
    eventually("another master runs", || {
        client.master_pid().is_some_and(|pid| pid != dead)
    });
    signal(worker(&scratch), Signal::KILL);
    within(limit, "a write", || client.set_param("/a", 2));
    let end = within(limit, "the end", || rescue.terminate());
    assert_eq!(end.code(), Some(0));
}

#[test]
fn workers_that_fail_before_serving_are_restarted_after_a_pause() {
    let scratch = Scratch::new();
    let (mut rescue, program) = paused(&scratch);
    symlink(find_program("rosmaster"), program).unwrap();
    // A call during the pause waits until the pause is over.
    assert_eq!(rescue.client().param("/kept"), Some("yes".into()));
    assert_eq!(rescue.terminate().code(), Some(0));
}

#[test]
fn stopping_during_a_pause_ends_everything() {
    let scratch = Scratch::new();
    let (mut rescue, program) = paused(&scratch);
    symlink(find_program("rosmaster"), program).unwrap();
    assert_eq!(rescue.terminate().code(), Some(0));
    assert_eq!(scratch.survivors(), vec![]);
}

/// A guardian that was stopped with Ctrl-Z exists but does not start a worker. A guardian that has ended leaves a worker
/// that goes on.
#[test]
fn a_worker_reports_a_guardian_that_is_stopped_and_survives_one_that_ends() {
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    let setup = Setup::proxy(&scratch, master.client().port());
    let mut rescue = setup.guarded().start();
    let client = rescue.client();
    let by = || status(&client)["guarded_by"].as_str().unwrap().to_owned();
    assert!(by().contains("which nothing restarts"), "{}", by());
    crate::support::stop(rescue.pid());
    rescue.wait_line("the log says that the guardian is stopped", |line| {
        line.contains("unguarded")
    });
    assert_eq!(status(&client)["guarded"], false);
    assert!(by().contains("is stopped"), "{}", by());
    rescue.signal(Signal::CONT);
    rescue.wait_line("the log says that the guardian runs again", |line| {
        line.contains("runs again")
    });
    assert_eq!(status(&client)["guarded"], true);

    let worker = worker(&scratch);
    rescue.kill();
    eventually("the log reports the missing guardian", || {
        let lines = rescue.stderr().into_iter();
        let warned = lines.filter(|line| line.contains("unguarded")).count();
        warned == 2
    });
    client.set_param("/x", 1);
    assert_eq!(status(&client)["guarded"], false);
    assert!(by().contains("has ended"), "{}", by());
    signal(worker, Signal::TERM);
    eventually("the worker ends", || !alive(worker));
    eventually("rosrescue was stopped cleanly", || {
        rescue.stderr().join("\n").contains("stopped cleanly")
    });
}

#[test]
fn a_clean_stop_ends_everything() {
    // killall signals both processes.
    for both in [false, true] {
        let scratch = Scratch::new();
        let mut rescue = core(&scratch);
        if both {
            signal(worker(&scratch), Signal::TERM);
        }
        rescue.signal(Signal::TERM);
        assert_clean_stop(&mut rescue, Signal::TERM);
        assert_eq!(scratch.survivors(), vec![], "both: {both}");
    }
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    for signal in [Signal::INT, Signal::HUP] {
        let setup = Setup::proxy(&scratch, master.client().port());
        let mut rescue = setup.guarded().start();
        rescue.signal(signal);
        assert_clean_stop(&mut rescue, signal);
        let left = scratch.survivors().into_iter().map(|(pid, _)| pid);
        assert_eq!(left.collect::<Vec<_>>(), [master.pid()], "{signal:?}");
    }
}

/// Waits until rosrescue has ended, and checks that it was stopped cleanly.
#[track_caller]
fn assert_clean_stop(rescue: &mut Rescue, signal: Signal) {
    assert_eq!(rescue.wait_output().code(), Some(0), "{signal:?}");
    let said = rescue.stderr().join("\n");
    assert!(said.contains("stopped cleanly"), "{said}");
    assert!(!said.contains("unguarded"), "{said}");
}

/// The next worker may have got to any point. It ends the processes that the dead one left behind.
#[test]
fn stopping_right_after_a_death_of_the_worker_ends_everything() {
    for lines in [1, 2] {
        let scratch = Scratch::new();
        let mut rescue = core(&scratch);
        let dead = worker(&scratch);
        signal(dead, Signal::KILL);
        worker_after(&scratch, dead);
        let said = || {
            let lines = rescue.stdout().into_iter();
            let lines = lines.filter(|line| line.starts_with("ROS_MASTER_URI="));
            lines.count()
        };
        eventually("the worker has got this far", || said() >= lines);
        assert_eq!(rescue.terminate().code(), Some(0));
        assert_eq!(scratch.survivors(), vec![]);
    }
}

/// The worker is killed before it has carried out the signal's request.
#[test]
fn stopping_while_the_worker_dies_ends_everything() {
    let scratch = Scratch::new();
    let mut rescue = core(&scratch);
    let dead = worker(&scratch);
    crate::support::stop(dead);
    rescue.signal(Signal::TERM);
    eventually("the signal has been passed on", || {
        let status = fs::read_to_string(format!("/proc/{dead}/status")).unwrap();
        let pending = status.lines().find(|line| line.starts_with("ShdPnd:"));
        pending.is_some_and(|line| line.trim_end().ends_with("4000"))
    });
    signal(dead, Signal::KILL);
    assert_eq!(rescue.wait().code(), Some(0));
    assert_eq!(scratch.survivors(), vec![]);
}

#[test]
fn a_second_signal_ends_guardian_and_worker_at_once() {
    let scratch = Scratch::new();
    let mut rescue = core(&scratch);
    // A clean stop would have to wait for this process.
    crate::support::stop(process_of(&scratch, "rosmaster --core"));
    eventually("rosrescue has ended", || {
        rescue.signal(Signal::INT);
        rescue.exited().is_some()
    });
    assert_eq!(rescue.wait().code(), Some(130));
    assert_eq!(process_with(&scratch, "ROSRESCUE_GUARDIAN="), None);
}

/// Ctrl-\ in a terminal sends SIGQUIT. The worker must not keep running unnoticed.
#[test]
fn sigquit_ends_guardian_and_worker() {
    let scratch = Scratch::new();
    let mut rescue = core(&scratch);
    rescue.signal(Signal::QUIT);
    assert_eq!(rescue.wait().code(), Some(131));
    assert_eq!(process_with(&scratch, "ROSRESCUE_GUARDIAN="), None);
}

#[test]
fn an_error_at_the_start_is_reported_once_and_ends_rosrescue() {
    let scratch = Scratch::new();
    let taken = std::net::TcpListener::bind("0.0.0.0:0").unwrap();
    let taken = taken.local_addr().unwrap().port().to_string();
    let free = free_port().to_string();
    for (arguments, status, sentence) in [
        (&["core", "-p", &taken][..], 1, "is in use"),
        (
            &["core", "-p", &free, "--rosmaster", "/nonexistent"],
            1,
            "is not an executable program",
        ),
        (
            &["proxy", "--master", "m:1"],
            2,
            "is not the URI of a master",
        ),
    ] {
        let mut rescue = Setup::bare(&scratch, arguments).guarded().spawn();
        assert_eq!(rescue.wait_output().code(), Some(status), "{arguments:?}");
        let said = rescue.output().join("\n");
        assert_eq!(said.matches(sentence).count(), 1, "{said}");
        assert!(!said.contains("worker"), "{said}");
    }
}

#[test]
fn after_a_kill_of_guardian_and_worker_a_new_start_restores_everything() {
    let scratch = Scratch::new();
    let mut rescue = core(&scratch);
    let client = rescue.client();
    client.set_param("/kept", "yes");
    let before = State::read(&client);
    let (master, worker) = (client.master_pid(), worker(&scratch));
    rescue.signal(Signal::KILL);
    signal(worker, Signal::KILL);
    rescue.wait();
    eventually("the worker is dead", || !alive(worker));
    rescue.start_again();
    rescue.wait_serving();
    assert_eq!(client.master_pid(), master, "the master must be adopted");
    before.assert_same(&State::read(&client), "after the death of both");
    assert_eq!(rescue.terminate().code(), Some(0));
    assert_eq!(scratch.survivors(), vec![]);
}

/// The option is about the first start, so the parameters survive although no node lives.
#[test]
fn a_worker_continues_its_session_although_a_first_start_would_not() {
    let scratch = Scratch::new();
    let setup = Setup::core(&scratch, free_port()).args(["--no-rosout", "--restore", "never"]);
    let mut rescue = setup.guarded().start();
    let client = rescue.client();
    client.set_param("/kept", "yes");
    let (master, worker) = (client.master_pid().unwrap(), worker(&scratch));
    // A stopped worker starts no new master, so both die at once.
    signal(worker, Signal::STOP);
    signal(master, Signal::KILL);
    signal(worker, Signal::KILL);
    worker_after(&scratch, worker);
    eventually("there is a new master", || {
        client.master_pid().is_some_and(|pid| pid != master) && status(&client)["open"] == true
    });
    assert_eq!(client.param("/kept"), Some("yes".into()));
    assert_eq!(rescue.terminate().code(), Some(0));
    rescue.start_again();
    rescue.wait_serving();
    assert_eq!(client.param("/kept"), None);
}

/// As the first process of a container, the guardian becomes the parent of the master that a dead worker
/// leaves behind. The master must still be recognised as left behind, and become no zombie when it ends.
#[test]
fn a_guardian_works_as_the_first_process_of_a_container() {
    let scratch = Scratch::new();
    let setup = Setup::core(&scratch, free_port()).guarded();
    let rescue = setup
        .wrapped(|own| {
            let mut unshare = Command::new("unshare");
            if !rustix::process::geteuid().is_root() {
                unshare.arg("--map-root-user");
            }
            unshare.args(["--pid", "--fork", "--mount-proc", "--kill-child"]);
            behind(unshare, own)
        })
        .start();
    let client = rescue.client();
    client.set_param("/kept", "yes");
    let named = client.master_pid();
    let master = process_of(&scratch, "rosmaster --core");
    let dead = worker(&scratch);
    signal(dead, Signal::KILL);
    worker_after(&scratch, dead);
    // Until the master is adopted, rosrescue answers with its own process id.
    eventually("the master is adopted", || client.master_pid() == named);
    eventually("changes pass again", || {
        client
            .ask("setParam", params!["/test", "/again", 1])
            .is_some()
    });
    assert_eq!(client.master_pid(), named);
    assert!(alive(master));
    signal(master, Signal::KILL);
    eventually("no zombie is left", || {
        !Path::new(&format!("/proc/{master}")).exists()
    });
    eventually("another master answers", || {
        client.master_pid().is_some_and(|pid| Some(pid) != named)
    });
    assert_eq!(client.param("/kept"), Some("yes".into()));
}

#[test]
fn without_a_guardian_the_status_does_not_claim_one() {
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    let setup = Setup::proxy(&scratch, master.client().port()).guarded();
    let rescue = setup.arg("--no-guardian").start();
    assert_eq!(process_with(&scratch, "ROSRESCUE_GUARDIAN="), None);
    assert_eq!(status(&rescue.client())["guarded"], false);
    let silent = || !rescue.stderr().join("\n").contains("unguarded");
    assert!(holds(Duration::from_millis(200), silent));
}

/// Whether this computer lets processes raise their priority. Containers often do not, even for root.
fn may_take_priority() -> bool {
    let nice = Command::new("nice").args(["-n", "-20", "nice"]).output();
    nice.unwrap().stdout == b"-20\n"
}

fn nice_value(pid: u32) -> i32 {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).unwrap();
    // The name in parentheses can contain spaces. The nice value is the 19th field, and the 17th after the name.
    let (_, fields) = stat.rsplit_once(") ").unwrap();
    fields.split(' ').nth(16).unwrap().parse().unwrap()
}

/// The nice value of this process, and of its children.
fn own_nice_value() -> i32 {
    nice_value(std::process::id())
}

#[test]
fn a_nice_value_that_the_user_has_chosen_stays() {
    let scratch = Scratch::new();
    let setup = Setup::core(&scratch, free_port()).guarded();
    let rescue = setup.wrapped(|command| {
        let mut nice = Command::new("nice");
        nice.args(["-n", "5"]);
        behind(nice, command)
    });
    let rescue = rescue.start();
    let master = process_of(&scratch, "rosmaster");
    let values = [rescue.pid(), worker(&scratch), master].map(nice_value);
    assert_eq!(values, [own_nice_value() + 5; 3]);
}
