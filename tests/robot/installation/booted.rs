//! A service of a real systemd that is process 1 in new namespaces. Needs root and systemd.

use std::fs;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::Instant;

use ros1_master::xmlrpc::{self, Reply, Value};

use crate::support::{PATIENCE, Scratch, encode_call, eventually, params};

const BOOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/support/boot_systemd.sh");
const PROGRAM: &str = "/opt/rosrescue/rosrescue";

/// A simulated computer that has booted. It ends on drop.
pub(super) struct Booted {
    unshare: Child,
    pid: String,
    scratch: Scratch,
}

impl Booted {
    #[track_caller]
    pub(super) fn new() -> Self {
        let scratch = Scratch::new();
        let kinds = "--mount --pid --net --uts --ipc --fork --kill-child";
        let [folder, given] = ["computer", "given"].map(|name| scratch.path(name));
        fs::create_dir(&folder).unwrap();
        fs::create_dir(&given).unwrap();
        let file = fs::File::create(scratch.path("boot.log")).unwrap();
        let unshare = Command::new("unshare")
            .args(kinds.split(' '))
            .args([
                BOOT,
                folder.to_str().unwrap(),
                env!("CARGO_BIN_EXE_rosrescue"),
                given.to_str().unwrap(),
            ])
            .stdin(Stdio::null())
            .stdout(file.try_clone().unwrap())
            .stderr(file)
            .spawn()
            .unwrap();
        let id = unshare.id();
        let child =
            || fs::read_to_string(format!("/proc/{id}/task/{id}/children")).unwrap_or_default();
        eventually("the computer has a first process", || {
            !child().trim().is_empty()
        });
        let pid = child().trim().to_owned();
        let booted = Self {
            unshare,
            pid,
            scratch,
        };
        // Until systemd runs, the root folder of the process is still that of this computer.
        eventually(
            "systemd runs as the first process; this needs root, systemd-sysv and dbus (see boot.log in the scratch folder)",
            || {
                let name = fs::read_to_string(format!("/proc/{}/comm", booted.pid));
                name.is_ok_and(|name| name.trim() == "systemd")
            },
        );
        let state = || booted.run("systemctl is-system-running || true");
        eventually("a boot", || {
            ["running\n", "degraded\n"].contains(&&*state())
        });
        let failed = booted.run("systemctl list-units --failed --no-legend");
        assert_eq!(state(), "running\n", "{failed}");
        booted.run("useradd --create-home robot");
        booted
    }

    fn output(&self, script: &str) -> Output {
        Command::new("nsenter")
            .args([
                "-t", &self.pid, "-m", "-p", "-n", "-u", "-i", "-C", "-r", "-w",
            ])
            .args([
                "env",
                "-i",
                "HOME=/root",
                "PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin",
            ])
            .args(["sh", "-c", script])
            .stdin(Stdio::null())
            .output()
            .unwrap()
    }

    pub(super) fn try_run(&self, script: &str) -> Result<String, String> {
        let output = self.output(script);
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        let errors = String::from_utf8_lossy(&output.stderr);
        match output.status.success() {
            true => Ok(text),
            false => Err(format!(
                "{script}: {:?}: {text}{errors}",
                output.status.code()
            )),
        }
    }

    #[track_caller]
    pub(super) fn run(&self, script: &str) -> String {
        self.try_run(script).unwrap_or_else(|said| panic!("{said}"))
    }

    /// Copies `file` to the simulated computer. Returns its name there, because the file's own folder, such as /tmp,
    /// may be hidden.
    pub(super) fn give(&self, file: &Path) -> String {
        let name = file.file_name().unwrap();
        fs::copy(file, self.scratch.path("given").join(name)).unwrap();
        format!("/given/{}", name.display())
    }

    fn write(&self, path: &str, text: &str) {
        self.run(&format!(
            "mkdir -p $(dirname {path}); cat >{path} <<'END'\n{text}\nEND"
        ));
    }

