//! How rosrescue starts and refuses to start, depending on its arguments, files and ports. Each mistake gets one clear
//! sentence. No process or file is left behind, and no user's file is lost.

use std::fs;
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

use crate::support::{
    Client, Rescue, Rosmaster, Scratch, Setup, behind, eventually, find_program, free_port, holds,
    params,
};
use rustix::process::Signal;

/// Runs rosrescue until it ends by itself. It must end with `code` and one clear sentence on standard error, and leave
/// nothing behind. Returns the sentence.
#[track_caller]
fn refused(scratch: &Scratch, setup: Setup, code: i32) -> String {
    let before = scratch.survivors();
    let mut rescue = setup.spawn();
    let status = rescue.wait_output();
    let said = rescue.stderr().join("\n");
    assert_eq!(status.code(), Some(code), "{said}");
    rescue.assert_no_panic();
    // A usage error also tells how to get help. Other errors are one sentence, perhaps after log lines.
    let sentence = said.lines().last().unwrap().to_owned();
    for noise in ["Os {", "Err(", "Some(", "stack backtrace", "kind:"] {
        assert!(!said.contains(noise), "`{noise}` is not for people: {said}");
    }
    // Processes that it killed at its end may take a moment to be gone.
    eventually("no process is left behind", || {
        scratch.survivors() == before
    });
    if code == 2 { said } else { sentence }
}

#[test]
fn usage_errors_end_with_2_and_say_which() {
    let scratch = Scratch::new();
    let cases: &[(&[&str], &str)] = &[
        (&["--no-such-option"], "--no-such-option"),
        (&["no-such-command"], "no-such-command"),
        (&["core", "-p", "0"], "-p"),
        (&["core", "-p", "70000"], "70000"),
        (&["core", "-p", "eleven"], "eleven"),
        (&["core", "--master-port", "-1"], "-1"),
        (&["core", "--hold", "long"], "long"),
        (&["core", "--hold", "-1"], "hold"),
        (&["core", "--probe-interval", "0"], "--probe-interval"),
        (&["core", "--restore", "sometimes"], "sometimes"),
        (&["proxy"], "--master"),
        (&["proxy", "--master", ""], "master"),
        (&["proxy", "--master", "ftp://localhost:1"], "ftp"),
        (&["proxy", "--master", "http://"], "http://"),
        (&["proxy", "--master", "http://localhost:99999"], "99999"),
        (
            &[
                "proxy",
                "--master",
                "http://localhost:1",
                "--listen",
                "nowhere:at:all",
            ],
            "nowhere",
        ),
        (
            &["proxy", "--master", "http://localhost:1", "-w", "3"],
            "-w",
        ),
    ];
    for (arguments, named) in cases {
        let said = refused(&scratch, Setup::bare(&scratch, *arguments), 2);
        assert!(said.contains(named), "{arguments:?}: {said}");
    }
    let said = refused(
        &scratch,
        Setup::bare(&scratch, ["core"]).env("ROSRESCUE_PORT", "x"),
        2,
    );
    assert!(said.contains('x'), "{said}");
    for bad in ["bad host", "a/b"] {
        let setup = Setup::bare(&scratch, ["core"]).env("ROS_HOSTNAME", bad);
        let said = refused(&scratch, setup, 2);
        assert!(
            said.contains("ROS_HOSTNAME") && said.contains(bad),
            "{said}"
        );
    }
}

#[test]
fn proxy_ignores_variables_of_core() {
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    let setup = || {
        Setup::proxy(&scratch, master.port)
            .env("ROSRESCUE_NUMWORKERS", "bad")
            .env("ROSRESCUE_PORT", "bad")
    };
    setup().start();
    // `proxy` still checks the variables that are meant for it.
    let said = refused(&scratch, setup().env("ROSRESCUE_HOLD", "bad"), 2);
    assert!(said.contains("--hold"), "{said}");
    for arguments in [&[][..], &["core"], &["--no-rosout"]] {
        let setup = Setup::bare(&scratch, arguments).env("ROSRESCUE_NUMWORKERS", "bad");
        let said = refused(&scratch, setup, 2);
        assert!(said.contains("--numworkers"), "{arguments:?}: {said}");
    }
}

#[test]
fn a_new_session_is_reported_as_new() {
    let scratch = Scratch::new();
    let mut rescue = Setup::core(&scratch, free_port()).start();
    rescue.wait_line("what it did", |line| line.contains("a new session started"));
    let said = rescue.output().join("\n");
    assert!(!said.contains("whole state was restored"), "{said}");
}

