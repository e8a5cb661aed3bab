//! Gathers facts about this computer.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs, io,
    net::IpAddr,
    path::{Path, PathBuf},
    sync::Arc,
    time::{Duration, Instant},
};

use checkpoint_store::LockHolder;
use rustix::{
    fs::{Access, StatVfsMountFlags},
    process::{Resource, getrlimit},
};
use tokio::{task::JoinSet, time::timeout};

use super::{
    computers::{Cluster, Unusable},
    launch::{self, Launches},
    reach::{self, Reached},
    ros::{self, Program},
    shell::{self, ShellSetting},
    units::{self, Unit},
};
use crate::{
    cli::CheckArgs,
    clock, config,
    process::{
        self, Rosout,
        bypass::{Bypass, MasterAddresses},
        listeners,
    },
    resolver,
    ros_env::{self, MasterUri, UriError},
    server::listener::{self, ListenError},
};

/// Longest time for one name lookup. A dead name server takes longer.
const LOOKUP_LIMIT: Duration = Duration::from_secs(6);
/// Maximum number of nodes that are named for each host.
const NAMED: usize = 3;
/// Maximum number of addresses in launch files that are looked up.
const LOOKUPS_MOST: usize = 4;
/// Names of services that set the clock.
const CLOCKS: [&str; 6] = [
    "systemd-timesyn",
    "chronyd",
    "ntpd",
    "openntpd",
    "ptp4l",
    "phc2sys",
];

/// All facts that `rosrescue check` judges.
#[derive(Clone, Debug)]
pub(super) struct SetupFacts {
    pub(super) version: &'static str,
    /// The master of `proxy` and what answers at its address. `None` for `core`.
    pub(super) proxied: Option<(MasterUri, ros::Responder)>,
    /// HTTP version of the master of `proxy`, if it answers.
    pub(super) proxied_speaks: Option<String>,
    /// The kernel's release.
    pub(super) kernel: String,
    pub(super) env: Environment,
    /// The port that nodes use, or the error in `ROS_MASTER_URI`.
    pub(super) port: Result<Port, UriError>,
    /// The name that nodes on this computer register.
    pub(super) own: Host,
    /// The host of `ROS_MASTER_URI`.
    pub(super) master_host: Option<Host>,
    /// What answers at `ROS_MASTER_URI`, if that is another computer.
    pub(super) elsewhere: Option<ros::Responder>,
    /// The host name that a rosrescue at `ROS_MASTER_URI` gives as its own.
    pub(super) elsewhere_host: Option<Host>,
    /// Hosts of registered nodes, each with some of its nodes, if rosrescue runs.
    pub(super) node_hosts: Vec<(Host, Vec<String>)>,
    pub(super) disk: CheckpointDisk,
    /// The hard limit of open files: the highest limit that this process may set.
    pub(super) files: u64,
    pub(super) clock: Clock,
    /// How to run rosmaster. `None` for `proxy`.
    pub(super) rosmaster: Option<Result<Program, String>>,
    pub(super) has_rosout: bool,
    /// The first python3 on the PATH, if it cannot import ROS.
    pub(super) strange_python: Option<PathBuf>,
    pub(super) units: Vec<Unit>,
    /// The launch files, with their settings that lead to another master.
    pub(super) launches: Launches,
    /// Free memory, in bytes.
    pub(super) memory: Option<u64>,
    /// Listening processes that were started with another `ROS_MASTER_URI`.
    pub(super) strays: Vec<(Process, String)>,
    /// Why the address that nodes of this computer register may change.
    pub(super) lease: Option<Lease>,
    /// This computer's address, as other computers see it. `None` without a network.
    pub(super) local: Option<IpAddr>,
    /// ROS's variables in the files that every new shell reads.
    pub(super) shell: Vec<ShellSetting>,
    /// Ports of the robot's other computers, each tried once.
    pub(super) reached: Vec<Reached>,
    /// The ports that nodes get from the kernel.
    pub(super) ports_of_nodes: String,
    /// The firewall that runs on this computer.
    pub(super) firewall: Option<&'static str>,
    /// The master behind rosrescue, and the clients that bypass rosrescue.
    pub(super) behind: Option<UpstreamMaster>,
    /// Masters that run beside rosrescue.
    pub(super) masters: Vec<Process>,
    /// What etcd says about `--cluster`. `None` without it.
    pub(super) cluster: Option<Arc<Result<Cluster, Unusable>>>,
}