    /// Makes a call of the Master API at the robot's port. Returns the value in the answer.
    #[track_caller]
    pub(super) fn call(&self, method: &str, params: Vec<Value>) -> Value {
        let body = String::from_utf8(encode_call(method, params)).unwrap();
        let answer = self.run(&format!(
            "curl -fsS -H 'Content-Type: text/xml' --data-binary @- http://127.0.0.1:11311/ <<'END'\n{body}\nEND"
        ));
        match xmlrpc::decode_reply(answer.as_bytes()) {
            Ok(Reply::Value(Value::Array(mut answer))) if answer.first() == Some(&1.into()) => {
                answer.pop().unwrap()
            }
            other => panic!("{method}: {other:?}"),
        }
    }

    #[track_caller]
    pub(super) fn set_kept(&self) {
        self.call("setParam", params!["/test", "/kept", 7]);
    }

    #[track_caller]
    pub(super) fn assert_kept(&self, when: &str) {
        let kept = self.call("getParam", params!["/test", "/kept"]);
        assert_eq!(kept, 7.into(), "{when}");
    }

    pub(super) fn property(&self, name: &str) -> String {
        let value = self.run(&format!(
            "systemctl show --value -p {name} rosrescue.service"
        ));
        value.trim().to_owned()
    }

    /// Waits until `grep` with the arguments `pattern` finds something in a property of the service. The loop runs on the
    /// simulated computer, because each command that is sent there takes several processes.
    #[track_caller]
    fn wait_property(&self, name: &str, pattern: &str) {
        let looks = 10 * PATIENCE.as_secs();
        let script = format!(
            "for look in $(seq {looks}); do
                 systemctl show --value -p {name} rosrescue.service | grep -q {pattern} && exit
                 sleep 0.1
             done
             exit 1"
        );
        if self.try_run(&script).is_err() {
            let units = "rosrescue.service rosrescue.socket";
            let look = format!(
                "systemctl cat {units}; systemctl status -l {units}; journalctl -u rosrescue -n 60"
            );
            panic!(
                "{name} of the service is not {pattern}: {:?}",
                self.output(&look)
            );
        }
    }

    #[track_caller]
    pub(super) fn wait_protected(&self) {
        self.wait_property("StatusText", "^protected");
    }

    /// Waits until the service has another worker than the one with this process id.
    #[track_caller]
    pub(super) fn wait_another_worker(&self, worker: &str) {
        self.wait_property("MainPID", &format!("-vxe {worker} -e 0"));
    }

    /// All lines about the service so far. systemd gives them to journald, which may write them a moment later.
    #[track_caller]
    fn journal(&self) -> String {
        self.run("journalctl --sync; journalctl -u rosrescue.service")
    }

    /// All files in folders where an installation could leave something.
    fn files(&self) -> String {
        self.run("find /etc /usr/local /usr/lib/systemd -path '/etc/.*' -prune -o -print | sort")
    }
}

impl Drop for Booted {
    fn drop(&mut self) {
        let _ = Command::new("kill").args(["-9", &self.pid]).status();
        let _ = self.unshare.wait();
        let _ = Command::new("unshare")
            .args(["--mount", BOOT, "--forget"])
            .arg(self.scratch.path("computer"))
            .status();
    }
}

/// A robot before the installation, with a unit for roscore and one from robot_upstart.
fn with_units_of_old() -> Booted {
    let robot = Booted::new();
    robot.write(
        "/etc/systemd/system/roscore.service",
        "[Service]\nUser=robot\nExecStart=/bin/bash -c 'exec roscore'\n[Install]\nWantedBy=multi-user.target",
    );
    robot.write(
        "/usr/sbin/myrobot-start",
        "#!/bin/bash\nexec sleep 1000 # roslaunch\nroslaunch base.launch &",
    );
    robot.write(
        "/etc/systemd/system/myrobot.service",
        "[Service]\nExecStart=/usr/sbin/myrobot-start\n[Install]\nWantedBy=multi-user.target",
    );
    robot.run(
        "chmod +x /usr/sbin/myrobot-start; systemctl enable --now roscore.service myrobot.service",
    );
    robot
}

