//! The output and the refusals of `rosrescue install`, without a systemd: nothing is started here.

use std::fs;
use std::net::TcpListener;
use std::os::unix::fs::symlink;
use std::process::{Command, Output};

use crate::support::Scratch;

const PROGRAM: &str = env!("CARGO_BIN_EXE_rosrescue");

/// Runs `rosrescue ARGUMENTS` as a user whose home folder is in `scratch`.
fn rosrescue(scratch: &Scratch, arguments: &[&str]) -> Output {
    let mut command = Command::new(PROGRAM);
    scratch.prepare(&mut command);
    command
        .env_remove("USER")
        .env_remove("LOGNAME")
        .env_remove("SUDO_USER")
        .env_remove("ROS_HOME")
        .env_remove("ROS_LOG_DIR")
        .env_remove("XDG_CONFIG_HOME");
    command
        .env_remove("XDG_RUNTIME_DIR")
        .env_remove("ROS_MASTER_URI")
        .env("SYSTEMD_OFFLINE", "1");
    command
        .env("HOME", scratch.path(""))
        .args(arguments)
        .output()
        .unwrap()
}

#[track_caller]
fn said(output: &Output, code: i32) -> String {
    assert_eq!(output.status.code(), Some(code), "{output:?}");
    String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr)
}

#[test]
fn impossible_options_are_explained_in_one_sentence() {
    let scratch = Scratch::new();
    let nobody = ["--run-as", "nobody-of-this-name"];
    for (arguments, sentence) in [
        (&["--user", "--system"][..], "cannot be used with"),
        (&["--user", "--run-as", "root"], "cannot be used with"),
        (&nobody, "there is no user `nobody-of-this-name`"),
        (
            &[],
            "name the user that runs the service, as in --run-as robot",
        ),
        (
            &["--user", "--", "status"],
            "a service runs `core` or `proxy`",
        ),
        (&["--user", "--", "proxy"], "--master"),
        (&["--user", "--", "core", "--hold", "-3"], "--hold"),
        (
            &["--user", "--", "core", "--checkpoint", "here.yaml"],
            "write the full path of here.yaml",
        ),
        (&["--user"], "cannot ask here"),
        (&["--user", "--json"], "cannot ask here"),
    ] {
        let output = rosrescue(&scratch, &[&["install"], arguments].concat());
        let said = said(&output, 2);
        assert!(said.contains(sentence), "{arguments:?}: {said}");
    }
    assert!(!scratch.path(".config").exists());
}

#[test]
fn without_root_the_first_thing_it_says_is_that_it_needs_root() {
    let scratch = Scratch::new();
    // A user who may not read this folder.
    let program = tempfile::Builder::new().tempdir_in("/tmp").unwrap();
    let open = std::os::unix::fs::PermissionsExt::from_mode(0o755);
    fs::set_permissions(program.path(), open).unwrap();
    let copy = program.path().join("rosrescue");
    fs::copy(PROGRAM, &copy).unwrap();
    for command in ["install", "uninstall"] {
        let mut own = Command::new("setpriv");
        scratch.prepare(&mut own);
        own.args(["--reuid=65534", "--regid=65534", "--clear-groups"]);
        own.arg(&copy)
            .args([command, "--yes"])
            .env("PATH", "/usr/bin:/bin")
            .current_dir("/");
        let said = said(&own.output().unwrap(), 2);
        // sudo would not find the program in this folder.
        let copied = match command {
            "install" => format!(
                "`sudo install -m 755 {} /usr/local/bin/`, then ",
                copy.display()
            ),
            _ => String::new(),
        };
        let again = format!("needs root: run {copied}`sudo rosrescue {command} --yes`");
        assert!(said.contains(&again), "{said}");
    }
}

/// Runs `rosrescue install --user --dry-run OPTIONS` with this `ROS_MASTER_URI`.
fn dry_run(scratch: &Scratch, master: &str, options: &[&str]) -> Output {
    let mut command = Command::new(PROGRAM);
    scratch.prepare(&mut command);
    command
        .args(["install", "--user", "--dry-run"])
        .args(options)
        .env("HOME", scratch.path(""))
        .env_remove("XDG_CONFIG_HOME")
        .env("ROS_MASTER_URI", master)
        .output()
        .unwrap()
}