/// ROS's environment variables.
#[derive(Clone, Debug, Default)]
pub(super) struct Environment {
    pub(super) master_uri: Option<String>,
    pub(super) ip: Option<String>,
    pub(super) hostname: Option<String>,
}

/// A name or an address, with the addresses that it resolves to.
#[derive(Clone, Debug)]
pub(super) struct Host {
    pub(super) name: String,
    pub(super) addresses: Result<Vec<IpAddr>, String>,
    /// Whether one of the addresses belongs to this computer.
    pub(super) is_here: bool,
    pub(super) took: Duration,
}

impl Host {
    async fn find(name: &str) -> Self {
        let start = Instant::now();
        let found = match timeout(LOOKUP_LIMIT, resolver::addresses(name, 0)).await {
            Ok(found) => found.map_err(|error| error.to_string()),
            Err(_) => Err(format!(
                "no name server answered in {} s",
                LOOKUP_LIMIT.as_secs()
            )),
        };
        let addresses = found.map(|found| found.iter().map(|at| at.ip()).collect::<Vec<_>>());
        let mut all = addresses.iter().flatten();
        Self {
            name: name.to_owned(),
            is_here: all.any(|address| resolver::is_own(*address)),
            addresses,
            took: start.elapsed(),
        }
    }

    pub(super) fn is_loopback(&self) -> bool {
        let addresses = self.addresses.as_deref().unwrap_or_default();
        !addresses.is_empty() && addresses.iter().all(IpAddr::is_loopback)
    }
}

#[derive(Clone, Debug)]
pub(super) struct Port {
    pub(super) number: u16,
    /// Why this process cannot listen at the port, if the port is not taken.
    pub(super) error: Option<String>,
    /// What answers at the port, if it is taken.
    pub(super) taken: Option<PortInUse>,
}

