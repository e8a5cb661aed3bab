//! Assembles the program: startup, running, and orderly stop.

use std::{
    io,
    sync::Arc,
    time::{Duration, Instant},
};

use hyper::header::{HeaderValue, InvalidHeaderValue};
use thiserror::Error;
use tokio::{net::TcpListener, sync::Semaphore, task::JoinSet};
use tokio_util::{sync::CancellationToken, task::TaskTracker};

use crate::{
    checkpoint::store::{OpenError, history},
    clock,
    cluster::etcd::EtcdError,
    config::{Config, MasterConfig},
    gate::{self, State},
    guardian::handover::{self, Sockets},
    ledger::{Ledger, checkpointer::Checkpointer, journal::DISK_PATIENCE},
    lifecycle::{Action, Patience, Supervision},
    nodes::{self, Nodes, served::Served},
    process::{ProcessError, Rosmaster, bypass},
    recovery::{Driver, report_file},
    ros_env::MasterUri,
    server::{
        Server,
        access::Access,
        answers::Answers,
        body,
        calls::Calls,
        clients::Clients,
        idle::Idle,
        listener,
        pages::{Pages, status::Rate},
    },
    status::{Board, Earlier, Mode, stats::Stats},
    upstream::{Upstream, pool::Pool},
    wait, write_queue,
};

mod cluster;
mod duty;
mod earlier;
mod life;
mod notify;
mod startup;

use self::{
    duty::Post,
    notify::Source,
    startup::{Beginning, begin, kernel_id},
};

/// How long connections may take to end when rosrescue stops.
const DRAIN: Duration = Duration::from_millis(500);
/// How long a start waits for the reports of earlier rescues. Calls wait during this time.
const REPORTS: Duration = Duration::from_secs(1);

