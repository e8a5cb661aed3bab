//! Finds the processes that listen at a port, as far as the system shows them.

use std::{
    collections::{BTreeMap, BTreeSet, HashSet},
    fs,
};

use rescue_core::health::{Owner, Process};

use super::Stat;
use crate::upstream::sockets;

/// The program that listens at the port of a master that rosrescue started.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum PortHolder {
    /// The master, or a process that it has started.
    Master,
    /// Another program, with its process id if it can be seen. The master can never listen there.
    Stranger(Option<u32>),
    /// No program, or none that this process can see.
    Unknown,
}

impl PortHolder {
    /// Finds the program that listens at `port`, which the master `child` was given. `own` means that the master is
    /// ROS's own rosmaster, which never starts another one.
    pub(crate) fn find(child: u32, port: u16, own: bool) -> Self {
        let sockets = sockets(port);
        if holds_one(child, &sockets) {
            return Self::Master;
        }
        choose_holder(!sockets.is_empty(), &listeners_at(port), own, |pid| {
            descends(pid, child)
        })
    }
}

/// Chooses the program that has the port from the listeners that were `seen`. `taken` says that a process other than
/// the child listens.
fn choose_holder(
    taken: bool,
    seen: &[u32],
    own: bool,
    descends: impl Fn(u32) -> bool,
) -> PortHolder {
    match seen.first() {
        _ if !taken => PortHolder::Unknown,
        _ if seen.iter().any(|pid| descends(*pid)) => PortHolder::Master,
        // The listeners belong to another user, so they are invisible to this process.
        None if !own => PortHolder::Unknown,
        first => PortHolder::Stranger(first.copied()),
    }
}

/// Whether `ancestor` has started the process `pid`, directly or through other processes.
fn descends(pid: u32, ancestor: u32) -> bool {
    let parent = |pid: &u32| super::parent_of(*pid).filter(|parent| *parent > 1);
    std::iter::successors(Some(pid), parent).any(|pid| pid == ancestor)
}

/// The processes that listen at `port`, for people.
pub(crate) fn named(port: u16) -> String {
    let processes = listeners_at(port);
    let named = processes
        .iter()
        .map(|pid| format!("{} (process {pid})", super::name_of(*pid)));
    match processes.is_empty() {
        true => "a process that only root can see".to_owned(),
        false => named.collect::<Vec<_>>().join(", "),
    }
}

/// The processes in this network namespace that listen at `port`. Only root sees those of other users.
pub(crate) fn listeners_at(port: u16) -> Vec<u32> {
    let sockets = sockets(port);
    if sockets.is_empty() {
        return Vec::new();
    }
    super::all_pids()
        .filter(|pid| holds_one(*pid, &sockets))
        .collect()
}

/// Whether the process `pid` listens at `port`.
pub(crate) fn listens(pid: u32, port: u16) -> bool {
    holds_one(pid, &sockets(port))
}

/// The ports at which the process `pid` listens.
pub(crate) fn ports(pid: u32) -> Vec<u16> {
    let open = open_sockets(pid);
    let mut ports: Vec<_> = sockets::listening()
        .into_iter()
        .filter(|(_, sockets)| sockets.iter().any(|socket| open.contains(socket)))
        .map(|(address, _)| address.port())
        .collect();
    ports.sort_unstable();
    ports.dedup();
    ports
}

/// The inodes of the listening sockets at `port`.
pub(super) fn sockets(port: u16) -> HashSet<u64> {
    let listening = sockets::listening().into_iter();
    listening
        .filter(|(address, _)| address.port() == port)
        .flat_map(|(_, sockets)| sockets)
        .collect()
}

/// The inodes of the process's open sockets. Empty for another user's process, unless this process runs as root.
pub(crate) fn open_sockets(pid: u32) -> HashSet<u64> {
    let open = fs::read_dir(format!("/proc/{pid}/fd"));
    let open = open.into_iter().flatten().flatten();
    let sockets = open.filter_map(|entry| {
        let file = fs::read_link(entry.path()).ok()?;
        let inode = file.to_str()?.strip_prefix("socket:[")?.strip_suffix(']')?;
        inode.parse().ok()
    });
    sockets.collect()
}