#[derive(Clone, Debug)]
pub(super) struct PortInUse {
    pub(super) by: Vec<Process>,
    pub(super) server: ros::Responder,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Process {
    pub(super) pid: u32,
    /// The program's name.
    pub(super) name: String,
    pub(super) ports: Vec<u16>,
}

impl Process {
    fn read(pid: u32) -> Self {
        let name = fs::read_to_string(format!("/proc/{pid}/comm")).unwrap_or_default();
        Self {
            pid,
            name: name.trim_end().to_owned(),
            ports: listeners::ports(pid),
        }
    }
}

/// The file system of the checkpoint.
#[derive(Clone, Debug)]
pub(super) struct CheckpointDisk {
    pub(super) checkpoint: PathBuf,
    /// The checkpoint's folder, or its nearest parent that exists.
    pub(super) folder: PathBuf,
    /// Free bytes, and whether the file system is mounted read-only. An error says why both are unknown.
    pub(super) space: Result<(u64, bool), String>,
    /// How many more files can be created. `None` if the file system has no limit.
    pub(super) inodes: Option<u64>,
    /// Why rosrescue cannot write into the folder. `None` if it can.
    pub(super) refused: Option<String>,
    /// Type and source of the file system, such as `ext4` and `/dev/sda1`.
    pub(super) mount: Option<(String, String)>,
    /// Another rosrescue that uses the checkpoint.
    pub(super) holder: Option<LockHolder>,
    /// Whether the checkpoint's path is a folder.
    pub(super) is_folder: bool,
}

#[derive(Clone, Debug)]
pub(super) struct Clock {
    /// The clock's time, in seconds since 1970.
    pub(super) now: f64,
    /// When the newest known file was changed, in seconds since 1970.
    pub(super) newest: f64,
    /// The service that sets the clock.
    pub(super) service: Option<String>,
}

impl SetupFacts {
    pub(super) async fn gather(args: &CheckArgs, master: Option<MasterUri>) -> Self {
        let env = |name: &str| std::env::var(name).ok();
        let set = |name: &str| env(name).filter(|value| !value.is_empty());
        let environment = Environment {
            master_uri: set("ROS_MASTER_URI"),
            ip: set("ROS_IP"),
            hostname: set("ROS_HOSTNAME"),
        };
        let hostname = rustix::system::uname();
        let hostname = hostname.nodename().to_string_lossy().into_owned();
        let own = ros_env::advertised_host(&env, &hostname, listener::local_address());
        let master_uri = environment.master_uri.as_deref().map(MasterUri::parse);
        let port = match (args.port, &master_uri) {
            (Some(port), _) => Ok(port),
            (None, Some(Ok(uri))) => Ok(uri.port),
            (None, Some(Err(error))) => Err(UriError::clone(error)),
            (None, None) => Ok(ros_env::DEFAULT_MASTER_PORT),
        };
        let served = port
            .as_ref()
            .map_or(ros_env::DEFAULT_MASTER_PORT, |port| *port);
        let usual = MasterUri {
            host: own.clone(),
            port: served,
        };
        let cluster = Cluster::gather(&args.cluster, &usual, &hostname).await;
        let checkpoint = config::checkpoint_path(args.checkpoint.as_deref(), served, &env);
        let port = match port {
            Ok(number) => Ok(Port::inspect(number).await),
            Err(error) => Err(error),
        };
        let (mut proxied, mut proxied_speaks) = (None, None);
        if let Some(uri) = master {
            let server = ros::Responder::identify(&uri).await;
            if matches!(server, ros::Responder::Master(_)) {
                proxied_speaks = ros::speaks(&uri).await;
            }
            proxied = Some((uri, server));
        }
        let running = port.as_ref().ok().and_then(|port| port.taken.as_ref());
        let master_uri = master_uri.and_then(Result::ok);
        let master_host = match &master_uri {
            Some(uri) => Some(Host::find(&uri.host).await),
            None => None,
        };
        let is_far = |host: &Host| host.addresses.is_ok() && !host.is_here;
        let far = master_uri.filter(|_| master_host.as_ref().is_some_and(is_far));
        let elsewhere = match &far {
            Some(uri) if proxied.is_none() => Some(ros::Responder::identify(uri).await),
            _ => None,
        };
        let (mut nodes_of, mut elsewhere_host) = (None, None);
        match (running.map(|taken| &taken.server), &elsewhere, &far) {
            (Some(ros::Responder::Rosrescue { uri, .. }), _, _) => nodes_of = Some(uri.clone()),
            (_, Some(ros::Responder::Rosrescue { uri, .. }), Some(far)) => {
                nodes_of = Some(far.to_string());
                if let Ok(own) = MasterUri::parse(uri) {
                    elsewhere_host = Some(Host::find(&own.host).await);
                }
            }
            (_, Some(ros::Responder::Master(_)), Some(far)) => nodes_of = Some(far.to_string()),
            _ => {}
        }
        let (mut node_hosts, mut ports) = (Vec::new(), Vec::new());
        if let (Some(ros::Responder::Silent), Some(far)) = (&elsewhere, &far) {
            ports.push(("the master".to_owned(), far.clone()));
        }
        if let Some(uri) = nodes_of {
            let nodes = ros::nodes(&uri).await;
            node_hosts = hosts_of(&nodes).await;
            ports.extend(nodes);
        }
        let reached = reach::try_all(ports).await;
        let mut others = Vec::new();
        for (process, uri) in environment
            .master_uri
            .as_deref()
            .map(strays)
            .unwrap_or_default()
        {
            if !leads_to(&uri, far.as_ref(), port.as_ref().ok()).await {
                others.push((process, uri));
            }
        }
        let launches = set("ROS_PACKAGE_PATH").map(|path| launch::find(&path));
        let mut launches = launches.unwrap_or_default();
        let uris = launches.settings.iter().map(|one| one.uri.clone());
        let uris: BTreeSet<_> = uris.collect();
        for uri in uris.iter().take(LOOKUPS_MOST) {
            if leads_to(uri, far.as_ref(), port.as_ref().ok()).await {
                launches.settings.retain(|one| one.uri != *uri);
            }
        }
        let (behind, known) = match running.map(|taken| &taken.server) {
            Some(ros::Responder::Rosrescue {
                proxied, bypassing, ..
            }) => (proxied.clone(), bypassing.clone()),
            _ => (proxied.as_ref().map(|(uri, _)| uri.clone()), Vec::new()),
        };
        let behind = match behind {
            Some(uri) => Some(UpstreamMaster::inspect(uri, known).await),
            None => None,
        };
        let own = Host::find(&own).await;
        let hosts = master_host
            .iter()
            .chain(node_hosts.iter().map(|(host, _)| host));
        let far = hosts.filter(|host| !host.is_here);
        let far = far.flat_map(|host| host.addresses.iter().flatten());
        let local = far.filter_map(|address| reach::source_to(*address)).next();
        let home = env("HOME").unwrap_or_default();
        Self {
            lease: Lease::find_for_host(&own).await,
            local: local.or_else(listener::local_address),
            shell: shell::settings(Path::new(&home), &env("SHELL").unwrap_or_default()),
            reached,
            ports_of_nodes: reach::ports_of_nodes(),
            firewall: reach::firewall(),
            strays: others,
            behind,
            launches,
            version: env!("CARGO_PKG_VERSION"),
            own,
            master_host,
            elsewhere,
            elsewhere_host,
            node_hosts,
            env: environment,
            port,
            rosmaster: match proxied {
                Some(_) => None,
                None => Some(Program::find(args.rosmaster.as_deref()).await),
            },
            proxied_speaks,
            kernel: rustix::system::uname()
                .release()
                .to_string_lossy()
                .into_owned(),
            proxied,
            has_rosout: Rosout::find(&checkpoint).is_some(),
            strange_python: ros::strange_python().await,
            clock: Clock::read(&checkpoint),
            disk: CheckpointDisk::inspect(checkpoint),
            files: getrlimit(Resource::Nofile).maximum.unwrap_or(u64::MAX),
            units: units::find(),
            memory: free_memory(),
            masters: masters(),
            cluster: cluster.map(Arc::new),
        }
    }
}

/// Hosts of `nodes`, each with some of its nodes.
async fn hosts_of(nodes: &[(String, MasterUri)]) -> Vec<(Host, Vec<String>)> {
    let mut hosts = BTreeMap::<_, Vec<String>>::new();
    for (name, address) in nodes {
        let nodes = hosts.entry(address.host.clone()).or_default();
        if nodes.len() < NAMED {
            nodes.push(name.clone());
        }
    }
    let mut lookups = JoinSet::new();
    for (host, nodes) in hosts {
        lookups.spawn(async move { (Host::find(&host).await, nodes) });
    }
    let mut hosts = lookups.join_all().await;
    hosts.sort_by(|(a, _), (b, _)| a.name.cmp(&b.name));
    hosts
}

impl Port {
    async fn inspect(number: u16) -> Self {
        let env = |name: &str| std::env::var(name).ok();
        let addresses: Vec<_> = ros_env::bind_addresses(&env)
            .into_iter()
            .map(|address| (address, number).into())
            .collect();
        let (mut error, mut taken) = (None, None);
        match listener::bind(&addresses, "-p") {
            Ok(_) => {}
            Err(ListenError::InUse { address, .. }) => {
                let at = match address.ip().is_unspecified() {
                    true => "localhost".to_owned(),
                    false => address.ip().to_string(),
                };
                let at = MasterUri {
                    host: at,
                    port: number,
                };
                taken = Some(PortInUse {
                    by: listeners::listeners_at(number)
                        .into_iter()
                        .map(Process::read)
                        .collect(),
                    server: ros::Responder::identify(&at).await,
                });
            }
            Err(ListenError::Other { source, .. }) => error = Some(source.to_string()),
        }
        Self {
            number,
            error,
            taken,
        }
    }
}

/// The master behind a `proxy`.
#[derive(Clone, Debug)]
pub(super) struct UpstreamMaster {
    pub(super) uri: MasterUri,
    /// Clients that talk to this master directly.
    pub(super) bypassing: Vec<String>,
    /// Whether this master runs on this computer and accepts connections from other computers.
    pub(super) is_open: bool,
}

impl UpstreamMaster {
    /// Finds clients that bypass rosrescue. `known` are those that the running rosrescue has seen.
    async fn inspect(uri: MasterUri, known: Vec<String>) -> Self {
        let place = timeout(LOOKUP_LIMIT, MasterAddresses::resolve(&uri))
            .await
            .ok()
            .flatten();
        let mut bypass = Bypass::default();
        if let Some(place) = &place {
            bypass.find_new_clients(place);
        }
        let all: BTreeSet<_> = bypass.names().into_iter().chain(known).collect();
        Self {
            uri,
            bypassing: all.into_iter().collect(),
            is_open: place.is_some_and(|place| place.is_open()),
        }
    }
}

impl CheckpointDisk {
    fn inspect(checkpoint: PathBuf) -> Self {
        let whole = std::path::absolute(&checkpoint).unwrap_or_else(|_| checkpoint.clone());
        let mut above = whole.ancestors().skip(1);
        let folder = above.find(|folder| folder.is_dir());
        let folder = folder.unwrap_or_else(|| Path::new("/")).to_owned();
        let folder = folder.canonicalize().unwrap_or(folder);
        let space = rustix::fs::statvfs(&folder).map_err(|error| error.to_string());
        let inodes = space.as_ref().ok().filter(|space| space.f_files > 0);
        let inodes = inodes.map(|space| space.f_favail);
        let space = space.map(|space| {
            let is_read_only = space.f_flag.contains(StatVfsMountFlags::RDONLY);
            (space.f_bavail.saturating_mul(space.f_frsize), is_read_only)
        });
        let may_write = |path: &Path| rustix::fs::access(path, Access::WRITE_OK);
        let is_missing = |error: &rustix::io::Errno| *error == rustix::io::Errno::NOENT;
        let refused = rustix::fs::access(&folder, Access::WRITE_OK | Access::EXEC_OK).err();
        let refused =
            refused.or_else(|| may_write(&whole).err().filter(|error| !is_missing(error)));
        Self {
            mount: mount_of(&folder),
            holder: checkpoint_store::holder_of(&whole),
            is_folder: whole.is_dir(),
            checkpoint: whole,
            folder,
            space,
            inodes,
            refused: refused.map(|error| io::Error::from(error).to_string()),
        }
    }
}

/// Type and source of the file system that holds `folder`, read from the mount table.
fn mount_of(folder: &Path) -> Option<(String, String)> {
    let table = fs::read_to_string("/proc/self/mountinfo").ok()?;
    let mounts = table.lines().filter_map(|line| {
        let (before, after) = line.split_once(" - ")?;
        let point = before.split(' ').nth(4)?.replace("\\040", " ");
        let mut after = after.split(' ');
        let found = (after.next()?.to_owned(), after.next()?.to_owned());
        folder.starts_with(&point).then_some((point.len(), found))
    });
    // A later mount hides an earlier one at the same place.
    mounts
        .max_by_key(|(length, _)| *length)
        .map(|(_, found)| found)
}

impl Clock {
    fn read(checkpoint: &Path) -> Self {
        let own = std::env::current_exe().unwrap_or_default();
        let changed = [
            checkpoint,
            &own,
            Path::new("/var/log/syslog"),
            Path::new("/etc/passwd"),
        ]
        .into_iter()
        .filter_map(|path| rustix::fs::stat(path).ok())
        .map(|stat| stat.st_mtime as f64);
        let synchronized = Path::new("/run/systemd/timesync/synchronized").exists();
        let service = process::all_pids()
            .map(Process::of_name)
            .find(|name| CLOCKS.contains(&&**name));
        Self {
            now: clock::wall_time(),
            newest: changed.fold(0.0, f64::max),
            service: match (synchronized, service) {
                (true, _) => Some("systemd-timesyncd".to_owned()),
                (false, service) => service,
            },
        }
    }
}

impl Process {
    fn of_name(pid: u32) -> String {
        process::name_of(pid)
    }
}

/// Masters in this network namespace that were not started by rosrescue.
fn masters() -> Vec<Process> {
    process::all_pids()
        .filter(|pid| ["rosmaster", "roscore"].contains(&&*Process::of_name(*pid)))
        .filter(|pid| process::is_in_our_network(*pid) && !process::is_of_any(*pid))
        .map(Process::read)
        .collect()
}

/// Listening processes in this network namespace that were started with another `ROS_MASTER_URI` than `own`. Only root
/// sees the processes of other users.
fn strays(own: &str) -> Vec<(Process, String)> {
    const NAME: &[u8] = b"ROS_MASTER_URI=";
    let strays = process::all_pids().filter_map(|pid| {
        let environment = fs::read(format!("/proc/{pid}/environ")).ok()?;
        let mut variables = environment.split(|byte| *byte == 0);
        let uri = variables.find_map(|variable| variable.strip_prefix(NAME))?;
        let uri = String::from_utf8_lossy(uri).into_owned();
        let is_stray = !uri.is_empty() && uri.trim_end_matches('/') != own.trim_end_matches('/');
        if !is_stray || !process::is_in_our_network(pid) || process::is_of_any(pid) {
            return None;
        }
        let process = Process::read(pid);
        // Shells have the variable too, but they do not listen.
        (!process.ports.is_empty() && process.name != "rosrescue").then_some((process, uri))
    });
    strays.collect()
}

/// Whether `uri` leads to the robot's master: to `far`, or to `port` of this computer.
async fn leads_to(uri: &str, far: Option<&MasterUri>, port: Option<&Port>) -> bool {
    let Ok(uri) = MasterUri::parse(uri) else {
        return false;
    };
    let host = Host::find(&uri.host).await;
    match far {
        Some(far) => {
            far.port == uri.port && host.addresses == Host::find(&far.host).await.addresses
        }
        None => host.is_here && port.is_some_and(|port| port.number == uri.port),
    }
}

/// How this computer got its address.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Lease {
    pub(super) address: String,
    pub(super) interface: String,
    /// Whether DHCP gave the address, and for a limited time.
    pub(super) is_leased: bool,
    pub(super) is_wireless: bool,
}