/// Why rosrescue cannot start or continue. The exit status is 1.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RunError {
    #[error("cannot serve a listening socket: {0}")]
    Listen(#[from] io::Error),
    /// The checkpoint cannot be used.
    #[error(transparent)]
    Checkpoint(OpenError),
    /// No master can be started.
    #[error(transparent)]
    Supervisor(#[from] ProcessError),
    /// The master's address leads back to this rosrescue.
    #[error(
        "--master {master} leads back to this rosrescue: give the address of the real rosmaster, and serve another address with --listen"
    )]
    Loop { master: MasterUri },
    /// Two computers have the same name. They would depose each other forever.
    #[error(
        "another computer of this robot has the same name, `{name}`: it is at {uri}, this one is at {own}. Give this one a unique name with --cluster-name"
    )]
    Namesake {
        name: String,
        uri: String,
        own: String,
    },
    /// Two computers have the same name and the same address.
    #[error(
        "another computer of this robot has the same name, `{name}`, and the same address, {uri}. Set ROS_IP on \
         each computer to its own address; a name given with --cluster-name must be unique, too"
    )]
    Double { name: String, uri: String },
    /// The etcd options cannot be used.
    #[error(transparent)]
    Cluster(#[from] EtcdError),
    /// The kernel's random id is not a valid header value. This does not happen with the kernel's
    /// own ids.
    #[error("the kernel's random id is not usable: {0}")]
    Instance(#[from] InvalidHeaderValue),
}

/// Serves `sockets` until `stop`. `say` prints a line for the operator.
pub async fn run(
    mut config: Config,
    sockets: Sockets,
    names: Vec<String>,
    stop: CancellationToken,
    say: impl Fn(&str),
) -> Result<(), RunError> {
    if let Some(bound) = sockets.addresses().first() {
        config.serve_on(bound.port());
    }
    let Sockets { listeners, guard } = sockets;
    let listeners = listeners.into_iter().map(TcpListener::from_std);
    let listeners = listeners.collect::<io::Result<Vec<_>>>()?;
    let supervised = match &config.master {
        MasterConfig::Supervised(supervised) => Some((
            supervised.clone(),
            Rosmaster::find(supervised, &config.checkpoint)?,
        )),
        MasterConfig::External(_) => None,
    };
    let beginning = begin(&config).await?;
    let uri = config.advertised.to_string();
    say(&format!("ROS_MASTER_URI={uri}"));
    say(&format!("checkpoint: {}", config.checkpoint.display()));
    say(&beginning.story);
    let last = beginning.session.master_uri.as_deref();
    let last = last.and_then(|uri| MasterUri::parse(uri).ok());
    // A recorded master cannot be at rosrescue's own port.
    let last = last.filter(|uri| uri.port != config.advertised.port);
    let address = match (&config.master, &last) {
        (MasterConfig::External(address), _) => address.clone(),
        (_, Some(last)) => last.clone(),
        // A placeholder until there is a master.
        (_, None) => MasterUri {
            host: "127.0.0.1".to_owned(),
            port: 0,
        },
    };
    let rosout = supervised.as_ref().map(|(config, _)| config.rosout);
    let port = last.map(|uri| uri.port);
    let rosmaster = supervised.map(|(_, rosmaster)| rosmaster);
    let instance = kernel_id("/proc/sys/kernel/random/uuid");
    let Beginning {
        mirror,
        session,
        pending,
        displaced,
        store,
        restored,
        died,
        ..
    } = beginning;
    let mut earlier = match &store {
        Some(store) => {
            let (path, id) = (store.path().to_owned(), session.id.clone());
            let read = move || report_file::earlier(&path, &id, died, history::last_rescue(&path));
            wait::within(REPORTS, read).await.unwrap_or_default()
        }
        None => Earlier::default(),
    };
    earlier.worker_restarts = earlier.worker_restarts.max(handover::restarts());
    // The statistics live as long as the process.
    let stats: &'static Stats = Box::leak(Box::default());
    let (gate_tx, gate) = gate::gate();
    let (mode, supervision) = match rosmaster {
        Some(_) => (Mode::Core, Supervision::Ours),
        None => (Mode::Proxy, Supervision::Theirs),
    };
    let (board, slow, looped) = (Arc::new(Board::new(mode)), Arc::default(), Arc::default());
    let removed = earlier.reports.iter().flat_map(|report| {
        let at = clock::moment_of(report.detected_at);
        report.removed.iter().map(move |node| (node.clone(), at))
    });
    let removed: Vec<_> = removed.collect();
    board.update(|facts| facts.go_on(earlier));
    let ledger = Arc::new(Ledger::new(
        mirror,
        session,
        pending,
        store,
        config.sync,
        stats,
    ));
    // In a cluster each leader starts with a new master.
    if restored && config.cluster.is_none() {
        ledger.set_unconfirmed();
        ledger.with_activity(|_, activity| activity.restore_displaced(displaced));
    }
    let pid = i32::try_from(std::process::id()).unwrap_or(-1);
    ledger.set_identity(pid, uri.clone());
    let upstream = Arc::new(Upstream::new(
        address,
        HeaderValue::from_str(&instance)?,
        config.probe_timeout,
        config.probing.count,
    ));
    let (write_queue, drain) = write_queue::write_queue(
        ledger.clone(),
        upstream.clone(),
        gate.clone(),
        stats,
        config.resync_interval,
        config.reap_interval.is_some(),
        Patience::new(config.probing.patience),
    );
    let served = Served::default();
    let nodes = Arc::new(Nodes::new(
        ledger.clone(),
        gate.clone(),
        write_queue.clone(),
        stats,
        config.node_timeout,
        served.clone(),
    ));
    for (node, at) in removed {
        nodes.removed.add(&node, at);
    }
    let post = Post {
        ledger: ledger.clone(),
        upstream: upstream.clone(),
        gate_tx,
        gate: gate.clone(),
        write_queue: write_queue.clone(),
        slow: Arc::clone(&slow),
        nodes: nodes.clone(),
        board: board.clone(),
        stats,
        supervision,
        probing: config.probing,
        probe_timeout: config.probe_timeout,
        history: config.history,
        uri: uri.clone(),
        checkpoint: config.checkpoint.clone(),
        node_timeout: config.node_timeout,
    };
    let told = Source {
        board: board.clone(),
        ledger: ledger.clone(),
        gate: gate.clone(),
        upstream: upstream.clone(),
    };
    let notified = notify::start(guard, told, stop.clone());
    let halt = CancellationToken::new();
    let (others, runs) = match (config.cluster.clone(), rosmaster.clone(), rosout) {
        (Some(cluster), Some(rosmaster), Some(rosout)) => {
            let given = cluster::Given {
                config: cluster,
                post,
                rosmaster,
                rosout,
                instance: HeaderValue::from_str(&instance)?,
                restore: config.restore,
                hold: config.hold,
                restored,
                hide: config.hide.clone(),
                served,
                halt: halt.clone(),
            };
            let (others, driver) = cluster::join(given).await?;
            (Some(others), Runs::Member(Box::new(driver)))
        }
        _ => {
            if restored {
                // The mirror answers while orphans of an earlier rosrescue are still being looked
                // for.
                post.gate_tx.set(State::StandingIn);
            }
            (None, Runs::Single(Box::new(post)))
        }
    };
    let clients = Arc::new(Clients::default());
    let pool = Pool::new(
        config.master_connections,
        upstream.clone(),
        ledger.clone(),
        gate.clone(),
    );
    let access = Access::new(config.allow.clone(), config.allow_write.clone());
    if !config.allow.is_empty() || !config.allow_write.is_empty() {
        tracing::info!("{access}");
    }
    let server = Arc::new(Server {
        names,
        access,
        refused: Default::default(),
        instance,
        looped: Arc::clone(&looped),
        clients: clients.clone(),
        idle: Idle::among(config.max_connections),
        max_body: config.max_body,
        bodies: body::budget(config.max_body),
        answers: Answers::within(2 * config.max_body),
        stats,
        calls: Calls {
            gate: gate.clone(),
            ledger: ledger.clone(),
            reads: config.reads,
            last_large: Default::default(),
            compared: Default::default(),
            pool: Arc::new(pool),
            write_queue,
            slow,
            stats,
            uri: uri.clone(),
            hold: config.hold,
            others,
        },
        pages: Pages {
            uri,
            checkpoint: config.checkpoint.display().to_string(),
            upstream: upstream.clone(),
            gate: gate.clone(),
            ledger: ledger.clone(),
            nodes: nodes.clone(),
            board: board.clone(),
            clients,
            stats,
            rate: Rate::new(Instant::now()),
            hide: config.hide,
            stop: halt.clone(),
            desk: Default::default(),
        },
    });
    let permits = Arc::new(Semaphore::new(config.max_connections));
    let connections = TaskTracker::new();
    let mut tasks = JoinSet::new();
    for listener in listeners {
        tasks.spawn(listener::run(
            listener,
            server.clone(),
            permits.clone(),
            connections.clone(),
            halt.clone(),
        ));
    }
    drop(server);
    let is_proxy = matches!(config.master, MasterConfig::External(_));
    let proxied = is_proxy.then(|| (upstream.clone(), board.clone()));
    // Meanwhile the mirror answers reads; writes wait, and so does everything that goes to the
    // master.
    let checkpointer = Checkpointer::begin(
        ledger.clone(),
        board,
        config.checkpoint,
        config.sync_interval,
    );
    let duty = async {
        match runs {
            Runs::Single(post) => {
                let ends = (stop.clone(), halt.clone());
                let (driver, first) = post.alone(rosmaster, port, rosout, restored, ends).await;
                Begun::Single(Box::new(driver), first)
            }
            Runs::Member(member) => Begun::Member(member),
        }
    };
    let (checkpointer, begun) = tokio::join!(checkpointer, duty);
    tasks.spawn(checkpointer.run(halt.clone()));
    tasks.spawn(drain.run());
    tasks.spawn(nodes::liveness::watch(nodes.clone()));
    tasks.spawn(nodes::watch(nodes, config.reap_interval));
    if let Some((upstream, board)) = proxied {
        tasks.spawn(bypass::watch(
            upstream,
            board,
            config.advertised.to_string(),
        ));
    }
    let announce = async {
        gate.clone()
            .wait_for(|state| state.is_open() || state == State::Elsewhere)
            .await;
        say("ROS Rescue enabled. Master is now fault tolerant!!");
        std::future::pending().await
    };
    let mut driver = match begun {
        Begun::Single(driver, first) => {
            tokio::spawn(async { driver.run(first, halt).await.map_err(RunError::from) })
        }
        Begun::Member(member) => tokio::spawn(member.run(stop)),
    };
    let process = tokio::select! {
        process = &mut driver => match process {
            Ok(process) => process?,
            Err(panic) => std::panic::resume_unwind(panic.into_panic()),
        },
        () = announce => None,
        () = looped.notified() => return Err(RunError::Loop { master: upstream.address() }),
    };
    connections.close();
    // Calls that still wait cannot be answered any more, so their connections are closed.
    let _ = tokio::time::timeout(DRAIN, connections.wait()).await;
    tasks.shutdown().await;
    close(ledger).await;
    if let Some(process) = process {
        process.stop().await;
    }
    // systemd may not be reading.
    let _ = tokio::time::timeout(DRAIN, notified).await;
    Ok(())
}

/// Whether this computer manages the master alone or as one of several.
enum Runs {
    /// The only computer.
    Single(Box<Post>),
    /// One of several.
    Member(Box<cluster::ClusterDriver>),
}

/// The running manager of the master.
enum Begun {
    /// The driver of a single computer, with its first actions.
    Single(Box<Driver>, Vec<Action>),
    Member(Box<cluster::ClusterDriver>),
}

/// Writes the closing checkpoint if the disk answers within [`DISK_PATIENCE`].
async fn close(ledger: Arc<Ledger>) {
    let has_store = ledger.seen_store().is_some();
    ledger.update_session(|session| session.closed = true);
    let closed = ledger.on_store_whole(|store, checkpoint| store.close(&checkpoint));
    match tokio::time::timeout(DISK_PATIENCE, closed).await {
        Ok(Some(Err(error))) => tracing::error!(
            %error,
            "stopped, but could not write the closing checkpoint: the next start treats this as a crash; free space on the disk or repair it"
        ),
        Ok(Some(Ok(()))) => tracing::info!("stopped cleanly"),
        Ok(None) if !has_store => tracing::info!("stopped cleanly"),
        Ok(None) | Err(_) => tracing::error!(
            "stopped without a closing checkpoint: the disk has not answered for {DISK_PATIENCE:?}. The next start treats this as a crash; repair the disk"
        ),
    }
}
