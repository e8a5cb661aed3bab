//! Assembles the program: startup, running, and orderly stop.

use std::{any::Any, io, sync::Arc, time::Duration};

use checkpoint_store::OpenError;
use thiserror::Error;
use tokio::{
    net::TcpListener,
    sync::Semaphore,
    task::{JoinError, JoinSet},
};
use tokio_util::{sync::CancellationToken, task::TaskTracker};

use crate::{
    cluster::etcd::EtcdError,
    config::{Config, MasterConfig},
    gate::State,
    guardian::handover::Sockets,
    ledger::{Ledger, checkpointer::Checkpointer, disk_jobs::DISK_PATIENCE},
    nodes,
    process::{ProcessError, Rosmaster, bypass},
    recovery::{Driver, course::Step, master_process::MasterProcess},
    ros_env::MasterUri,
    server::{Server, listener, others::Others},
    task::boxed,
};

mod assemble;
mod cluster;
mod context;
mod life;
mod master_duties;
mod notify;
mod startup;

use self::{
    assemble::{assemble, last_master, server},
    cluster::ClusterDriver,
    context::Context,
    startup::begin,
};

/// How long connections may take to end when rosrescue stops.
const DRAIN: Duration = Duration::from_millis(500);
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
    /// Two computers with one name would depose each other forever.
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
        MasterConfig::Supervised(master) => Some(Supervised {
            rosmaster: Rosmaster::find(master, &config.checkpoint)?,
            rosout: master.rosout,
        }),
        MasterConfig::External(_) => None,
    };
    let beginning = begin(&config).await?;
    say(&format!("ROS_MASTER_URI={}", config.advertised));
    say(&format!("checkpoint: {}", config.checkpoint.display()));
    say(&beginning.story);
    let restored = beginning.restored;
    let last = last_master(&config, &beginning);
    let (context, drain) = assemble(&config, beginning, last.clone()).await;
    let context = Arc::new(context);
    let notified = notify::start(guard, context.clone(), stop.clone());
    let halt = CancellationToken::new();
    let (others, runs) = Runs::choose(&config, &context, supervised, restored, &halt).await?;
    let looped = Arc::default();
    let server = server(
        &config,
        &context,
        names,
        others,
        (Arc::clone(&looped), halt.clone()),
    );
    let connections = TaskTracker::new();
    let mut tasks = accept(listeners, &config, server, &connections, &halt);
    // While the first checkpoint is written, the mirror answers reads. Writes wait, and so does everything that goes to
    // the master.
    let checkpointer = Checkpointer::begin(
        context.ledger.clone(),
        context.board.clone(),
        config.checkpoint.clone(),
        config.sync_interval,
        config.log_bytes(),
    );
    let port = last.map(|uri| uri.port);
    let (checkpointer, begun) = tokio::join!(
        checkpointer,
        runs.begin(&context, port, restored, &stop, &halt)
    );
    tasks.spawn(boxed(checkpointer.run(halt.clone())));
    tasks.spawn(boxed(drain.run()));
    watch(&config, &context, &mut tasks);
    let process = tokio::select! {
        process = begun.run(stop, halt) => process?,
        () = announce(&context, say) => None,
        () = looped.notified() => return Err(RunError::Loop { master: context.reach.upstream.address() }),
        panic = panicked(&mut tasks) => std::panic::resume_unwind(panic),
    };
    connections.close();
    // Calls that still wait cannot be answered any more, so their connections are closed.
    let _ = tokio::time::timeout(DRAIN, connections.wait()).await;
    tasks.shutdown().await;
    close(context.ledger.clone()).await;
    if let Some(process) = process {
        process.stop().await;
    }
    // The time is limited, because systemd may not be reading.
    let _ = tokio::time::timeout(DRAIN, notified).await;
    Ok(())
}

/// Waits until one of `tasks` panics. Without that task rosrescue would go on half dead, and the next worker has all state.
async fn panicked(tasks: &mut JoinSet<()>) -> Box<dyn Any + Send> {
    while let Some(ended) = tasks.join_next().await {
        if let Err(Ok(panic)) = ended.map_err(JoinError::try_into_panic) {
            return panic;
        }
    }
    std::future::pending().await
}

/// The rosmaster that this rosrescue starts, and whether it starts rosout, too.
struct Supervised {
    rosmaster: Rosmaster,
    rosout: bool,
}

/// Pause between two checks whether changes are recorded again.
const PROTECTED_AGAIN: Duration = Duration::from_secs(1);

/// Tells the operator that the master is protected, as soon as calls pass and changes are recorded. Never ends.
async fn announce(context: &Context, say: impl Fn(&str)) {
    let mut gate = context.gate.clone();
    gate.wait_for(|state| state.is_open() || state == State::Elsewhere)
        .await;
    if context.ledger.unprotected().is_some() {
        say(
            "ROS Rescue enabled, but UNPROTECTED: a crash of rosrescue itself would lose the state",
        );
        while context.ledger.unprotected().is_some() {
            tokio::time::sleep(PROTECTED_AGAIN).await;
        }
    }
    say("ROS Rescue enabled. Master is now fault tolerant!!");
    std::future::pending().await
}

