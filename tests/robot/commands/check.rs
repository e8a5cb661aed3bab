//! `rosrescue check` on this computer, with problems built in.

use std::fs;
use std::process::Command;

use serde_json::Value;

use crate::support::{
    Library, Mode, Netns, Process, Robot, Rosmaster, Scratch, Setup, behind, find_program,
    free_port,
};

/// If this variable is set, it names the rosmaster.
const ROSMASTER: &str = "ROSRESCUE_ROSMASTER";

/// A check of port `port` in an environment without problems. A rosmaster that is named is not imported in Python, which
/// would take most of the check's time.
fn check(scratch: &Scratch, port: u16) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_rosrescue"));
    scratch.prepare(&mut command);
    command
        .args(["check", "--port", &port.to_string()])
        .env("ROS_MASTER_URI", format!("http://127.0.0.1:{port}"))
        .env(ROSMASTER, find_program("rosmaster"));
    command
}

/// The findings of a check.
struct Found {
    report: Value,
    status: Option<i32>,
}

impl Found {
    #[track_caller]
    fn by(command: &mut Command) -> Self {
        let mut process = Process::start("a check", command.arg("--json"));
        let status = process.wait_output().code();
        Self {
            report: serde_json::from_str(&process.stdout().join("\n")).expect("JSON"),
            status,
        }
    }

    /// The findings of this severity.
    fn of(&self, severity: &str) -> Vec<&Value> {
        let all = self.report["findings"].as_array().unwrap().iter();
        all.filter(|finding| finding["severity"] == severity)
            .collect()
    }

    /// Asserts that the only problem is about `subject` and contains `words`.
    #[track_caller]
    fn assert_problem(&self, subject: &str, words: &str) {
        let problems = self.of("problem");
        assert_eq!(problems.len(), 1, "{:#}", self.report);
        assert_eq!(problems[0]["subject"], subject, "{problems:?}");
        let what = problems[0]["what"].as_str().unwrap();
        assert!(what.contains(words), "{what}");
        assert_ne!(problems[0]["todo"], "", "{problems:?}");
        assert_eq!(
            (self.status, &self.report["problems"]),
            (Some(1), &1.into())
        );
    }

    #[track_caller]
    fn assert_no_problem(&self) {
        assert_eq!(self.of("problem"), Vec::<&Value>::new());
        assert_eq!(self.status, Some(0));
    }

    /// The text of the findings about `subject`.
    #[track_caller]
    fn said(&self, subject: &str) -> String {
        let all = self.report["findings"].as_array().unwrap().iter();
        let of: Vec<_> = all
            .filter(|finding| finding["subject"] == subject)
            .map(|finding| finding["what"].as_str().unwrap())
            .collect();
        assert!(!of.is_empty(), "nothing of {subject}: {:#}", self.report);
        of.join("\n")
    }
}

#[test]
fn a_computer_in_order_has_no_problem() {
    let scratch = Scratch::new();
    let port = free_port();
    let found = Found::by(check(&scratch, port).env_remove(ROSMASTER));
    found.assert_no_problem();
    assert_eq!(found.said("port"), format!("{port} is free"));
    assert!(found.said("rosmaster").contains("1.1"));
    // The check has created nothing, not even a folder.
    assert_eq!(fs::read_dir(scratch.log_dir()).unwrap().count(), 0);
    let mut words = Process::start("a check", &mut check(&scratch, port));
    words.wait_output();
    let said = words.stdout();
    let port = format!("ok       port            {port} is free");
    assert!(said.contains(&port), "{said:?}");
    let last = said.last().unwrap();
    let warns = last.starts_with("0 problems, ");
    assert!(warns || last == "No problems found.", "{said:?}");
}