#[test]
fn a_service_can_be_installed_survives_deaths_and_is_removed_without_a_trace() {
    let robot = with_units_of_old();
    let before = robot.files();
    let shown = robot.run(&format!("SUDO_USER=robot {PROGRAM} install --dry-run"));
    assert!(shown.contains("disable --now roscore.service"), "{shown}");
    assert!(
        shown.contains("myrobot.service") && shown.contains("add --wait"),
        "{shown}"
    );
    let unasked = robot.output(&format!("SUDO_USER=robot {PROGRAM} install"));
    assert_eq!(unasked.status.code(), Some(2), "{unasked:?}");
    assert_eq!(robot.files(), before);

    robot.run(&format!(
        "SUDO_USER=robot ROS_HOSTNAME=localhost {PROGRAM} install --yes"
    ));
    robot.wait_protected();
    assert!(
        robot
            .try_run("systemctl is-enabled roscore.service")
            .is_err()
    );
    assert!(robot.try_run("pgrep -x roscore").is_err());
    assert!(robot.property("Before").contains("myrobot.service"));
    robot.run("pgrep -x -u robot rosmaster; test -s /home/robot/.ros/log/latest-chkpt.yaml");
    robot.set_kept();
    let verified = robot.output("systemd-analyze verify rosrescue.service rosrescue.socket");
    let complaints = String::from_utf8_lossy(&verified.stderr).into_owned();
    assert!(!complaints.contains("rosrescue"), "{complaints}");
    let again = robot.run(&format!(
        "SUDO_USER=robot ROS_HOSTNAME=localhost {PROGRAM} install --yes"
    ));
    assert!(again.contains("nothing to change"), "{again}");

    // The worker dies; later it hangs.
    robot.write(
        "/etc/systemd/system/rosrescue.service.d/test.conf",
        "[Service]\nWatchdogSec=1",
    );
    robot.run("systemctl daemon-reload");
    let master = robot.run("pgrep -x rosmaster");
    for (signal, result) in [("KILL", "signal"), ("STOP", "watchdog")] {
        let worker = robot.property("MainPID");
        // On a busy computer the watchdog may already have ended the worker.
        robot.run(&format!(
            "test {worker} = 0 || kill -{signal} {worker} || true"
        ));
        // systemd keeps the port open, so the call waits.
        robot.assert_kept(signal);
        robot.wait_another_worker(&worker);
        let journal = robot.journal();
        assert!(
            journal.contains(&format!("Failed with result '{result}'")),
            "{journal}"
        );
        assert_eq!(
            robot.run("pgrep -x rosmaster"),
            master,
            "{signal}: rosmaster was replaced"
        );
        robot.wait_protected();
    }
    robot.run("kill -9 $(pgrep -x rosmaster)");
    eventually("another master", || {
        robot.run("pgrep -x rosmaster || true") != master
    });
    robot.assert_kept("after a death of the master");

    // The service is installed again with other options. A unit file that is not rosrescue's is refused.
    let worker = robot.property("MainPID");
    robot.run(
        "sed -i 's/^# Written by/# Mine, not written by/' /etc/systemd/system/rosrescue.service",
    );
    let refused = robot.output(&format!("SUDO_USER=robot {PROGRAM} install --yes"));
    assert_eq!(refused.status.code(), Some(1), "{refused:?}");
    assert!(
        String::from_utf8_lossy(&refused.stdout).contains("rosrescue.service was not written by")
    );
    robot.run(
        "sed -i 's/^# Mine, not written by/# Written by/' /etc/systemd/system/rosrescue.service",
    );
    robot.run(&format!(
        "SUDO_USER=robot ROS_HOSTNAME=localhost {PROGRAM} install --yes -- core -t 6"
    ));
    robot.wait_another_worker(&worker);
    assert!(robot.property("ExecStart").contains("core -t 6"));
    robot.assert_kept("with other options");

    // With another checkpoint, no master is left behind. The state comes along if it is copied as the plan says.
    let install = format!(
        "SUDO_USER=robot ROS_HOSTNAME=localhost ROS_LOG_DIR=/home/robot/logs {PROGRAM} install"
    );
    let plan = robot.run(&format!("{install} --dry-run"));
    let (_, copy) = plan.split_once("copy it first: `").expect(&plan);
    let copy = copy.split('`').next().unwrap();
    let copy = copy.replace("sudo -u robot", "setpriv --reuid robot --clear-groups");
    let copy = copy.replace("sudo ", "");
    let worker = robot.property("MainPID");
    robot.run(&format!("{copy}; {install} --yes"));
    robot.wait_another_worker(&worker);
    robot.wait_protected();
    robot.run("test -s /home/robot/logs/latest-chkpt.yaml");
    robot.assert_kept("with another checkpoint");
    assert_eq!(robot.run("pgrep -cx rosmaster"), "1\n");

    robot.run("rm /etc/systemd/system/rosrescue.service.d/test.conf");
    robot.run(&format!("{PROGRAM} uninstall --yes"));
    assert_eq!(robot.files(), before);
    assert!(robot.try_run("pgrep -x rosrescue").is_err());
    eventually("roscore", || {
        robot.run("systemctl is-enabled roscore; systemctl is-active roscore")
            == "enabled\nactive\n"
    });
}

