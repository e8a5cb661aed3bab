//! The Debian package, in a fresh Debian made by debootstrap, and under a systemd.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;

use super::booted::Booted;
use crate::support::Scratch;

const ROOT: &str = env!("CARGO_MANIFEST_DIR");

/// Two versions of the package, 0.2.0 and 0.2.1, which are made once. Another test process that also needs them waits until
/// this one has ended.
#[track_caller]
fn packages() -> &'static [PathBuf; 2] {
    static PACKAGES: OnceLock<([PathBuf; 2], File)> = OnceLock::new();
    let (packages, _) = PACKAGES.get_or_init(|| {
        let lock =
            File::create(Path::new(env!("CARGO_TARGET_TMPDIR")).join("package.lock")).unwrap();
        lock.lock().unwrap();
        let output = Command::new("packaging/build-deb.sh")
            .args(["--debug", "--version", "0.2.0"])
            .current_dir(ROOT)
            .stderr(Stdio::inherit())
            .output()
            .unwrap();
        assert!(
            output.status.success(),
            "packaging/build-deb.sh: {output:?}"
        );
        let old = String::from_utf8(output.stdout).unwrap();
        let old = Path::new(ROOT).join(old.trim());
        let new = old.with_file_name(name(&old).replace("0.2.0", "0.2.1"));
        repack(&old, &new);
        ([old, new], lock)
    });
    packages
}

/// Makes the package `new` of the same files, with version 0.2.1.
#[track_caller]
fn repack(old: &Path, new: &Path) {
    const REPACK: &str = r#"dpkg-deb -R "$0" "$2" && sed -i 's/^Version: .*/Version: 0.2.1/' "$2/DEBIAN/control" &&
        dpkg-deb -Zgzip -z1 -b "$2" "$1""#;
    let scratch = Scratch::new();
    let mut shell = Command::new("sh");
    shell.args(["-c", REPACK]).args([old, new]);
    let output = shell.arg(scratch.path("parts")).output().unwrap();
    assert!(output.status.success(), "{output:?}");
}

/// Runs `script` in a fresh Debian, with the packages in /given.
#[track_caller]
fn in_fresh_debian(script: &str) -> String {
    let folder = packages()[0].parent().unwrap();
    let cache = Path::new(ROOT).join("target/fresh-debian");
    let output = Command::new(Path::new(ROOT).join("tests/support/fresh_debian.sh"))
        .args([&*cache, folder])
        .args(["sh", "-euxc", script])
        .stdin(Stdio::null())
        .output()
        .unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(
        output.status.success(),
        "{errors} (needs root and debootstrap, see tests/install_tools.sh)"
    );
    String::from_utf8(output.stdout).unwrap()
}

fn name(package: &Path) -> &str {
    package.file_name().unwrap().to_str().unwrap()
}

#[test]
fn the_package_can_be_installed_upgraded_removed_and_purged_without_a_trace() {
    let [old, new] = packages();
    let said = in_fresh_debian(&format!(
        r#"
        list() {{ find / -xdev -path /given -prune -o -path /proc -prune -o -path /var/lib/dpkg -prune \
            -o -path /var/log -prune -o -path /var/cache -prune -o -print | sort; }}
        touch /tmp/before /tmp/after
        list >/tmp/before
        dpkg -i /given/{old} >/dev/null
        rosrescue --version
        dpkg -s rosrescue | grep ^Version
        zcat /usr/share/man/man1/rosrescue-core.1.gz | grep -c ROSRESCUE_CHECKPOINT
        bash -nc ". /usr/share/bash-completion/completions/rosrescue"
        grep -c install /usr/share/zsh/vendor-completions/_rosrescue \
            /usr/share/fish/vendor_completions.d/rosrescue.fish /usr/share/bash-completion/completions/rosrescue
        ls /usr/lib/systemd/system/rosrescue.* /usr/share/doc/rosrescue/copyright
        dpkg --verify rosrescue
        echo ROS_IP=10.0.0.7 >>/etc/default/rosrescue
        dpkg -i /given/{new} >/dev/null
        dpkg -s rosrescue | grep ^Version
        tail -n 1 /etc/default/rosrescue
        dpkg -r rosrescue >/dev/null
        test ! -e /usr/bin/rosrescue
        ls /etc/default/rosrescue
        dpkg -P rosrescue >/dev/null
        list >/tmp/after
        diff /tmp/before /tmp/after || true
        "#,
        old = name(old),
        new = name(new)
    ));
    let lines: Vec<_> = said.lines().collect();
    assert!(lines[0].starts_with("rosrescue 0.2.0"), "{said}");
    assert_eq!(lines[1], "Version: 0.2.0", "{said}");
    assert_eq!(lines[2], "1", "{said}");
    for line in &lines[3..6] {
        assert!(!line.ends_with(":0"), "{said}");
    }
    // The last line is that of /etc/default. The purge leaves nothing behind.
    let last = [
        "/usr/lib/systemd/system/rosrescue.service",
        "/usr/lib/systemd/system/rosrescue.socket",
        "/usr/share/doc/rosrescue/copyright",
        "Version: 0.2.1",
        "ROS_IP=10.0.0.7",
        "/etc/default/rosrescue",
    ];
    assert_eq!(lines[6..], last, "{said}");
}