#[test]
fn a_master_uri_that_does_not_lead_here_is_warned_of() {
    let scratch = Scratch::new();
    let warns = |line: &str| line.contains("ROS_MASTER_URI=");
    for (master, why) in [
        ("http://192.0.2.1:11311", "is another computer"),
        ("http://nobody.invalid:11311", "has no address"),
        ("http://localhost:1", "has port 1, and rosrescue has"),
    ] {
        let setup = Setup::core(&scratch, free_port()).env("ROS_MASTER_URI", master);
        let mut rescue = setup.start();
        let line = rescue.wait_line("the warning", |line| warns(line) && line.contains("WARN"));
        let todo = format!(
            "`export ROS_MASTER_URI=http://127.0.0.1:{}/`",
            rescue.port()
        );
        assert!(line.contains(why) && line.contains(&todo), "{line}");
    }
    let setup = Setup::core(&scratch, free_port());
    let own = format!("http://localhost:{}", setup.port);
    let rescue = setup.env("ROS_MASTER_URI", own).start();
    assert!(!rescue.stderr().iter().any(|line| warns(line)));
}

#[test]
fn an_unprotected_start_does_not_call_the_master_fault_tolerant() {
    let scratch = Scratch::new();
    let setup = Setup::core(&scratch, free_port());
    let rescue = setup.args(["--checkpoint", "/proc/1/checkpoint"]).start();
    let said = rescue.output().join("\n");
    assert!(
        said.contains("ROS Rescue enabled, but UNPROTECTED"),
        "{said}"
    );
    assert!(!said.contains("fault tolerant"), "{said}");
}

#[test]
fn a_start_after_a_kill_says_once_that_the_session_continues() {
    let scratch = Scratch::new();
    let mut rescue = Setup::core(&scratch, free_port()).start();
    let client = rescue.client();
    let master = client.master_pid().expect("the master's process id");
    rescue.kill();
    rescue.start_again();
    rescue.wait_line("that the session continues", |line| {
        line.starts_with("the session continues (rosrescue was not stopped cleanly): ")
    });
    rescue.wait_serving();
    // It is not the master's parent, so it cannot know the exit status.
    crate::support::signal(master, Signal::KILL);
    let line = rescue.wait_line("how the master ended", |line| {
        line.contains("rosmaster has ended")
    });
    assert!(
        line.contains("exit status unknown: an earlier rosrescue started it"),
        "{line}"
    );
}

/// The gate stays open although rosmaster closes connections that were idle for four seconds.
#[test]
fn the_sentinel_is_renewed_before_the_master_closes_it() {
    let scratch = Scratch::new();
    let options = ["--probe-interval", "30000"];
    let core = Setup::core(&scratch, free_port()).args(["-t", "4"]);
    let master = Rosmaster::start_with(&scratch, free_port(), |master| {
        master.args(["-t", "4"]);
    });
    let proxy = Setup::proxy(&scratch, master.port);
    let rescues = [core, proxy].map(|setup| setup.args(options).start());
    let shut = |rescue: &Rescue| {
        let lines = rescue.stderr();
        lines.iter().any(|line| line.contains("the master is away"))
    };
    assert!(holds(Duration::from_secs(9), || !rescues.iter().any(shut)));
}

#[test]
fn help_and_version_need_nothing_and_end_with_0() {
    let scratch = Scratch::new();
    for arguments in [
        &["--help"][..],
        &["--version"],
        &["core", "--help"],
        &["proxy", "--help"],
    ] {
        let mut rescue = Setup::bare(&scratch, arguments)
            .env("PATH", "/nonexistent")
            .spawn();
        assert_eq!(rescue.wait().code(), Some(0), "{arguments:?}");
        eventually("it said something", || !rescue.stdout().is_empty());
        assert_eq!(rescue.stderr(), Vec::<String>::new());
    }
}

#[test]
fn an_address_that_cannot_be_served_is_named() {
    let scratch = Scratch::new();
    let taken = TcpListener::bind("0.0.0.0:0").unwrap();
    let taken = taken.local_addr().unwrap().port().to_string();
    let free = free_port().to_string();
    let (uri, listen) = (
        format!("http://127.0.0.1:{free}"),
        format!("127.0.0.1:{taken}"),
    );
    for (arguments, named) in [
        (
            ["core", "-p", &taken, "--master-port", &free],
            [&*taken, "in use"],
        ),
        (
            ["core", "-p", &free, "--master-port", &taken],
            [&*taken, "in use"],
        ),
        (
            ["proxy", "--master", &uri, "--listen", &listen],
            [&*taken, "in use"],
        ),
        (
            ["core", "-p", &free, "--listen", "198.51.100.7"],
            ["198.51.100.7", "--listen"],
        ),
    ] {
        let said = refused(&scratch, Setup::bare(&scratch, arguments), 1);
        assert!(named.iter().all(|word| said.contains(word)), "{said}");
        // This test has the port.
        let by = format!("(process {})", std::process::id());
        assert_eq!(said.contains(&by), named[1] == "in use", "{said}");
    }
}

