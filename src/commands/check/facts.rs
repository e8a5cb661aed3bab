//! Gathers facts about this computer.

mod clock;
mod disk;
mod host;
mod lease;
mod processes;

use std::{
    collections::BTreeSet,
    fs,
    net::IpAddr,
    path::{Path, PathBuf},
    sync::Arc,
    time::Duration,
};

use rustix::process::{Resource, getrlimit};
use tokio::time::timeout;

pub(super) use self::{
    clock::Clock, disk::CheckpointDisk, host::Host, lease::Lease, processes::Process,
};
use self::{
    host::hosts_of,
    processes::{masters, strays},
};
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
    config,
    process::{
        Rosout,
        bypass::{Bypass, MasterAddresses},
        listeners,
    },
    ros_env::{self, MasterUri, UriError},
    server::listener::{self, ListenError},
};

/// Longest time for one name lookup. A dead name server takes longer.
const LOOKUP_LIMIT: Duration = Duration::from_secs(6);
/// Maximum number of addresses in launch files that are looked up.
const LOOKUPS_MOST: usize = 4;

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

fn free_memory() -> Option<u64> {
    let table = fs::read_to_string("/proc/meminfo").ok()?;
    let line = table
        .lines()
        .find_map(|line| line.strip_prefix("MemAvailable:"))?;
    let kib: u64 = line.split_whitespace().next()?.parse().ok()?;
    Some(kib << 10)
}
