//! Puts the parts together, from the first look at the checkpoint to the orderly stop.

use std::{
    io,
    path::Path,
    sync::{Arc, atomic::AtomicU32},
    time::Duration,
};

use hyper::header::{HeaderValue, InvalidHeaderValue};
use thiserror::Error;
use tokio::{net::TcpListener, sync::Semaphore, task::JoinSet};
use tokio_util::{sync::CancellationToken, task::TaskTracker};

use crate::{
    checkpoint::{
        format::Session,
        session::{self, Decision, Evidence, Rebuilt},
        store::{self, OpenError, Store},
    },
    clock,
    config::{Config, MasterConfig},
    gate::{self, State},
    guardian::handover::Sockets,
    ledger::{Ledger, checkpointer},
    lifecycle::Supervision,
    master::Master,
    nodes::{self, Nodes},
    process::{ProcessError, Rosmaster},
    recovery::{Driver, examine::Examiner, master_process::MasterProcess},
    ros_env::MasterUri,
    roscore::{self, Roscore},
    server::{Server, calls::Calls, clients::Clients, idle::Idle, listener, pages::Pages},
    status::{Board, stats::Stats},
    upstream::{Upstream, pool::Pool},
    write_queue,
    xmlrpc::Call,
};

mod life;
mod notify;

use self::notify::Told;

/// So many bodies of the largest size may be in memory at the same time.
const LARGE_BODIES: usize = 4;
/// How long connections have to end at the stop.
const DRAIN: Duration = Duration::from_millis(500);

/// What prevents the work. Exit status 1.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RunError {
    /// A socket cannot be served.
    #[error("cannot serve a socket: {0}")]
    Listen(#[from] io::Error),
    /// The checkpoint belongs to somebody else.
    #[error(transparent)]
    Checkpoint(OpenError),
    /// No master can be run.
    #[error(transparent)]
    Supervisor(#[from] ProcessError),
    /// The master's address is our own.
    #[error(
        "--master {master} is this rosrescue itself: give the address of the real rosmaster, and \
         serve another one with --listen"
    )]
    Loop {
        /// The address.
        master: MasterUri,
    },
    /// Cannot happen with what the kernel gives as an id.
    #[error("the kernel's random id is not usable: {0}")]
    Instance(#[from] InvalidHeaderValue),
}

/// What was found at the start.
struct Beginning {
    mirror: Master,
    session: Session,
    /// Writes that the session's last master may not have run.
    pending: Vec<Call>,
    store: Option<Store>,
    restored: bool,
    /// In words, for the person who started us.
    story: String,
}