impl Lease {
    /// The lease of an address of `host`, if one of them is leased or wireless.
    async fn find_for_host(host: &Host) -> Option<Self> {
        for address in host
            .addresses
            .iter()
            .flatten()
            .filter(|at| !at.is_loopback())
        {
            let found = Self::find(&address.to_string()).await;
            if found.is_some() {
                return found;
            }
        }
        None
    }

    /// Asks `ip`, a program of iproute2. `None` if it is not installed.
    async fn find(address: &str) -> Option<Self> {
        let mut ip = tokio::process::Command::new("ip");
        let ip = ip.args(["-o", "addr", "show"]).kill_on_drop(true).output();
        let output = timeout(LOOKUP_LIMIT, ip).await.ok()?.ok()?;
        let (interface, is_leased) =
            interface_of(&String::from_utf8_lossy(&output.stdout), address)?;
        let is_wireless = Path::new("/sys/class/net")
            .join(&interface)
            .join("phy80211")
            .exists();
        (is_leased || is_wireless).then_some(Self {
            address: address.to_owned(),
            interface,
            is_leased,
            is_wireless,
        })
    }
}

/// Finds the interface with `address` in the output of `ip -o addr show`, and whether DHCP gave the address.
fn interface_of(output: &str, address: &str) -> Option<(String, bool)> {
    output.lines().find_map(|line| {
        let words: Vec<_> = line.split_whitespace().collect();
        let (own, _) = words.get(3)?.split_once('/')?;
        let found = ((*words.get(1)?).to_owned(), words.contains(&"dynamic"));
        (own == address).then_some(found)
    })
}

