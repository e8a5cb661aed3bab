//! A folder, a token and ports for one test.

use std::cell::RefCell;
use std::ffi::OsString;
use std::fs;
use std::io::ErrorKind;
use std::net::{Ipv4Addr, Ipv6Addr, TcpListener};
use std::ops::Range;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use rustix::process::Signal;
use tempfile::TempDir;
use tokio::net::TcpSocket;

use super::namespace::{is_isolated, isolate};
use super::process::signal;

/// The environment variable that marks every process of a test.
const TOKEN: &str = "ROSRESCUE_SCRATCH_TOKEN";

/// The environment variable with the folder of the test.
pub(super) const HOME: &str = "ROS_HOME";

/// If this variable is set, all rosmasters and rospy nodes speak HTTP/1.0, as on a kernel before 4.16.
const HTTP_1_0: &str = "ROSRESCUE_HTTP_1_0";
/// A folder with a `sitecustomize.py` that makes Python see an old kernel.
const OLD_KERNEL: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/nodes/old_kernel");

/// A folder for one test. On drop every process that was started in it is killed. The folder is removed
/// unless the test failed.
#[derive(Debug)]
pub(crate) struct Scratch {
    folder: TempDir,
    token: String,
}

impl Scratch {
    pub(crate) fn new() -> Self {
        isolate();
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let token = format!(
            "{}-{}",
            std::process::id(),
            COUNT.fetch_add(1, Ordering::Relaxed)
        );
        let folder = tempfile::Builder::new()
            .prefix(&format!("scratch-{token}-"))
            .tempdir_in(env!("CARGO_TARGET_TMPDIR"))
            .expect("cannot create a scratch folder");
        fs::create_dir_all(folder.path().join("log")).unwrap();
        Self { folder, token }
    }

    pub(crate) fn path(&self, name: impl AsRef<Path>) -> PathBuf {
        self.folder.path().join(name)
    }

    /// The `ROS_LOG_DIR` of all processes in this test.
    pub(crate) fn log_dir(&self) -> PathBuf {
        self.path("log")
    }

    /// Prepares `command`: ROS writes all files to this folder, the token is set, and no name server is needed for the
    /// node's address. Of the caller's ROS environment only the place of installation is kept, and no HTTP proxy.
    pub(crate) fn prepare(&self, command: &mut Command) {
        for (key, _) in std::env::vars_os() {
            let name = key.to_string_lossy();
            // A proxy for HTTP does not know the addresses of this test.
            let is_proxy = name.to_ascii_lowercase().ends_with("_proxy");
            let is_ros = name.starts_with("ROS_") && !is_install(&name);
            if is_proxy || is_ros || name.starts_with("ROSRESCUE_") {
                command.env_remove(&key);
            }
        }
        command
            .env(TOKEN, &self.token)
            .env(HOME, self.folder.path())
            .env("ROS_LOG_DIR", self.log_dir())
            .env("ROS_IP", "127.0.0.1")
            .env("PYTHONUNBUFFERED", "1")
            .env("PYTHONDONTWRITEBYTECODE", "1");
        if std::env::var_os(HTTP_1_0).is_some() {
            command.env("PYTHONPATH", OLD_KERNEL);
        }
    }

