//! Assembles the program: startup, running, orderly stop.

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
    checkpoint::store::OpenError,
    cluster::etcd::EtcdError,
    config::{Config, MasterConfig},
    gate::{self, State},
    guardian::handover::Sockets,
    ledger::{Ledger, checkpointer::Checkpointer},
    lifecycle::Supervision,
    nodes::{self, Nodes},
    process::{ProcessError, Rosmaster},
    recovery::{Driver, master_process::MasterProcess},
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
    status::{Board, Mode, stats::Stats},
    upstream::{Upstream, pool::Pool},
    write_queue,
};

mod cluster;
mod duty;
mod life;
mod notify;
mod startup;

use self::{
    cluster::Member,
    duty::Post,
    notify::Source,
    startup::{Beginning, begin, kernel_id},
};

/// How long connections may take to end at the stop.
const DRAIN: Duration = Duration::from_millis(500);

/// Why rosrescue cannot start or continue. Exit status 1.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RunError {
    #[error("cannot serve a socket: {0}")]
    Listen(#[from] io::Error),
    /// The checkpoint cannot be used.
    #[error(transparent)]
    Checkpoint(OpenError),
    /// No master can be started.
    #[error(transparent)]
    Supervisor(#[from] ProcessError),
    /// The master's address is our own.
    #[error(
        "--master {master} is this rosrescue itself: give the address of the real rosmaster, and \
         serve another one with --listen"
    )]
    Loop { master: MasterUri },
    /// Two computers would depose each other for ever.
    #[error(
        "another rosrescue has the same name in the cluster, `{name}`, and leads at {uri}: give each computer a \
         name of its own with --cluster-name"
    )]
    Namesake { name: String, uri: String },
    /// Several computers: etcd's options cannot be used.
    #[error(transparent)]
    Cluster(#[from] EtcdError),
    /// Cannot happen with the kernel's ids.
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
        config.advertised.port = bound.port();
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
    // No master can be at our own port.
    let last = last.filter(|uri| uri.port != config.advertised.port);
    let address = match (&config.master, &last) {
        (MasterConfig::External(address), _) => address.clone(),
        (_, Some(last)) => last.clone(),
        // Until there is a master.
        (_, None) => MasterUri {
            host: "127.0.0.1".to_owned(),
            port: 0,
        },
    };
    let rosout = supervised.as_ref().map(|(config, _)| config.rosout);
    let port = last.map(|uri| uri.port);
    let rosmaster = supervised.map(|(_, rosmaster)| rosmaster);
    let is_member = config.cluster.is_some();
    let process = rosmaster.clone().filter(|_| !is_member);
    let process = process.map(|rosmaster| {
        let left = rosmaster.left_behind(port);
        MasterProcess::new(rosmaster, port, left)
    });
    let left = process.as_ref().is_some_and(MasterProcess::is_left);
    let instance = kernel_id("/proc/sys/kernel/random/uuid");
    let Beginning {
        mirror,
        session,
        pending,
        store,
        restored,
        ..
    } = beginning;
    // Lives as long as the process.
    let stats: &'static Stats = Box::leak(Box::default());
    let (gate_tx, gate) = gate::gate();
    let (mode, supervision) = match rosmaster {
        Some(_) => (Mode::Core, Supervision::Ours),
        None => (Mode::Proxy, Supervision::Theirs),
    };
    let (board, slow, looped) = (Arc::new(Board::new(mode)), Arc::default(), Arc::default());
    let ledger = Arc::new(Ledger::new(
        mirror,
        session,
        pending,
        store,
        config.sync,
        stats,
    ));
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
    );
    let nodes = Arc::new(Nodes::new(
        ledger.clone(),
        gate.clone(),
        write_queue.clone(),
        stats,
        config.node_timeout,
    ));
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
    let (others, runs) = match (config.cluster.clone(), rosmaster, rosout) {
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
                halt: halt.clone(),
            };
            let (others, member) = cluster::join(given).await?;
            (Some(others), Runs::Member(Box::new(member)))
        }
        _ => {
            let duties = rosout.map(|rosout| post.roscore(rosout, !left, stop.clone()));
            tokio::spawn({
                let (stop, halt) = (stop.clone(), halt.clone());
                async move {
                    stop.cancelled().await;
                    if let Some(duties) = duties {
                        // A panic there must not prevent the stop.
                        let _ = duties.await;
                    }
                    halt.cancel();
                }
            });
            (None, Runs::Single(Box::new(post.driver(process))))
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
    // The mirror answers reads meanwhile; writes wait, and so does what the master may be told.
    let (first, runs) = match runs {
        Runs::Single(mut driver) => (driver.start(restored), Runs::Single(driver)),
        member => (Vec::new(), member),
    };
    let checkpointer = Checkpointer::begin(
        ledger.clone(),
        board,
        config.checkpoint,
        config.sync_interval,
    )
    .await;
    tasks.spawn(checkpointer.run(halt.clone()));
    tasks.spawn(drain.run());
    tasks.spawn(nodes::watch(nodes, config.reap_interval));
    let announce = async {
        gate.clone()
            .wait_for(|state| state.is_open() || state == State::Elsewhere)
            .await;
        say("ROS Rescue enabled. Master is now fault tolerant!!");
        std::future::pending().await
    };
    let mut driver = match runs {
        Runs::Single(driver) => {
            tokio::spawn(async { driver.run(first, halt).await.map_err(RunError::from) })
        }
        Runs::Member(member) => tokio::spawn(member.run(stop)),
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
    // Calls that still wait cannot be answered: their connections are closed.
    let _ = tokio::time::timeout(DRAIN, connections.wait()).await;
    tasks.shutdown().await;
    close(ledger).await;
    if let Some(process) = process {
        process.stop().await;
    }
    // systemd may read nothing.
    let _ = tokio::time::timeout(DRAIN, notified).await;
    Ok(())
}

/// Who sees to the master.
enum Runs {
    /// This computer.
    Single(Box<Driver>),
    /// One of several.
    Member(Box<Member>),
}

/// Writes the closing checkpoint.
async fn close(ledger: Arc<Ledger>) {
    let closed = tokio::task::spawn_blocking(move || {
        ledger.update_session(|session| session.closed = true);
        ledger.with_store(|store, checkpoint| store.close(&checkpoint()))
    });
    match closed.await {
        Ok(Some(Err(error))) => tracing::error!(
            %error,
            "stopped, but the closing checkpoint could not be written: the next start takes this for \
             a crash; free or repair the disk"
        ),
        Ok(_) => tracing::info!("closed in order"),
        Err(error) => {
            tracing::error!(%error, "stopped without a closing checkpoint; please report this")
        }
    }
}