#[test]
fn a_proxy_whose_masters_host_has_no_address_says_so() {
    let scratch = Scratch::new();
    let port = free_port().to_string();
    let arguments = [
        "proxy",
        "--master",
        "http://nobody.invalid:11312",
        "--listen",
        &port,
    ];
    let mut rescue = Setup::bare(&scratch, arguments).spawn();
    let line = rescue.wait_line("why it waits", |line| {
        line.contains("waiting for the master")
    });
    assert!(
        line.contains("waiting for the master: nobody.invalid has no address"),
        "{line}"
    );
}

/// The kernel closes the sockets of a killed rosrescue a moment after its end.
#[test]
fn rosrescue_waits_for_a_port_that_becomes_free_soon() {
    let scratch = Scratch::new();
    let setup = Setup::core(&scratch, free_port()).arg("--no-rosout");
    let taken = TcpListener::bind(("0.0.0.0", setup.port)).unwrap();
    let start = Instant::now();
    let mut rescue = setup.spawn();
    // A rosrescue that does not wait for the port would end within this time.
    holds(Duration::from_millis(300), || rescue.exited().is_none());
    drop(taken);
    // It waits for 2 s, and this test may have got no processor for that long.
    if start.elapsed() < Duration::from_millis(1500) {
        rescue.wait_serving();
    }
}

#[test]
fn a_master_address_that_is_invalid_or_rosrescues_own_is_refused() {
    let scratch = Scratch::new();
    let port = free_port().to_string();
    let mut cases = Vec::new();
    for uri in ["rosmaster", "http://", "http://host:port/", "://"] {
        let setup = Setup::bare(&scratch, ["core"]).env("ROS_MASTER_URI", uri);
        cases.push((setup, "ROS_MASTER_URI"));
    }
    for (host, listen) in [
        ("127.0.0.1", "127.0.0.1"),
        ("localhost", "127.0.0.1"),
        ("127.0.0.1", "0.0.0.0"),
        ("[::1]", "[::]"),
        ("localhost", "0.0.0.0"),
    ] {
        let (uri, address) = (format!("http://{host}:{port}"), format!("{listen}:{port}"));
        let arguments = ["proxy", "--master", &uri, "--listen", &address];
        cases.push((Setup::bare(&scratch, arguments), &*port));
    }
    let arguments = ["core", "-p", &port, "--master-port", &port];
    cases.push((Setup::bare(&scratch, arguments), &*port));
    for (setup, named) in cases {
        let mut rescue = setup.spawn();
        let code = rescue.wait_output().code();
        let said = rescue.stderr().join("\n");
        assert!(code == Some(1) || code == Some(2), "{code:?}: {said}");
        assert!(said.contains(named), "{said}");
        rescue.assert_no_panic();
    }
}

/// The command `own` with nothing in /opt but a ROS with this rosmaster, if one is given.
fn with_opt(own: &Command, rosmaster: &Path) -> Command {
    const MOUNT: &str = r#"
        own_path=$PATH
        PATH=/usr/sbin:/usr/bin:/sbin:/bin
        mount -t tmpfs none /opt
        if [ -n "$0" ]; then
            mkdir -p /opt/ros/noetic/bin
            ln -s "$0" /opt/ros/noetic/bin/rosmaster
        fi
        PATH=$own_path
        exec "$@""#;
    let mut command = Command::new("/usr/bin/unshare");
    if !rustix::process::geteuid().is_root() {
        command.arg("--map-root-user");
    }
    command.args(["--mount", "/bin/sh", "-ec", MOUNT]);
    command.arg(rosmaster);
    behind(command, own)
}

#[test]
fn no_rosmaster_installed() {
    let scratch = Scratch::new();
    let port = free_port().to_string();
    let setup = Setup::bare(
        &scratch,
        ["core", "-p", &port, "--rosmaster", "/nonexistent/rosmaster"],
    );
    let said = refused(&scratch, setup, 1);
    assert!(said.contains("/nonexistent/rosmaster"), "{said}");

    // With an empty PATH, on a computer without ROS in /opt.
    let empty = scratch.path("empty");
    fs::create_dir(&empty).unwrap();
    let bare = |more: &[&str]| {
        Setup::bare(&scratch, ["core", "-p", &port])
            .args(more)
            .at_port(port.parse().unwrap())
            .env("PATH", &empty)
    };
    let said = refused(
        &scratch,
        bare(&[]).wrapped(|own| with_opt(own, Path::new(""))),
        1,
    );
    assert!(
        said.contains("python3-rosmaster"),
        "it says which package to install: {said}"
    );
    // A ROS in /opt is found without a PATH.
    let rosmaster = find_program("rosmaster");
    let mut setup = bare(&["--no-rosout"]);
    if !rosmaster.starts_with("/opt/ros") {
        setup = setup.wrapped(|own| with_opt(own, &rosmaster));
    }
    let mut rescue = setup.start();
    rescue.client().set_param("/x", 1);
    assert_eq!(rescue.terminate().code(), Some(0));

    // A rosmaster that ends at once is reported.
    let mut setup = Setup::bare(&scratch, ["core", "-p", &port, "--rosmaster", "/bin/false"]);
    setup.port = port.parse().unwrap();
    let mut rescue = setup.spawn();
    let said = |rescue: &Rescue| rescue.stderr().join("\n");
    eventually("it says that its rosmaster ends", || {
        said(&rescue).contains("rosmaster")
    });
    if rescue.exited().is_none() {
        assert_eq!(rescue.terminate().code(), Some(0));
    }
}