#[test]
fn a_master_uri_of_another_computer_has_to_be_confirmed() {
    let scratch = Scratch::new();
    for (master, why) in [
        ("http://192.0.2.1:11311", "is another computer"),
        ("http://nobody.invalid:11311", "has no address"),
    ] {
        let refused = said(&dry_run(&scratch, master, &[]), 1);
        let obstacle = format!("cannot  ROS_MASTER_URI={master} {why}");
        let todo =
            "`export ROS_MASTER_URI=http://127.0.0.1:11311/`, then run this again, or confirm it";
        assert!(
            refused.contains(&obstacle) && refused.contains(todo),
            "{refused}"
        );
        let confirmed = said(&dry_run(&scratch, master, &["--other-master"]), 0);
        assert!(
            confirmed.contains(&format!("note    ROS_MASTER_URI={master}")),
            "{confirmed}"
        );
    }
    said(&dry_run(&scratch, "http://localhost:11311", &[]), 0);
    // Nodes with this environment would look for a master at another port.
    let port = ["--", "core", "-p", "11411"];
    let refused = said(&dry_run(&scratch, "http://localhost:11311", &port), 1);
    assert!(
        refused.contains("has port 11311, and rosrescue has 11411"),
        "{refused}"
    );
}

/// In a container, root may have no sudo and no variable with the user's name.
#[test]
fn a_dry_run_needs_no_sudo() {
    let scratch = Scratch::new();
    let user = Command::new("id").arg("-un").output().unwrap().stdout;
    let user = String::from_utf8(user).unwrap();
    let output = rosrescue(&scratch, &["install", "--dry-run"]);
    // The only problem is that the program is not in a system folder. The advice keeps the options.
    let said = said(&output, 1);
    let again = "/usr/local/bin/`, then `sudo rosrescue install --dry-run`";
    assert!(said.contains(again), "{said}");
    for line in ["run     systemctl enable", &format!("User={user}")] {
        assert!(said.contains(line), "{line}: {said}");
    }
    let is_root = user.trim() == "root";
    assert_eq!(said.contains("as in --run-as robot"), is_root, "{said}");
}

#[test]
fn install_is_idempotent_and_leaves_files_of_others_alone() {
    let scratch = Scratch::new();
    let install = ["install", "--user", "--yes"];
    let units = scratch.path(".config/systemd/user");
    let service = units.join("rosrescue.service");
    fs::create_dir_all(&units).unwrap();
    fs::write(&service, "[Service]\nExecStart=/bin/true\n").unwrap();
    let refused = said(&rosrescue(&scratch, &install), 1);
    assert!(
        refused.contains("rosrescue.service was not written by `rosrescue install`"),
        "{refused}"
    );
    assert!(!units.join("rosrescue.socket").exists());
    fs::remove_file(&service).unwrap();

    said(&rosrescue(&scratch, &install), 0);
    let read = |name: &str| fs::read_to_string(units.join(name)).unwrap();
    let dropin = "rosrescue.service.d/install.conf";
    for line in [
        "Environment=ROS_IP=127.0.0.1",
        &format!("ExecStart={PROGRAM} core"),
    ] {
        assert!(read(dropin).lines().any(|it| it == line), "{line}");
    }
    let socket = read("rosrescue.socket.d/install.conf");
    assert!(
        socket.contains("\nListenStream=127.0.0.1:11311\n"),
        "{socket}"
    );
    assert!(read("rosrescue.service").contains("\nWantedBy=default.target\n"));
    assert!(said(&rosrescue(&scratch, &install), 0).starts_with("nothing to change"));

    let other = [&install[..], &["--", "core", "-p", "11399"]].concat();
    said(&rosrescue(&scratch, &other), 0);
    assert!(said(&rosrescue(&scratch, &other), 0).starts_with("nothing to change"));
    assert!(read(dropin).contains("rosrescue core -p 11399\n"));
    // A file that the user has changed into their own stays.
    fs::write(&service, "# mine\n").unwrap();
    let refused = said(&rosrescue(&scratch, &install), 1);
    assert!(
        refused.contains("rosrescue.service was not written by"),
        "{refused}"
    );
    said(&rosrescue(&scratch, &["uninstall", "--user", "--yes"]), 0);
    assert!(service.exists() && !units.join("rosrescue.service.d").exists());
    let nothing = said(&rosrescue(&scratch, &["uninstall", "--user", "--yes"]), 0);
    assert!(nothing.contains("has installed nothing here"), "{nothing}");
}

