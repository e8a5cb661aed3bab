//! Orphans: rosmasters and rosouts that a killed rosrescue left running.
//!
//! They are identified by their process, not by their port: another program may have taken the port since,
//! even another rosmaster. Each started process has the checkpoint's path in its environment. No other
//! program sets that variable, and the kernel shows it as long as the process lives.

use std::{
    ffi::{OsStr, OsString},
    fs, io,
    os::unix::{ffi::OsStrExt, process::parent_id},
    path::{Path, PathBuf},
};

use rustix::process::PidfdFlags;

use super::pidfd;

/// The environment variable that identifies a process's owner.
pub(super) const OWNER: &str = "ROSRESCUE_OWNER";

/// The value of [`OWNER`] for processes of `checkpoint`.
pub(super) fn owner(checkpoint: &Path) -> OsString {
    let absolute = std::path::absolute(checkpoint).unwrap_or_else(|_| checkpoint.to_owned());
    // The file may not exist yet.
    let folder = absolute.parent().and_then(|path| path.canonicalize().ok());
    match (folder, absolute.file_name()) {
        (Some(folder), Some(name)) => folder.join(name).into(),
        _ => absolute.into(),
    }
}

/// Living processes with this `owner` whose rosrescue is gone, in our network namespace. Processes of other
/// containers may be visible, and their checkpoint may have the same path.
pub(super) fn find(owner: &OsStr) -> Vec<u32> {
    super::all()
        .filter(|pid| bears(*pid, owner) && is_in_our_network(*pid) && !has_rosrescue(*pid))
        .collect()
}

/// Whether the process `pid` was started with this `owner`.
pub(super) fn bears(pid: u32, owner: &OsStr) -> bool {
    owner_of(pid).is_some_and(|of| of == owner.as_bytes())
}

/// Whether a rosrescue started the process `pid`.
pub(super) fn has_owner(pid: u32) -> bool {
    owner_of(pid).is_some()
}

fn owner_of(pid: u32) -> Option<Vec<u8>> {
    let environment = fs::read(format!("/proc/{pid}/environ")).ok()?;
    let start = format!("{OWNER}=").into_bytes();
    let mut pairs = environment.split(|byte| *byte == 0);
    pairs.find_map(|pair| pair.strip_prefix(&*start).map(<[u8]>::to_vec))
}

/// Whether the process `pid` is in our network namespace.
pub(crate) fn is_in_our_network(pid: u32) -> bool {
    network(&pid) == network(&"self")
}

/// The network namespace of a process.
fn network(process: &dyn std::fmt::Display) -> Option<PathBuf> {
    fs::read_link(format!("/proc/{process}/ns/net")).ok()
}

/// Whether the parent of `pid` is a rosrescue, so that it is no orphan. Our own parent does not count: a
/// guardian starts no masters, but as the first process of a container it inherits those of dead workers.
fn has_rosrescue(pid: u32) -> bool {
    let parent = super::parent_of(pid);
    parent.is_some_and(|parent| parent != parent_id() && super::is_rosrescue(parent))
}

/// Returns when the process `pid`, which is not our child, has ended.
///
/// # Errors
///
/// The system's error: the process is gone, or the kernel is older than 5.3 and cannot watch it.
pub(super) async fn ended(pid: u32) -> io::Result<()> {
    let pid = i32::try_from(pid).map_err(io::Error::other)?;
    let process = pidfd::open(pid, PidfdFlags::empty())?;
    process.readable().await
}

#[cfg(test)]
mod tests {
    use std::{
        process::{Command, Stdio},
        time::Duration,
    };

    use super::*;

    /// Runs `program` and gives the id of the process that it prints.
    fn pid_of(program: &str, owner: &OsStr) -> u32 {
        let output = Command::new("sh")
            .args(["-c", program])
            .env(OWNER, owner)
            .stderr(Stdio::null())
            .output()
            .unwrap();
        String::from_utf8(output.stdout)
            .unwrap()
            .trim()
            .parse()
            .unwrap()
    }

    #[tokio::test]
    async fn only_an_orphan_that_bears_the_name_was_left_behind() {
        let folder = tempfile::tempdir().unwrap();
        let owner = owner(&folder.path().join("checkpoint"));
        let mut kept = Command::new("sleep")
            .arg("60")
            .env(OWNER, &owner)
            .spawn()
            .unwrap();
        // This test's program is called after rosrescue, too.
        assert_eq!(find(&owner), Vec::<u32>::new(), "its rosrescue lives");
        let orphan = pid_of("sleep 60 >/dev/null & echo $!", &owner);
        assert_eq!(find(&owner), [orphan]);
        assert_eq!(find(OsStr::new("another")), Vec::<u32>::new());
        let end = tokio::spawn(ended(orphan));
        crate::process::signal_process(orphan, rustix::process::Signal::KILL);
        let end = tokio::time::timeout(Duration::from_secs(60), end).await;
        end.expect("the end is told").unwrap().unwrap();
        assert_eq!(find(&owner), Vec::<u32>::new());
        kept.kill().unwrap();
        kept.wait().unwrap();
    }

    #[test]
    fn a_checkpoint_has_one_name() {
        let folder = tempfile::tempdir().unwrap();
        let (real, link) = (folder.path().join("real"), folder.path().join("link"));
        fs::create_dir(&real).unwrap();
        std::os::unix::fs::symlink(&real, &link).unwrap();
        assert_eq!(owner(&real.join("c")), owner(&link.join("c")));
        assert_ne!(owner(&real.join("c")), owner(&real.join("d")));
    }
}