    /// Processes that this test has started, directly or not, and that still run: id and command.
    pub(crate) fn survivors(&self) -> Vec<(u32, String)> {
        let is_ours = |folder: &Path| has_token(folder, |token| token == self.token);
        let mut found = Vec::new();
        for entry in fs::read_dir("/proc").unwrap().flatten() {
            let Some(pid) = entry
                .file_name()
                .to_str()
                .and_then(|name| name.parse().ok())
            else {
                continue;
            };
            if is_ours(&entry.path()) {
                let command = fs::read(entry.path().join("cmdline")).unwrap_or_default();
                found.push((pid, String::from_utf8_lossy(&command).replace('\0', " ")));
            }
        }
        found
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let start = Instant::now();
        // Repeated, because a supervisor may have started another child in the meantime.
        while start.elapsed() < Duration::from_secs(10) {
            let survivors = self.survivors();
            if survivors.is_empty() {
                break;
            }
            for (pid, _) in survivors {
                signal(pid, Signal::KILL);
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        if std::thread::panicking() {
            eprintln!(
                "the scratch folder is kept: {}",
                self.folder.path().display()
            );
            self.folder.disable_cleanup(true);
        }
    }
}

/// Whether the process with this folder in `/proc` was started by a test, directly or not, whose token `is_wanted`.
fn has_token(folder: &Path, is_wanted: impl Fn(&str) -> bool) -> bool {
    let environment = fs::read(folder.join("environ")).unwrap_or_default();
    environment.split(|&byte| byte == 0).any(|pair| {
        let pair = std::str::from_utf8(pair).unwrap_or_default();
        pair.strip_prefix(TOKEN)
            .and_then(|rest| rest.strip_prefix('='))
            .is_some_and(&is_wanted)
    })
}

/// Whether a test of this program started the process with this folder in `/proc`.
pub(super) fn is_of_this_program(folder: &Path) -> bool {
    let start = format!("{}-", std::process::id());
    has_token(folder, |token| token.starts_with(&start))
}

fn is_install(variable: &str) -> bool {
    [
        "ROS_ROOT",
        "ROS_ETC_DIR",
        "ROS_DISTRO",
        "ROS_VERSION",
        "ROS_PYTHON_VERSION",
        "ROS_PACKAGE_PATH",
    ]
    .contains(&variable)
}

/// A port at which no process listens, on IPv4 or IPv6. It is below the ports that the kernel gives to
/// outgoing connections, so nothing takes it by chance before the test binds it. Where tests share a network, other
/// test programs do not get it either as long as this one runs.
pub(crate) fn free_port() -> u16 {
    isolate();
    loop {
        let port = next_port();
        let v4 = TcpListener::bind((Ipv4Addr::UNSPECIFIED, port));
        let v6 = TcpListener::bind((Ipv6Addr::LOCALHOST, port));
        // Some computers have no IPv6.
        if v4.is_ok() && !v6.is_err_and(|error| error.kind() == ErrorKind::AddrInUse) {
            return port;
        }
    }
}

/// The ports that tests choose: those below the ones that the kernel gives to outgoing connections.
const FIRST: u16 = 12_000;
const BLOCKS: u16 = 200;
const BLOCK: u16 = 100;

/// A port that no other test of this program gets for a while.
fn next_port() -> u16 {
    /// The unused ports that we may take, and the sockets that reserve them.
    static OURS: Mutex<(Range<u16>, Vec<UnixListener>)> = Mutex::new((0..0, Vec::new()));
    let mut ours = OURS.lock().unwrap_or_else(PoisonError::into_inner);
    loop {
        if let Some(port) = ours.0.next() {
            return port;
        }
        ours.0 = if is_isolated() {
            FIRST..FIRST + BLOCKS * BLOCK
        } else {
            let (block, socket) = reserve();
            ours.1.push(socket);
            block
        };
    }
}

/// Reserves a block of ports that no other test program gets as long as the socket is open.
fn reserve() -> (Range<u16>, UnixListener) {
    let start = u16::try_from(std::process::id() % u32::from(BLOCKS)).unwrap();
    let mut blocks = (0..BLOCKS).map(|step| (start + step) % BLOCKS);
    let reserved = blocks.find_map(|block| {
        let name = format!("rosrescue-tests-ports-{block}");
        let name = SocketAddr::from_abstract_name(name).unwrap();
        let first = FIRST + block * BLOCK;
        Some((first..first + BLOCK, UnixListener::bind_addr(&name).ok()?))
    });
    reserved.expect("a block of ports that no other test program has reserved")
}

/// The first of the ports that the kernel chooses by itself.
pub(crate) const FIRST_OF_KERNEL: u16 = 32_768;

/// Makes `port` refuse connections until the end of this test, so that no other process gets it by chance.
pub(crate) fn hold_port(port: u16) {
    thread_local!(static HELD: RefCell<Vec<TcpSocket>> = const { RefCell::new(Vec::new()) });
    let Ok(socket) = TcpSocket::new_v4() else {
        return;
    };
    // Closed connections of the dead process must not prevent the bind.
    let address = (Ipv4Addr::UNSPECIFIED, port).into();
    if socket.set_reuseaddr(true).is_ok() && socket.bind(address).is_ok() {
        HELD.with_borrow_mut(|held| held.push(socket));
    }
}

/// The text of an environment variable, for a message.
pub(crate) fn shown(text: &OsString) -> String {
    text.to_string_lossy().into_owned()
}