#[test]
fn the_package_has_the_documents_and_examples_and_no_link_leads_nowhere() {
    let scratch = Scratch::new();
    let folder = scratch.path("package");
    let mut unpack = Command::new("dpkg-deb");
    assert!(
        unpack
            .arg("-x")
            .args([&packages()[0], &folder])
            .status()
            .unwrap()
            .success()
    );
    let documents = folder.join("usr/share/doc/rosrescue");
    for file in [
        "CHANGELOG.md",
        "changelog.Debian.gz",
        "docs/packaging.md",
        "examples/systemd/rosmaster.service",
        "examples/systemd/rosout.service",
        "examples/grafana/rosrescue.json",
        "examples/prometheus/alerts.yaml",
        "examples/keepalived/keepalived.conf",
    ] {
        assert!(documents.join(file).exists(), "{file}");
    }
    let mut follow = Command::new(Path::new(ROOT).join("tests/support/follow_links.py"));
    let output = follow.arg(documents).output().unwrap();
    assert!(
        output.status.success() && output.stdout.is_empty(),
        "{output:?}"
    );
}

#[test]
fn an_upgrade_does_not_disturb_a_running_robot_and_removal_ends_its_service() {
    let [old, new] = packages();
    let robot = Booted::new();
    // Otherwise each dpkg indexes the manual pages of all packages, for seconds.
    robot.run("rm -f /var/lib/man-db/auto-update");
    let install = |package: &Path| robot.run(&format!("dpkg -i {}", robot.give(package)));
    let said = install(old);
    assert!(said.contains("sudo rosrescue install"), "{said}");
    assert!(
        robot
            .try_run("systemctl is-active rosrescue.socket")
            .is_err()
    );

    // First, the unit in the package is used.
    robot.run("systemctl enable --now rosrescue.socket rosrescue.service");
    robot.wait_protected();
    robot.run("pgrep -x rosmaster; test -s /var/lib/rosrescue/log/latest-chkpt.yaml");
    robot.set_kept();
    let (worker, master) = (robot.property("MainPID"), robot.run("pgrep -x rosmaster"));
    let said = install(new);
    assert!(
        said.contains("systemctl kill --signal=KILL --kill-who=main"),
        "{said}"
    );
    assert_eq!(robot.property("MainPID"), worker);
    robot.run("systemctl kill --signal=KILL --kill-who=main rosrescue.service");
    robot.wait_another_worker(&worker);
    robot.assert_kept("with another worker");
    assert_eq!(robot.run("pgrep -x rosmaster"), master);
    robot.run("systemctl disable --now rosrescue.socket rosrescue.service");

    // A unit of `rosrescue install` takes precedence, and is removed with the package.
    robot.run("SUDO_USER=robot rosrescue install --yes");
    robot.wait_protected();
    robot.run("pgrep -x -u robot rosmaster");
    robot.run("dpkg -P rosrescue");
    assert!(
        robot
            .try_run("pgrep -x rosmaster || pgrep -x rosrescue")
            .is_err()
    );
    let left = robot.run("find /etc /usr /var/lib /run/systemd -xdev -name '*rosrescue*' -not -path '/var/lib/dpkg/*'");
    assert_eq!(left, "");
}