/// Runs `rosrescue install --user ARGUMENTS` beside a running service. Its systemd is a script that confirms all
/// questions. Needs root.
fn install_again(scratch: &Scratch, arguments: &[&str]) -> Output {
    let systemctl = scratch.path("bin/systemctl");
    fs::create_dir_all(systemctl.parent().unwrap()).unwrap();
    fs::write(&systemctl, "#!/bin/sh\n").unwrap();
    let all = std::os::unix::fs::PermissionsExt::from_mode(0o755);
    fs::set_permissions(&systemctl, all).unwrap();
    let run = "mount -t tmpfs tmpfs /run
        mkdir -p /run/systemd/system /run/user/systemd/private
        exec \"$0\" \"$@\"";
    let mut command = Command::new("unshare");
    scratch.prepare(&mut command);
    command
        .args(["--mount", "sh", "-ec", run, PROGRAM, "install", "--user"])
        .args(arguments)
        .env("HOME", scratch.path(""))
        .env("XDG_RUNTIME_DIR", "/run/user")
        .env_remove("XDG_CONFIG_HOME")
        .env_remove("SUDO_USER")
        .env_remove("ROS_HOME")
        .env_remove("ROS_LOG_DIR");
    let path = std::env::var("PATH").unwrap();
    let folder = scratch.path("bin");
    command.env("PATH", format!("{}:{path}", folder.display()));
    command.output().unwrap()
}

/// A rosrescue with another checkpoint would not find the rosmaster of a killed one.
#[test]
fn if_the_checkpoint_moves_the_service_is_stopped_cleanly_and_the_plan_says_so() {
    let scratch = Scratch::new();
    let install = |arguments: &[&str]| said(&install_again(&scratch, arguments), 0);
    install(&["--yes"]);
    let old = scratch.path(".ros/log/latest-chkpt.yaml");
    fs::create_dir_all(old.parent().unwrap()).unwrap();
    fs::write(&old, "").unwrap();
    let [kill, stop] = ["--signal=KILL", "stop rosrescue.socket"];
    let (folder, new) = (scratch.path("new"), scratch.path("new/100%.yaml"));
    let moved = ["--checkpoint", new.to_str().unwrap()];
    let [old, folder, new] = [&old, &folder, &new].map(|path| path.display());
    let note = format!(
        "note    the checkpoint moves from {old} to {new}. To keep the robot's state, copy it first: `mkdir -p {folder}; \
         cp {old} {new}; cp {old}.previous {new}.previous`\n"
    );
    let options = ["--dry-run", "--", "core", "-t", "6"];
    let same = install(&options);
    assert!(same.contains(kill) && !same.contains(stop), "{same}");
    assert!(!same.contains("note    the checkpoint"), "{same}");
    let moved = [&options[..], &moved].concat();
    let plan = install(&moved);
    assert!(plan.contains(stop) && !plan.contains(kill), "{plan}");
    assert!(plan.contains(&note), "{plan}");
    // The place of the installed service is read from its drop-in.
    install(&[&["--yes"], &moved[1..]].concat());
    let again = install(&[&moved[..], &["-w", "4"]].concat());
    assert!(again.contains(kill) && !again.contains(stop), "{again}");
}

/// The running service is stopped before it gets another port.
#[test]
fn a_port_in_use_is_refused_while_the_service_runs() {
    let scratch = Scratch::new();
    said(&install_again(&scratch, &["--yes"]), 0);
    let other = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = other.local_addr().unwrap().port();
    let moved = ["--yes", "--", "core", "-p", &port.to_string()];
    let refused = said(&install_again(&scratch, &moved), 1);
    let obstacle = format!("cannot  port {port} is in use");
    assert!(refused.contains(&obstacle), "{refused}");
    drop(other);
    said(&install_again(&scratch, &moved), 0);
    // The service itself is no obstacle, neither at its old addresses nor at others, nor at those of another drop-in.
    let _service = TcpListener::bind(("127.0.0.1", port)).unwrap();
    for options in [["-t", "6"], ["--listen", "0.0.0.0"]] {
        said(
            &install_again(&scratch, &[&moved[..], &options].concat()),
            0,
        );
    }
    let service = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = service.local_addr().unwrap().port();
    let dropin = scratch.path(".config/systemd/user/rosrescue.socket.d/override.conf");
    fs::write(dropin, format!("[Socket]\nListenStream={port}\n")).unwrap();
    let moved = ["--yes", "--", "core", "-p", &port.to_string()];
    said(&install_again(&scratch, &moved), 0);
}