/// The owner of each socket with one of these inodes; `None` if the kernel hides it. Of several processes that hold a
/// socket, the owner is the one that was started first: the others have inherited it. Reads the open files of all
/// processes, which takes some milliseconds.
pub(crate) fn owners(sockets: &BTreeSet<u64>) -> BTreeMap<u64, Option<Owner>> {
    let mut owners: BTreeMap<_, Option<Owner>> = sockets.iter().map(|it| (*it, None)).collect();
    for pid in super::all_pids() {
        let open = open_sockets(pid);
        for socket in sockets.iter().filter(|socket| open.contains(socket)) {
            let Some(owner) = owner(pid) else { continue };
            let known = owners.entry(*socket).or_default();
            if known.is_none_or(|known| owner.process.started < known.process.started) {
                *known = Some(owner);
            }
        }
    }
    owners
}

fn owner(pid: u32) -> Option<Owner> {
    let started = Stat::read(pid)?.started;
    let status = fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    // The last id is the one in the process's own namespace.
    let ids = status.lines().find_map(|line| line.strip_prefix("NSpid:"));
    let own_pid = ids.and_then(|ids| ids.split_whitespace().last()?.parse().ok());
    Some(Owner {
        process: Process { pid, started },
        own_pid: own_pid.or_else(|| pid.try_into().ok())?,
    })
}

/// Whether `process` has ended. False if the kernel does not tell.
pub(crate) fn has_ended(process: Process) -> bool {
    /// The kernel's error for a process that ends while its state is read.
    const NO_SUCH_PROCESS: i32 = 3;
    match fs::read_to_string(format!("/proc/{}/stat", process.pid)) {
        Ok(line) => Stat::parse(&line)
            .is_some_and(|stat| stat.started != process.started || stat.has_ended()),
        Err(error) => {
            let is_gone = error.raw_os_error() == Some(NO_SUCH_PROCESS);
            error.kind() == std::io::ErrorKind::NotFound || is_gone
        }
    }
}

/// Whether the process `pid` has one of `sockets` open.
pub(super) fn holds_one(pid: u32, sockets: &HashSet<u64>) -> bool {
    !open_sockets(pid).is_disjoint(sockets)
}

/// Waits until no process listens at `port`. A process that another test is starting holds a closed socket until it
/// runs its program.
#[cfg(test)]
pub(crate) fn wait_closed(port: u16) {
    while !sockets(port).is_empty() {
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;

    use super::*;

    #[test]
    fn a_stranger_at_the_masters_port_is_distinguished_from_its_processes() {
        let child = |pid| pid == 7;
        assert_eq!(choose_holder(false, &[], true, child), PortHolder::Unknown);
        assert_eq!(choose_holder(true, &[7], false, child), PortHolder::Master);
        assert_eq!(
            choose_holder(true, &[8, 7], false, child),
            PortHolder::Master
        );
        assert_eq!(
            choose_holder(true, &[8], false, child),
            PortHolder::Stranger(Some(8))
        );
        assert_eq!(
            choose_holder(true, &[], true, child),
            PortHolder::Stranger(None)
        );
        assert_eq!(choose_holder(true, &[], false, child), PortHolder::Unknown);
    }

    #[test]
    fn whose_port_it_is_is_known() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let own = std::process::id();
        let mut child = std::process::Command::new("sleep")
            .arg("60")
            .spawn()
            .unwrap();
        assert_eq!(PortHolder::find(own, port, true), PortHolder::Master);
        let parent = std::os::unix::process::parent_id();
        assert_eq!(PortHolder::find(parent, port, true), PortHolder::Master);
        let stranger = PortHolder::Stranger(Some(own));
        assert_eq!(PortHolder::find(child.id(), port, true), stranger);
        drop(listener);
        wait_closed(port);
        assert_eq!(
            PortHolder::find(child.id(), port, true),
            PortHolder::Unknown
        );
        child.kill().unwrap();
        child.wait().unwrap();
    }

    #[test]
    fn who_listens_is_known() {
        for address in ["127.0.0.1:0", "[::1]:0"] {
            let listener = TcpListener::bind(address).unwrap();
            let port = listener.local_addr().unwrap().port();
            let own = std::process::id();
            assert!(listens(own, port));
            assert!(listeners_at(port).contains(&own));
            assert!(ports(own).contains(&port));
            assert!(!listens(1, port) || own == 1);
            drop(listener);
            assert!(!listens(own, port));
        }
    }
}
