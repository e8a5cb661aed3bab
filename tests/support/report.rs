//! What a person needs to know about a failed test besides its panic: who listens, the status of rosrescue, and how to
//! repeat the test.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::panic;
use std::path::Path;
use std::process::Command;
use std::sync::Once;
use std::thread;

use super::namespace;
use super::scratch;

/// Prints a report after the message of each panic from now on. The processes of the test still run at that time.
pub(super) fn install() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let show = panic::take_hook();
        panic::set_hook(Box::new(move |info| {
            show(info);
            eprint!("{}", report().unwrap_or_default());
        }));
    });
}

/// The report about the test that runs in this thread. `None` in other threads: their panics reach the test.
pub(crate) fn report() -> Option<String> {
    let test = thread::current().name()?.to_owned();
    let mut report = format!(
        "\nTo repeat it: cargo test --locked --test {} {test} -- --exact --nocapture\n",
        env!("CARGO_CRATE_NAME")
    );
    let listeners = listeners();
    for (address, pid, command) in &listeners {
        let _ = writeln!(report, "listening at {address}: process {pid}, {command}");
    }
    let mut rescues: Vec<_> = listeners
        .iter()
        .filter(|(_, pid, _)| is_rescue(*pid))
        .map(|(address, ..)| address.port())
        .collect();
    rescues.dedup();
    for port in rescues {
        let status = Command::new(env!("CARGO_BIN_EXE_rosrescue"))
            .args(["status", "--uri", &format!("http://127.0.0.1:{port}")])
            .output();
        let _ = match status {
            Ok(output) => writeln!(
                report,
                "status at port {port}:\n{}{}",
                String::from_utf8_lossy(&output.stdout),
                String::from_utf8_lossy(&output.stderr)
            ),
            Err(error) => writeln!(report, "status at port {port}: {error}"),
        };
    }
    Some(report)
}

fn is_rescue(pid: u32) -> bool {
    fs::read_link(format!("/proc/{pid}/exe")).is_ok_and(|program| {
        let name = program.file_name().unwrap_or_default();
        name.to_string_lossy().starts_with("rosrescue")
    })
}

/// Address, process id and command of each TCP socket at which this program or a process of its tests listens, in this
/// thread's namespace. Sorted by port.
fn listeners() -> Vec<(SocketAddr, u32, String)> {
    let tables = ["tcp", "tcp6"].map(|name| format!("/proc/thread-self/net/{name}"));
    let tables = tables.map(|table| fs::read_to_string(table).unwrap_or_default());
    let sockets: BTreeMap<String, SocketAddr> = tables
        .iter()
        .flat_map(|table| table.lines().skip(1).filter_map(listener))
        .collect();
    let own = namespace::of(Path::new("/proc/thread-self"));
    let mut found = Vec::new();
    for process in fs::read_dir("/proc").into_iter().flatten().flatten() {
        let name = process.file_name();
        let Some(pid) = name.to_str().and_then(|name| name.parse().ok()) else {
            continue;
        };
        let folder = process.path();
        let is_ours = pid == std::process::id()
            || scratch::is_of_this_program(&folder)
            || (namespace::is_isolated() && namespace::of(&folder) == own);
        if !is_ours {
            continue;
        }
        let files = fs::read_dir(folder.join("fd"));
        for file in files.into_iter().flatten().flatten() {
            let link = fs::read_link(file.path()).unwrap_or_default();
            if let Some(address) = link.to_str().and_then(|link| sockets.get(link)) {
                let command = fs::read(folder.join("cmdline")).unwrap_or_default();
                let command = String::from_utf8_lossy(&command).replace('\0', " ");
                found.push((*address, pid, command));
            }
        }
    }
    found.sort_by_key(|(address, pid, _)| (address.port(), *pid));
    found.dedup();
    found
}

/// The link to a listening socket in `/proc/PID/fd`, and its address, from a line of `/proc/net/tcp` or `tcp6`.
fn listener(line: &str) -> Option<(String, SocketAddr)> {
    const LISTEN: &str = "0A";
    let columns: Vec<_> = line.split_whitespace().collect();
    let [_, local, _, LISTEN, .., inode] = columns.get(..10)? else {
        return None;
    };
    let (address, port) = local.split_once(':')?;
    // Each word of four bytes has the order of the processor.
    let bytes: Vec<u8> = (0..address.len() / 8)
        .filter_map(|word| u32::from_str_radix(address.get(word * 8..word * 8 + 8)?, 16).ok())
        .flat_map(u32::to_ne_bytes)
        .collect();
    let ip = match *bytes.as_slice() {
        [a, b, c, d] => IpAddr::V4(Ipv4Addr::new(a, b, c, d)),
        _ => IpAddr::V6(Ipv6Addr::from(<[u8; 16]>::try_from(bytes).ok()?)),
    };
    let port = u16::from_str_radix(port, 16).ok()?;
    Some((format!("socket:[{inode}]"), SocketAddr::new(ip, port)))
}