#[test]
fn units_that_start_a_master_are_found_and_the_plan_is_json() {
    let scratch = Scratch::new();
    let units = scratch.path(".config/systemd/user");
    let wants = units.join("default.target.wants");
    fs::create_dir_all(&wants).unwrap();
    for (name, command) in [
        ("old.service", "/bin/sh -c 'exec roscore'"),
        ("robot.service", "/usr/bin/roslaunch a b.launch"),
    ] {
        fs::write(
            units.join(name),
            format!("[Service]\nExecStart={command}\n"),
        )
        .unwrap();
        symlink(units.join(name), wants.join(name)).unwrap();
    }
    let json = said(
        &rosrescue(&scratch, &["install", "--user", "--dry-run", "--json"]),
        0,
    );
    let plan: serde_json::Value = serde_json::from_str(&json).unwrap();
    let changes = plan["changes"].as_array().unwrap();
    let commands: Vec<_> = changes
        .iter()
        .filter_map(|it| it["command"].as_array())
        .collect();
    let is_old = |command: &&&Vec<serde_json::Value>| command.last().unwrap() == "old.service";
    let disables = commands.iter().find(is_old).unwrap();
    assert_eq!(disables[2], "disable", "{json}");
    assert!(json.contains("Before=robot.service"), "{json}");
    assert!(json.contains("add --wait to its roslaunch"), "{json}");

    let proxy = [
        "install",
        "--user",
        "--dry-run",
        "--",
        "proxy",
        "--master",
        "http://127.0.0.1:11312",
    ];
    let refused = said(&rosrescue(&scratch, &proxy), 1);
    assert!(
        refused.contains("old.service") && refused.contains("give the master another port"),
        "{refused}"
    );
}

/// sudo clears the environment of the commands that it runs.
#[test]
fn settings_of_the_user_who_calls_sudo_are_found() {
    let scratch = Scratch::new();
    let sudo = scratch.path("sudo");
    fs::copy("/bin/sh", &sudo).unwrap();
    let output = Command::new(&sudo)
        .args([
            "-c",
            &format!("unset ROS_IP; SUDO_USER=root {PROGRAM} install --dry-run; exit $?"),
        ])
        .env("ROS_IP", "10.0.0.7")
        .env_remove("ROS_MASTER_URI")
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(said.contains("  Environment=ROS_IP=10.0.0.7"), "{output:?}");
    assert!(said.contains("  User=root"), "{said}");
}

#[test]
fn installed_completions_match_the_command_line() {
    let scratch = Scratch::new();
    for shell in ["bash", "zsh", "fish"] {
        let script = said(&rosrescue(&scratch, &["completions", shell]), 0);
        assert!(
            script.contains("reap") && script.contains("uninstall"),
            "{shell}"
        );
    }
    assert!(said(&rosrescue(&scratch, &["completions", "cmd"]), 2).contains("possible values"));
    let page = said(&rosrescue(&scratch, &["man"]), 0);
    assert!(
        page.contains(".TH rosrescue 1") && page.contains("ROSRESCUE_CHECKPOINT"),
        "{page}"
    );
    let page = said(&rosrescue(&scratch, &["man", "status"]), 0);
    assert!(page.contains(".TH rosrescue-status 1"), "{page}");
    let refused = said(&rosrescue(&scratch, &["man", "stauts"]), 2);
    assert!(
        refused.contains("there is no command `stauts`"),
        "{refused}"
    );
    let folder = scratch.path("pages");
    let folder = folder.to_str().unwrap();
    said(&rosrescue(&scratch, &["man", "--folder", folder]), 0);
    assert!(scratch.path("pages/rosrescue-install.1").exists());
}