/// A call that waits lets the socket unit start the service again, whatever `Restart=` says.
#[test]
fn a_wrong_option_costs_a_start_every_two_seconds_until_it_is_corrected() {
    let robot = Booted::new();
    robot.run(&format!(
        "SUDO_USER=robot ROS_HOSTNAME=localhost {PROGRAM} install --yes"
    ));
    robot.wait_protected();
    robot.write("/etc/default/rosrescue", "ROSRESCUE_HOLD=10s");
    let start = Instant::now();
    let restarted = robot.try_run("systemctl restart rosrescue.service");
    assert!(restarted.is_err(), "{restarted:?}");
    let call = robot.output("curl -sS --max-time 5 http://127.0.0.1:11311/");
    assert!(!call.status.success(), "{call:?}");
    let journal = robot.journal();
    let failed = journal.matches("Failed with result 'exit-code'").count();
    let most = 1 + start.elapsed().as_secs() / 2;
    assert!(
        (1..=most).contains(&(failed as u64)),
        "{failed} in {most}: {journal}"
    );
    robot.run("rm /etc/default/rosrescue");
    robot.wait_protected();
}

#[test]
fn a_user_can_install_a_service_without_root() {
    let robot = Booted::new();
    robot.run("loginctl enable-linger robot");
    let as_user = |command: &str| {
        format!(
            "cd /home/robot && exec setpriv --reuid=robot --regid=robot --init-groups env HOME=/home/robot USER=robot \
             XDG_RUNTIME_DIR=/run/user/$(id -u robot) {command}"
        )
    };
    eventually("the systemd of the user runs", || {
        robot
            .try_run(&as_user("systemctl --user is-system-running"))
            .is_ok()
    });
    let files = "sh -c 'find .config .local ! -type d 2>/dev/null | sort'";
    let before = robot.run(&as_user(files));
    // The socket of a proxy that waits for its first master is no obstacle to another choice.
    robot.run(&as_user(&format!(
        "{PROGRAM} install --user --yes -- proxy --master http://localhost:1"
    )));
    robot.run(&as_user(&format!("{PROGRAM} install --user --yes")));
    let status = "systemctl --user show --value -p StatusText rosrescue.service";
    eventually("STATUS=protected", || {
        robot.run(&as_user(status)).starts_with("protected")
    });
    robot.run("pgrep -x -u robot rosmaster");
    robot.run(&as_user(&format!("{PROGRAM} uninstall --user --yes")));
    let after = robot.run(&as_user(files));
    assert_eq!(after, before);
    assert!(robot.try_run("pgrep -x rosrescue").is_err());
}
