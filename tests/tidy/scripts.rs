//! Checks code that several scripts share.

use std::fs::{self, Permissions};
use std::os::unix::fs::PermissionsExt;
use std::process::Command;

/// An apt-get that finds a lock taken at its first call.
const APT_GET: &str = r#"#!/bin/sh
if [ ! -e "$0.called" ]; then
    : >"$0.called"
    echo "E: Could not get lock /var/lib/dpkg/lock-frontend. It is held by process 1 (apt-get)" >&2
    exit 100
fi
echo "done: $*"
"#;

#[test]
fn an_installation_waits_for_another_program_that_uses_the_package_manager() {
    let folder = tempfile::tempdir().unwrap();
    for (name, script) in [
        ("apt-get", APT_GET),
        ("sudo", "#!/bin/sh\nexec \"$@\"\n"),
        // The test does not wait.
        ("sleep", "#!/bin/sh\n"),
    ] {
        let path = folder.path().join(name);
        fs::write(&path, script).unwrap();
        fs::set_permissions(&path, Permissions::from_mode(0o755)).unwrap();
    }
    let run = |patience: u32| {
        let script = format!(". tests/apt_get.sh; apt_patience={patience}; apt_get install x");
        let path = std::env::var("PATH").unwrap();
        let path = format!("{}:{path}", folder.path().display());
        let mut command = Command::new("sh");
        command.args(["-c", &script]).env("PATH", path);
        command.current_dir(env!("CARGO_MANIFEST_DIR"));
        command.output().unwrap()
    };
    let waits = run(10);
    assert_eq!(waits.stdout, b"done: install x\n", "{waits:?}");
    let said = String::from_utf8_lossy(&waits.stderr);
    assert!(
        said.starts_with("waiting up to 10 s for another program"),
        "{said}"
    );
    assert!(waits.status.success(), "{waits:?}");

    fs::remove_file(folder.path().join("apt-get.called")).unwrap();
    let gives_up = run(0);
    let said = String::from_utf8_lossy(&gives_up.stderr);
    assert!(
        said.contains("another program has been using the package manager for 0 s"),
        "{said}"
    );
    assert_eq!(gives_up.status.code(), Some(100), "{gives_up:?}");
}