/// Starts a task for each listener.
fn accept(
    listeners: Vec<TcpListener>,
    config: &Config,
    server: Server,
    connections: &TaskTracker,
    halt: &CancellationToken,
) -> JoinSet<()> {
    let permits = Arc::new(Semaphore::new(config.max_connections));
    let server = Arc::new(server);
    let mut tasks = JoinSet::new();
    for listener in listeners {
        tasks.spawn(boxed(listener::run(
            listener,
            server.clone(),
            permits.clone(),
            connections.clone(),
            halt.clone(),
        )));
    }
    tasks
}

/// Starts the tasks that look after the nodes, and after clients that bypass this rosrescue.
fn watch(config: &Config, context: &Context, tasks: &mut JoinSet<()>) {
    tasks.spawn(boxed(nodes::liveness::watch(context.nodes.clone())));
    tasks.spawn(boxed(nodes::addresses::watch(context.nodes.clone())));
    tasks.spawn(boxed(nodes::watch(context.nodes.clone())));
    if matches!(config.master, MasterConfig::External(_)) {
        tasks.spawn(boxed(bypass::watch(
            context.reach.upstream.clone(),
            context.board.clone(),
            config.advertised.to_string(),
        )));
    }
}

/// Whether this is the only computer that may have the master, or one of several.
enum Runs {
    /// This is the only computer. `None` if the master is external.
    Single(Option<Supervised>),
    /// One of several computers.
    Member(Box<ClusterDriver>),
}

impl Runs {
    /// Joins the other computers, if `config` names a cluster. Also returns the handle through which calls reach them.
    async fn choose(
        config: &Config,
        context: &Arc<Context>,
        supervised: Option<Supervised>,
        restored: bool,
        halt: &CancellationToken,
    ) -> Result<(Option<Others>, Self), RunError> {
        let (Some(cluster), Some(supervised)) = (&config.cluster, &supervised) else {
            if restored {
                // The mirror answers while masters that an earlier rosrescue left are still being looked for.
                context.ledger.shut_gate(State::StandingIn);
            }
            return Ok((None, Self::Single(supervised)));
        };
        let (others, member) = cluster::join(cluster::ClusterSetup {
            config: cluster.clone(),
            context: context.clone(),
            rosmaster: supervised.rosmaster.clone(),
            rosout: supervised.rosout,
            restore: config.restore,
            hold: config.hold,
            restored,
            hide: config.hide.clone(),
            halt: halt.clone(),
        })
        .await?;
        Ok((Some(others), Self::Member(Box::new(member))))
    }

    /// Finds the master of an earlier rosrescue, which was at `port`, and decides what to do first.
    async fn begin(
        self,
        context: &Context,
        port: Option<u16>,
        restored: bool,
        stop: &CancellationToken,
        halt: &CancellationToken,
    ) -> Begun {
        match self {
            Self::Single(supervised) => {
                let rosout = supervised.as_ref().map(|supervised| supervised.rosout);
                let rosmaster = supervised.map(|supervised| supervised.rosmaster);
                let ends = (stop.clone(), halt.clone());
                let (driver, first) = context
                    .start_single(rosmaster, port, rosout, restored, ends)
                    .await;
                Begun::Single(Box::new(driver), first)
            }
            Self::Member(member) => Begun::Member(member),
        }
    }
}

/// The running driver of the master.
enum Begun {
    /// The driver of a single computer, with its first steps.
    Single(Box<Driver>, Vec<Step>),
    Member(Box<ClusterDriver>),
}

impl Begun {
    /// Manages the master until rosrescue stops. Returns the master's process, if rosrescue started it and it still
    /// runs.
    async fn run(
        self,
        stop: CancellationToken,
        halt: CancellationToken,
    ) -> Result<Option<MasterProcess>, RunError> {
        let task = match self {
            Self::Single(driver, first) => {
                crate::task::spawn(async { driver.run(first, halt).await.map_err(RunError::from) })
            }
            Self::Member(member) => crate::task::spawn(member.run(stop)),
        };
        match task.await {
            Ok(ended) => ended,
            Err(panic) => std::panic::resume_unwind(panic.into_panic()),
        }
    }
}

/// Writes the closing checkpoint if the disk answers within [`DISK_PATIENCE`].
async fn close(ledger: Arc<Ledger>) {
    let has_store = ledger.seen_store().is_some();
    ledger.update_session(|session| session.closed = true);
    let closed = ledger.on_store_whole(|store, checkpoint| store.close(&checkpoint));
    match tokio::time::timeout(DISK_PATIENCE, closed).await {
        Ok(Some(Err(error))) => tracing::error!(
            %error,
            "stopped, but could not write the closing checkpoint; free space on the disk or repair it"
        ),
        Ok(Some(Ok(()))) => tracing::info!("stopped cleanly"),
        Ok(None) if !has_store => tracing::info!("stopped cleanly"),
        Ok(None) | Err(_) => tracing::error!(
            "stopped without a closing checkpoint: the disk has not answered for {DISK_PATIENCE:?}; repair the disk"
        ),
    }
}