#[test]
fn a_forgotten_master_is_found_and_a_running_rosrescue_is_fine() {
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    let port = master.client().port();
    let found = Found::by(&mut check(&scratch, port));
    let who = format!("rosmaster (process {}, port {port})", master.pid());
    found.assert_problem("port", &who);
    // With this rosmaster as `--master` the check finds no problem. With rosrescue as `--master` it finds one.
    let uri = format!("http://127.0.0.1:{port}");
    let free = free_port();
    let found = Found::by(check(&scratch, free).args(["--master", &uri]));
    found.assert_no_problem();
    let said = found.said("master");
    assert!(
        said.contains("answers: HTTP/1.") && said.contains("Python 3."),
        "{said}"
    );
    let nobody = format!("http://127.0.0.1:{}", free_port());
    let found = Found::by(check(&scratch, free).args(["--master", &nobody]));
    found.assert_no_problem();
    assert!(found.said("master").contains("no answer from"));
    let rescue = Setup::proxy(&scratch, port).start();
    let found = Found::by(&mut check(&scratch, rescue.port()));
    found.assert_no_problem();
    let runs = found.said("port");
    let it = concat!(
        "rosrescue ",
        env!("CARGO_PKG_VERSION"),
        " runs here: rosrescue (process "
    );
    assert!(runs.contains(it), "{runs}");
    let found = Found::by(check(&scratch, free).args(["--master", &rescue.client().uri()]));
    let problems: Vec<_> = found
        .of("problem")
        .iter()
        .map(|one| one["subject"].clone())
        .collect();
    assert_eq!(problems, ["master"]);
}

#[test]
fn a_node_at_a_host_without_an_address_is_found() {
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    let rescue = Setup::proxy(&scratch, master.client().port()).start();
    let register = ["/lost", "/chatter", "*", "http://nobody.invalid:4711/"];
    let register = register.map(ros1_master::xmlrpc::Value::from).to_vec();
    rescue.client().ok("registerSubscriber", register);
    let found = Found::by(&mut check(&scratch, rescue.port()));
    found.assert_problem("nodes", "/lost registered at nobody.invalid");
}

#[test]
fn a_launch_file_that_names_another_master_is_found() {
    let scratch = Scratch::new();
    let launch = scratch.path("packages").join("arm.launch");
    fs::create_dir_all(launch.parent().unwrap()).unwrap();
    let port = free_port();
    let env = |uri: &str| format!("<env name=\"ROS_MASTER_URI\" value=\"{uri}\"/>\n");
    // The first `env` names the robot's own master in another form.
    let own = env(&format!("http://localhost:{port}/"));
    let text = format!(
        "<launch>\n{own}{}</launch>\n",
        env("http://192.0.2.1:11311")
    );
    fs::write(&launch, text).unwrap();
    let packages = launch.parent().unwrap();
    let found = Found::by(check(&scratch, port).env("ROS_PACKAGE_PATH", packages));
    found.assert_no_problem();
    let said = found.said("launch files");
    let line = "arm.launch:3 sets ROS_MASTER_URI to http://192.0.2.1:11311";
    assert!(said.ends_with(line) && said.lines().count() == 1, "{said}");
}

#[test]
fn a_node_of_another_master_is_found() {
    let robot = Robot::start(Mode::Core);
    let node = robot.node(Library::Rospy, "listener", &[]);
    let stray = format!("(process {}, port ", node.pid());
    let found = Found::by(&mut check(&robot.scratch, free_port()));
    let said = found.said("ROS_MASTER_URI");
    assert!(said.contains(&stray), "{said}");
    // At its own master it causes no finding, in whatever form the address is written.
    let mut own = check(&robot.scratch, robot.port());
    own.env(
        "ROS_MASTER_URI",
        format!("http://localhost:{}/", robot.port()),
    );
    let said = Found::by(&mut own).said("ROS_MASTER_URI");
    assert!(!said.contains(&stray), "{said}");
}

#[test]
fn another_program_at_the_port_is_found() {
    let scratch = Scratch::new();
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    let closing = std::thread::spawn(move || {
        // The check asks for the status page and for the Master API.
        for _ in 0..2 {
            drop(listener.accept());
        }
        listener
    });
    let found = Found::by(&mut check(&scratch, port));
    found.assert_problem("port", "a program that is not a master");
    drop(closing.join());
}