fn free_memory() -> Option<u64> {
    let table = fs::read_to_string("/proc/meminfo").ok()?;
    let line = table
        .lines()
        .find_map(|line| line.strip_prefix("MemAvailable:"))?;
    let kib: u64 = line.split_whitespace().next()?.parse().ok()?;
    Some(kib << 10)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn hosts_are_told_by_their_addresses() {
        let local = Host::find("127.0.0.1").await;
        assert!(local.is_here && local.is_loopback());
        // This network is reserved for documentation.
        let far = Host::find("192.0.2.1").await;
        assert!(!far.is_here && !far.is_loopback());
        let nobody = Host::find("nobody.invalid").await;
        assert!(!nobody.is_here && !nobody.is_loopback() && nobody.addresses.is_err());
    }

    #[test]
    fn a_leased_address_is_known() {
        let output = "1: lo    inet 127.0.0.1/8 scope host lo\\       valid_lft forever\n\
             2: wlan0    inet 10.0.0.7/24 brd 10.0.0.255 scope global dynamic wlan0\\       valid_lft 3600sec\n";
        assert_eq!(
            interface_of(output, "127.0.0.1"),
            Some(("lo".to_owned(), false))
        );
        assert_eq!(
            interface_of(output, "10.0.0.7"),
            Some(("wlan0".to_owned(), true))
        );
        assert_eq!(interface_of(output, "10.0.0.8"), None);
    }

    #[test]
    fn the_disk_of_a_checkpoint_that_is_not_there_yet_is_known() {
        let folder = tempfile::tempdir().unwrap();
        let disk = CheckpointDisk::inspect(folder.path().join("a/b/checkpoint"));
        assert_eq!(disk.folder, folder.path().canonicalize().unwrap());
        assert!(disk.space.unwrap().0 > 0);
        assert!(disk.mount.is_some() && disk.holder.is_none() && disk.refused.is_none());
        assert!(CheckpointDisk::inspect(folder.path().to_owned()).is_folder);
        let (of, source) = mount_of(Path::new("/proc/1")).unwrap();
        assert_eq!((&*of, &*source), ("proc", "proc"));
    }
}