/// Serves `sockets` until `stop`. `say` prints a line for the person who started us.
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
    let last = beginning.session.master_uri.as_deref();
    let last = last.and_then(|uri| MasterUri::parse(uri).ok());
    // Where we listen ourselves now, no master can be.
    let last = last.filter(|uri| uri.port != config.advertised.port);
    let address = match (&config.master, &last) {
        (MasterConfig::External(address), _) => address.clone(),
        (_, Some(last)) => last.clone(),
        // Until there is one.
        (_, None) => MasterUri {
            host: "127.0.0.1".to_owned(),
            port: 0,
        },
    };
    let rosout = supervised.as_ref().map(|(config, _)| config.rosout);
    let port = last.map(|uri| uri.port);
    let process = supervised.map(|(_, rosmaster)| MasterProcess::new(rosmaster, port));
    let left = process.as_ref().is_some_and(MasterProcess::is_left);
    let instance = kernel_id("/proc/sys/kernel/random/uuid");
    let Beginning {
        mirror,
        session,
        pending,
        store,
        restored,
        story,
    } = beginning;
    // Counted for as long as the process lives.
    let stats: &'static Stats = Box::leak(Box::default());
    let (gate_tx, gate) = gate::gate();
    let (board, slow, looped) = (Arc::new(Board::default()), Arc::default(), Arc::default());
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
    let (write_queue, worker) = write_queue::write_queue(
        ledger.clone(),
        upstream.clone(),
        gate.clone(),
        stats,
        config.resync_interval,
    );
    let nodes = Arc::new(Nodes::new(
        ledger.clone(),
        gate.clone(),
        write_queue.clone(),
        stats,
        config.node_timeout,
    ));
    let supervision = match process {
        Some(_) => Supervision::Ours,
        None => Supervision::Theirs,
    };
    let driver = Driver::new(
        Examiner {
            ledger: ledger.clone(),
            upstream: upstream.clone(),
            gate: gate_tx,
            supervision,
            probing: config.probing,
            probe_timeout: config.probe_timeout,
            stats,
        },
        write_queue.clone(),
        Arc::clone(&slow),
        nodes.clone(),
        board.clone(),
        process,
    );
    let told = Told {
        board: board.clone(),
        ledger: ledger.clone(),
        gate: gate.clone(),
    };
    notify::start(guard, told, stop.clone());
    let halt = CancellationToken::new();
    let duties = rosout.map(|rosout| {
        let roscore = Roscore {
            ledger: ledger.clone(),
            write_queue: write_queue.clone(),
            gate: gate.clone(),
            uri: uri.clone(),
            checkpoint: config.checkpoint.clone(),
            node_timeout: config.node_timeout,
            rosout: AtomicU32::new(0),
        };
        if !left {
            roscore::seed_run_id(&roscore);
        }
        tokio::spawn(roscore::run(roscore, rosout, stop.clone()))
    });
    tokio::spawn({
        let halt = halt.clone();
        async move {
            stop.cancelled().await;
            if let Some(duties) = duties {
                // A panic of theirs is no reason not to stop.
                let _ = duties.await;
            }
            halt.cancel();
        }
    });
    let clients = Arc::new(Clients::default());
    let pool = Pool::new(
        config.master_connections,
        upstream.clone(),
        ledger.clone(),
        gate.clone(),
    );
    let server = Arc::new(Server {
        names,
        instance,
        looped: Arc::clone(&looped),
        clients: clients.clone(),
        idle: Idle::among(config.max_connections),
        max_body: config.max_body,
        bodies: Semaphore::new(LARGE_BODIES * (config.max_body >> 10)),
        stats,
        calls: Calls {
            gate: gate.clone(),
            ledger: ledger.clone(),
            pool: Arc::new(pool),
            write_queue,
            slow,
            stats,
            uri: uri.clone(),
            hold: config.hold,
        },
        pages: Pages {
            uri,
            checkpoint: config.checkpoint.display().to_string(),
            upstream: upstream.clone(),
            gate: gate.clone(),
            ledger: ledger.clone(),
            nodes: nodes.clone(),
            board,
            clients,
            stats,
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
    tasks.spawn(worker.run());
    tasks.spawn(checkpointer::run(
        ledger.clone(),
        config.checkpoint,
        config.sync_interval,
        halt.clone(),
    ));
    tasks.spawn(nodes::watch(nodes, config.reap_interval));
    let announce = async {
        gate.clone().wait_for(State::is_open).await;
        say(&format!("{story}: {}", ledger.with_mirror(Master::counts)));
        say("ROS Rescue enabled. Master is now fault tolerant!!");
        std::future::pending().await
    };
    let mut driver = tokio::spawn(driver.run(restored, halt));
    let process = tokio::select! {
        process = &mut driver => match process {
            Ok(process) => process?,
            Err(panic) => std::panic::resume_unwind(panic.into_panic()),
        },
        () = announce => None,
        () = looped.notified() => return Err(RunError::Loop { master: upstream.address() }),
    };
    connections.close();
    // Calls that still wait cannot be answered any more: their connections are closed.
    let _ = tokio::time::timeout(DRAIN, connections.wait()).await;
    tasks.shutdown().await;
    close(ledger).await;
    if let Some(process) = process {
        process.stop().await;
    }
    Ok(())
}

/// Writes the closing checkpoint.
async fn close(ledger: Arc<Ledger>) {
    let closed = tokio::task::spawn_blocking(move || {
        ledger.update_session(|session| session.closed = true);
        ledger.with_store(|store, checkpoint| store.close(&checkpoint()))
    });
    match closed.await {
        Ok(Some(Err(error))) => tracing::error!(%error, "no closing checkpoint"),
        Ok(_) => tracing::info!("closed in order"),
        Err(error) => tracing::error!(%error, "no closing checkpoint"),
    }
}

/// Reads the checkpoint and decides whether its session goes on.
async fn begin(config: &Config) -> Result<Beginning, RunError> {
    let (mut store, loaded) = match Store::open(&config.checkpoint) {
        Ok((store, loaded)) => (Some(store), loaded),
        Err(error @ OpenError::Io { .. }) => {
            // A robot without a disk still needs its master.
            tracing::error!(
                %error,
                "unprotected: the checkpoint cannot be used; calls are forwarded, but a crash of \
                 rosrescue itself would lose the state. Choose a place with --checkpoint"
            );
            (None, store::read(&config.checkpoint).ok().flatten())
        }
        Err(error) => return Err(RunError::Checkpoint(error)),
    };
    let boot_id = kernel_id("/proc/sys/kernel/random/boot_id");
    let mut story = "a new session begins".to_owned();
    let mut beginning = None;
    let mut master_uri = None;
    if let Some(loaded) = loaded {
        for sentence in loaded.torn.iter() {
            tracing::info!("checkpoint: {sentence}");
        }
        for sentence in &loaded.damage {
            tracing::error!("checkpoint: {sentence}");
        }
        let Rebuilt {
            mirror,
            session,
            pending,
            trouble,
        } = session::rebuild(loaded.checkpoint, loaded.records);
        if let Some(trouble) = trouble {
            tracing::error!("checkpoint: its snapshot is no state of a master: {trouble}");
        }
        let session = session.unwrap_or_default();
        let same_boot = session.boot_id == boot_id;
        let mut evidence = Evidence {
            same_boot,
            closed: session.closed,
            node_alive: false,
        };
        if session::depends_on_nodes(config.restore, evidence) {
            evidence.node_alive = life::any_alive(&mirror, same_boot).await;
        }
        match session::decide(config.restore, evidence) {
            Decision::Restore(why) => {
                story = format!("restored ({why})");
                beginning = Some((mirror, session, pending));
            }
            Decision::Fresh(why) => {
                // A master that a rosrescue left behind when it crashed is taken over.
                master_uri = session.master_uri.filter(|_| !session.closed);
                let kept = store.as_mut().map(|store| store.set_aside("session"));
                let kept = match kept {
                    Some(Ok(Some(path))) => {
                        format!("; the old checkpoint is kept as {}", path.display())
                    }
                    Some(Err(error)) => {
                        tracing::error!(%error, "the old checkpoint is not kept");
                        String::new()
                    }
                    _ => String::new(),
                };
                story = format!("a new session begins ({why}{kept})");
            }
        }
    }
    let restored = beginning.is_some();
    let (mirror, mut session, pending) = beginning.unwrap_or_default();
    if !restored || session.mark.is_empty() {
        session.master_uri = master_uri;
        session.id = kernel_id("/proc/sys/kernel/random/uuid");
        session.mark = session.id.clone();
        session.started = clock::wall_text(clock::wall_time());
    }
    session.boot_id = boot_id;
    session.closed = false;
    if let Some(open) = &mut store {
        let checkpoint = crate::checkpoint::format::Checkpoint {
            seq: open.seq(),
            session: session.clone(),
            snapshot: mirror.snapshot(),
            pending: pending.clone(),
        };
        if let Err(error) = open.begin(&checkpoint) {
            tracing::error!(
                %error,
                "unprotected: the checkpoint cannot be written; calls are forwarded, and it is \
                 tried again every second"
            );
        }
    }
    Ok(Beginning {
        mirror,
        session,
        pending,
        store,
        restored,
        story,
    })
}

/// An id from the kernel, or a constant where there is none: it is compared, not trusted.
fn kernel_id(path: impl AsRef<Path>) -> String {
    std::fs::read_to_string(path).map_or_else(|_| "unknown".to_owned(), |id| id.trim().to_owned())
}