#[test]
fn wrong_environment_variables_are_found() {
    let scratch = Scratch::new();
    let port = free_port();
    for (key, value, subject, words) in [
        (
            "ROS_IP",
            "127.0.0.1 ",
            "ROS_IP",
            "begins or ends with a space",
        ),
        (
            "ROS_IP",
            "192.0.2.1",
            "ROS_IP",
            "192.0.2.1, which is not this computer",
        ),
        (
            "ROS_HOSTNAME",
            "nobody.invalid",
            "ROS_HOSTNAME",
            "nobody.invalid has no address",
        ),
        (
            "ROS_HOSTNAME",
            "http://localhost",
            "ROS_HOSTNAME",
            "is not a host name",
        ),
        (
            "ROS_MASTER_URI",
            "http://nobody.invalid:11311",
            "ROS_MASTER_URI",
            "has no address",
        ),
        (
            "ROS_MASTER_URI",
            "http://192.0.2.1:11311",
            "ROS_MASTER_URI",
            "is another computer",
        ),
        (
            "ROS_MASTER_URI",
            "http://127.0.0.1:1",
            "ROS_MASTER_URI",
            "has port 1, but rosrescue",
        ),
        (
            "ROS_MASTER_URI",
            "http://127.0.0.1",
            "ROS_MASTER_URI",
            "has no port: roscpp nodes do not start",
        ),
        (
            "ROS_MASTER_URI",
            "localhost:11311",
            "ROS_MASTER_URI",
            "is not the URI of a master",
        ),
        (
            "ROSRESCUE_ROSMASTER",
            "/nowhere/rosmaster",
            "rosmaster",
            "/nowhere/rosmaster",
        ),
        (
            "ROSRESCUE_CHECKPOINT",
            "/proc/1/checkpoint",
            "checkpoint",
            "/proc/1",
        ),
    ] {
        let mut command = check(&scratch, port);
        if key == "ROS_HOSTNAME" {
            command.env_remove("ROS_IP");
        }
        let found = Found::by(command.env(key, value));
        let problems = found.of("problem");
        let about: Vec<_> = problems
            .iter()
            .filter(|one| one["subject"] == subject)
            .collect();
        let said: String = about
            .iter()
            .map(|one| one["what"].as_str().unwrap())
            .collect();
        assert!(said.contains(words), "{key}={value}: {:#}", found.report);
        assert_eq!(found.status, Some(1));
    }
}