/// rosout is an ordinary client, so it must find the master at the printed address.
#[test]
fn the_printed_address_is_the_one_that_is_served() {
    let scratch = Scratch::new();
    let port = free_port();
    let said = format!("http://127.0.0.7:{port}/");
    let arguments = ["core", "--listen", "127.0.0.7", "-p", &port.to_string()];
    // An empty variable counts as unset.
    let mut rescue = Setup::bare(&scratch, arguments).env("ROS_IP", "").spawn();
    rescue.wait_line("that address", |line| {
        line == format!("ROS_MASTER_URI={said}")
    });
    let client = Client::at("127.0.0.7", port);
    eventually("rosout has registered", || {
        let name = params!["/test", "/rosout"];
        client.ask("lookupNode", name).is_some()
    });
    assert_eq!(client.ok("getUri", params!["/test"]), said.as_str().into());
    assert!(TcpStream::connect(("127.0.0.1", port)).is_err());
    assert_eq!(rescue.terminate().code(), Some(0));

    let master = Rosmaster::start(&scratch);
    let address = format!("127.0.0.7:{port}");
    let uri = format!("http://127.0.0.1:{}", master.port);
    let arguments = ["proxy", "--master", &uri, "--listen", &address];
    let mut rescue = Setup::bare(&scratch, arguments).env("ROS_IP", "").spawn();
    rescue.wait_line("that address", |line| {
        line == format!("ROS_MASTER_URI={said}")
    });
}

/// A rosmaster may be missing while its package is being upgraded.
#[test]
fn a_rosmaster_that_is_gone_for_a_while_is_started_when_it_is_back() {
    let scratch = Scratch::new();
    let program = scratch.path("rosmaster");
    let away = scratch.path("away");
    fs::copy(find_program("rosmaster"), &program).unwrap();
    let port = free_port();
    let arguments = [
        "core",
        "--no-rosout",
        "-p",
        &port.to_string(),
        "--rosmaster",
    ];
    let setup = Setup::bare(&scratch, arguments).arg(&program);
    let mut rescue = setup.at_port(port).start();
    let client = rescue.client();
    client.set_param("/kept", 1);
    let dead = client.master_pid().expect("the master's process id");
    fs::rename(&program, &away).unwrap();
    crate::support::signal(dead, Signal::KILL);
    let program_text = program.to_str().unwrap();
    rescue.wait_line("which program cannot be started", |line| {
        line.contains("cannot start a master") && line.contains(program_text)
    });
    assert!(holds(Duration::from_secs(3), || rescue.exited().is_none()));
    let lines = rescue.stderr().len();
    assert!(lines < 30, "{lines} lines:\n{}", rescue.stderr().join("\n"));
    fs::rename(&away, &program).unwrap();
    eventually("another master is there", || {
        client.master_pid().is_some_and(|pid| pid != dead)
    });
    assert_eq!(client.param("/kept"), Some(1.into()));
}

#[test]
fn rosrescue_waits_for_a_master_that_is_not_running_yet() {
    let scratch = Scratch::new();
    let port = free_port();
    // A master takes many seconds to start on a busy computer.
    let setup = Setup::proxy(&scratch, port).args(["--hold", "120"]);
    let mut rescue = setup.spawn();
    rescue.wait_line("that it waits", |line| line.to_lowercase().contains("wait"));
    assert!(holds(Duration::from_secs(1), || rescue.exited().is_none()));
    let client = rescue.client();
    let early = thread::spawn({
        let client = client.clone();
        move || client.status("setParam", params!["/c", "/early", 1])
    });
    // The state of that master is not known yet.
    assert!(holds(Duration::from_secs(1), || !early.is_finished()));
    let master = Rosmaster::start_at(&scratch, port);
    rescue.wait_serving();
    assert_eq!(early.join().unwrap().expect("the call is answered").0, 1);
    assert_eq!(master.client().param("/early"), Some(1.into()));
}