#[test]
fn missing_rosmaster_descriptors_and_permissions_are_found() {
    let scratch = Scratch::new();
    let port = free_port();
    let searching = || {
        let mut command = check(&scratch, port);
        command.env_remove(ROSMASTER);
        command
    };
    let found = Found::by(searching().env("PATH", "/nowhere"));
    found.assert_problem("rosmaster", "there is no rosmaster on the PATH");
    // A python without ROS comes before the system's.
    let tools = scratch.path("tools");
    fs::create_dir(&tools).unwrap();
    std::os::unix::fs::symlink("/bin/false", tools.join("python3")).unwrap();
    let path = format!("{}:/usr/bin:/bin", tools.display());
    let found = Found::by(searching().env("PATH", path));
    found.assert_no_problem();
    assert!(found.said("python").contains("tools/python3 comes first"));
    let mut few = Command::new("sh");
    few.args(["-c", r#"ulimit -n 100; exec "$0" "$@""#]);
    let found = Found::by(&mut behind(few, &check(&scratch, port)));
    found.assert_problem("descriptors", "100 open files");
    // A user who may not write to the checkpoint's folder.
    let mut nobody = Command::new("setpriv");
    nobody.args([
        "--reuid",
        "65534",
        "--clear-groups",
        "--inh-caps=-all",
        "--",
    ]);
    // Other users may not be able to read the program's own folder.
    let shared = tempfile::Builder::new().tempdir_in("/tmp").unwrap();
    let program = shared.path().join("rosrescue");
    fs::copy(env!("CARGO_BIN_EXE_rosrescue"), &program).unwrap();
    open_to_all(shared.path());
    let mut command = Command::new(&program);
    scratch.prepare(&mut command);
    let closed = shared.path().join("closed");
    fs::create_dir(&closed).unwrap();
    let checkpoint = closed.join("checkpoint");
    command
        .args(["check", "--port", &port.to_string(), "--checkpoint"])
        .arg(&checkpoint)
        .env("ROS_MASTER_URI", format!("http://127.0.0.1:{port}"));
    let found = Found::by(&mut behind(nobody, &command));
    found.assert_problem("checkpoint", "cannot be written: Permission denied");
}

fn open_to_all(folder: &std::path::Path) {
    use std::os::unix::fs::PermissionsExt;
    fs::set_permissions(folder, fs::Permissions::from_mode(0o755)).unwrap();
}

/// On Debian the computer's own name resolves to 127.0.1.1. A roscore also starts at boot, at the same port.
#[test]
fn problems_in_the_hosts_file_and_units_are_found() {
    let scratch = Scratch::new();
    let port = free_port();
    let hosts = scratch.path("hosts");
    fs::write(&hosts, "127.0.0.1 localhost\n127.0.1.1 robot\n").unwrap();
    let units = scratch.path("units");
    fs::create_dir_all(units.join("multi-user.target.wants")).unwrap();
    let core = units.join("roscore.service");
    let unit = format!("[Service]\nExecStart=/opt/ros/noetic/bin/roscore -p {port}\n");
    fs::write(&core, unit).unwrap();
    std::os::unix::fs::symlink(&core, units.join("multi-user.target.wants/roscore.service"))
        .unwrap();
    const INSIDE: &str = r#"mount --bind "$0" /etc/hosts && mount --bind "$1" /run && mkdir -p /run/systemd/system &&
        cp -a "$2/." /run/systemd/system && hostname robot && shift 2 && exec "$@""#;
    let run = scratch.path("run");
    fs::create_dir(&run).unwrap();
    let mut own = Command::new("unshare");
    own.args(["--mount", "--uts", "sh", "-c", INSIDE]);
    own.arg(&hosts).arg(&run).arg(&units);
    let mut command = check(&scratch, port);
    command.env_remove("ROS_IP");
    let found = Found::by(&mut behind(own, &command));
    found.assert_problem("systemd", "roscore.service starts another master");
    assert!(
        found
            .said("host name")
            .contains("robot is 127.0.1.1, which other computers cannot reach"),
        "{:#}",
        found.report
    );
}

/// `hostname -I` prints all addresses, and people export them as they are.
#[test]
fn the_advice_for_several_addresses_is_a_command() {
    let scratch = Scratch::new();
    let found = Found::by(check(&scratch, free_port()).env("ROS_IP", "127.0.0.1 192.0.2.7 "));
    found.assert_problem("ROS_IP", "is more than one address");
    let todo = found.of("problem")[0]["todo"].as_str().unwrap();
    let command = todo.split('`').nth(1).unwrap();
    let line = format!("{command}; echo $ROS_IP");
    let output = Command::new("bash").args(["-ec", &line]).output().unwrap();
    assert_eq!(
        String::from_utf8_lossy(&output.stdout),
        "127.0.0.1\n",
        "{todo}"
    );
}

#[test]
fn a_stale_bashrc_is_found_and_the_advice_corrects_it() {
    let (scratch, port) = (Scratch::new(), free_port());
    let home = scratch.path("home");
    fs::create_dir(&home).unwrap();
    let text = "alias ll='ls -l'\nexport ROS_MASTER_URI=http://192.0.2.1:11311\n";
    let bashrc = home.join(".bashrc");
    fs::write(&bashrc, text).unwrap();
    let check = || {
        let mut command = check(&scratch, port);
        command.env("HOME", &home).env("SHELL", "/bin/bash");
        Found::by(&mut command)
    };
    let found = check();
    let said = found.said("ROS_MASTER_URI");
    assert!(
        said.contains(".bashrc:2 sets http://192.0.2.1:11311 in every new shell"),
        "{said}"
    );
    let warnings = found.of("warning");
    let todo = warnings
        .iter()
        .find(|one| one["subject"] == "ROS_MASTER_URI");
    let todo = todo.unwrap()["todo"].as_str().unwrap();
    let command = todo.split('`').nth(1).unwrap();
    assert!(
        Command::new("bash")
            .args(["-ec", command])
            .status()
            .unwrap()
            .success()
    );
    let uri = format!("export ROS_MASTER_URI=http://127.0.0.1:{port}\n");
    assert!(fs::read_to_string(&bashrc).unwrap().ends_with(&uri));
    assert!(!check().said("ROS_MASTER_URI").contains(".bashrc"));
}

/// A computer with a port that takes no connection, as behind a firewall that drops packets: its queue is full. Needs
/// root.
#[test]
fn a_firewall_on_another_computer_is_found() {
    const FULL: &str = "import socket, time\n\
        s = socket.socket(); s.bind(('0.0.0.0', 0)); s.listen(0)\n\
        c = [socket.socket() for _ in range(4)]\n\
        [x.setblocking(False) for x in c]; [x.connect_ex(s.getsockname()) for x in c]\n\
        print(s.getsockname()[1], flush=True); time.sleep(600)";
    let (scratch, computer) = (Scratch::new(), Netns::new());
    let (near, far) = (computer.near(), computer.far(2));
    let mut python = Command::new("/usr/bin/python3");
    python.args(["-c", FULL]);
    let mut full = Process::start("a full port", &mut computer.inside(&python));
    let blocked = full.wait_line("its port", |line| !line.is_empty());
    let rescue = Setup::core(&scratch, free_port())
        .env("ROS_IP", &near)
        .start();
    let register = |node: &str, port: &str| {
        let api = format!("http://{far}:{port}/");
        let register = [node, "/chatter", "*", &api].map(ros1_master::xmlrpc::Value::from);
        rescue.client().ok("registerSubscriber", register.to_vec());
    };
    register("/blocked", &blocked);
    // This port refuses connections, so the computer answers.
    register("/dead", "1");
    let check = |uri: String| {
        let mut command = check(&scratch, rescue.port());
        command.env("ROS_IP", &near).env("ROS_MASTER_URI", uri);
        Found::by(&mut command)
    };
    let found = check(format!("http://{near}:{}", rescue.port()));
    let words =
        format!("{far} is on, but does not answer at 1 of 2 ports tried: {blocked} (/blocked)");
    // The dead node is a problem of its own.
    let problems = found.of("problem").into_iter();
    let network: Vec<_> = problems.filter(|it| it["subject"] == "network").collect();
    assert_eq!(network.len(), 1, "{:#}", found.report);
    let (what, todo) = (&network[0]["what"], network[0]["todo"].as_str().unwrap());
    assert!(what.as_str().unwrap().contains(&words), "{what}");
    assert!(
        todo.contains(&format!("`sudo ufw allow from {near}`")),
        "{todo}"
    );
    // The master of a robot whose computer blocks its port.
    let found = check(format!("http://{far}:{blocked}"));
    let said = found.said("network");
    let words = format!("{blocked} (the master)");
    assert!(said.contains(&words), "{said}");
}

#[test]
fn bad_input_is_one_sentence() {
    let scratch = Scratch::new();
    let mut process = Process::start("a check", check(&scratch, 1).args(["--master", "here"]));
    assert_eq!(process.wait_output().code(), Some(2));
    let said = process.stderr();
    assert_eq!(said.len(), 1, "{said:?}");
    assert!(
        said[0].contains("--master: `here` is not the URI"),
        "{said:?}"
    );
}
