//! Creates what all tasks of this process share, from the settings and the state at the start.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use checkpoint_store::history;
use rescue_core::lifecycle::{Patience, Supervision};
use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;

use super::{context::Context, startup::Beginning};
use crate::{
    clock,
    config::{Config, MasterConfig},
    guardian::handover,
    ledger::Ledger,
    nodes::{Nodes, local::LocalNodes, served::Served},
    recovery::{live_master::Reach, report_file},
    ros_env::MasterUri,
    server::{
        Server,
        access::AccessRules,
        answers::AnswerMemory,
        body,
        calls::Calls,
        clients::Clients,
        idle::Idle,
        others::Others,
        pages::{Pages, status::Rate},
    },
    status::{Board, Earlier, Mode, stats::Stats},
    upstream::{Upstream, pool::Pool},
    wait,
    write_queue::{self, Drain, Link},
};

/// How long a start waits for the reports of earlier rescues. Calls wait during this time.
const REPORTS: Duration = Duration::from_secs(1);

/// Where the last master of the session was. `None` if it was at rosrescue's own port, where no master can be.
pub(super) fn last_master(config: &Config, beginning: &Beginning) -> Option<MasterUri> {
    let uri = beginning.session.master_uri.as_deref()?;
    let uri = MasterUri::parse(uri).ok()?;
    (uri.port != config.advertised.port).then_some(uri)
}

/// Creates what the tasks of this process share, and the task that carries writes to the master.
/// `last` is where the last master was.
pub(super) async fn assemble(
    config: &Config,
    beginning: Beginning,
    last: Option<MasterUri>,
) -> (Context, Drain) {
    let address = match (&config.master, last) {
        (MasterConfig::External(address), _) => address.clone(),
        (_, Some(last)) => last,
        // A placeholder until there is a master.
        (_, None) => MasterUri {
            host: "127.0.0.1".to_owned(),
            port: 0,
        },
    };
    let (mode, supervision) = match config.master {
        MasterConfig::Supervised(_) => (Mode::Core, Supervision::Ours),
        MasterConfig::External(_) => (Mode::Proxy, Supervision::Theirs),
    };
    let earlier = earlier(&beginning).await;
    let removed: Vec<_> = (earlier.reports.iter())
        .flat_map(|report| {
            let at = clock::moment_of(report.detected_at);
            report.removed.iter().map(move |node| (node.clone(), at))
        })
        .collect();
    let board = Arc::new(Board::new(mode));
    board.update(|facts| facts.go_on(earlier));
    // The statistics live as long as the process.
    let stats: &'static Stats = Box::leak(Box::default());
    let uri = config.advertised.to_string();
    let ledger = Arc::new(ledger(config, beginning, &uri, stats));
    let upstream = Upstream::new(address, config.probe_timeout, config.probing.count);
    let upstream = Arc::new(upstream.with_socket_timeout(config.master.socket_timeout()));
    let local = Arc::new(LocalNodes::new(config.reap, stats));
    let (write_queue, drain) = write_queue::write_queue(
        Link {
            ledger: ledger.clone(),
            upstream: upstream.clone(),
        },
        stats,
        config.resync_interval,
        local.clone(),
        config.writes,
        Patience::new(config.stand_in_after),
    );
    let served = Served::default();
    let nodes = Arc::new(Nodes::new(
        ledger.clone(),
        write_queue.clone(),
        stats,
        config.node_timeout,
        served.clone(),
        local,
    ));
    for (node, at) in removed {
        nodes.removed.add(&node, at);
    }
    let context = Context {
        gate: ledger.gate(),
        ledger,
        reach: Reach {
            upstream,
            supervision,
            probing: config.probing,
            probe_timeout: config.probe_timeout,
            renewal: config.master.renewal(),
        },
        write_queue,
        nodes,
        served,
        board,
        stats,
        history: config.checkpoint_bytes(),
        uri,
        checkpoint: config.checkpoint.clone(),
        node_timeout: config.node_timeout,
    };
    (context, drain)
}

/// Reads the reports of rescues that earlier processes of this session left on the disk.
async fn earlier(beginning: &Beginning) -> Earlier {
    let mut earlier = match &beginning.store {
        Some(store) => {
            let (path, id) = (store.path().to_owned(), beginning.session.id.clone());
            let died = beginning.died;
            let read = move || report_file::earlier(&path, &id, died, history::last_rescue(&path));
            wait::within(REPORTS, read).await.unwrap_or_default()
        }
        None => Earlier::default(),
    };
    earlier.worker_restarts = earlier.worker_restarts.max(handover::restarts());
    earlier
}

fn ledger(config: &Config, beginning: Beginning, uri: &str, stats: &'static Stats) -> Ledger {
    let ledger = Ledger::new(
        beginning.mirror,
        beginning.session,
        beginning.pending,
        beginning.store,
        config.sync,
        stats,
    );
    // In a cluster each leader starts a new master, which cannot be newer than the mirror.
    if beginning.restored && config.cluster.is_none() {
        ledger.set_unconfirmed();
        ledger.with_activity(|_, activity| activity.restore_displaced(beginning.displaced));
    }
    let pid = i32::try_from(std::process::id()).unwrap_or(-1);
    ledger.set_identity(pid, uri.to_owned());
    ledger
}

/// Creates the server for the clients' requests, who reach it under the host `names`. The server notifies the first of `ends` when one of our own requests
/// to the master comes back. The second of `ends` ends the streams of the status page.
pub(super) fn server(
    config: &Config,
    context: &Context,
    names: Vec<String>,
    others: Option<Others>,
    ends: (Arc<Notify>, CancellationToken),
) -> Server {
    let (looped, halt) = ends;
    let clients = Arc::new(Clients::default());
    let pool = Pool::new(
        config.master_connections,
        context.reach.upstream.clone(),
        context.ledger.clone(),
    );
    let access = AccessRules::new(config.allow.clone(), config.allow_write.clone());
    if !config.allow.is_empty() || !config.allow_write.is_empty() {
        tracing::info!("{access}");
    }
    Server {
        names,
        access,
        refused: Default::default(),
        looped,
        clients: clients.clone(),
        idle: Idle::among(config.max_connections),
        max_body: config.max_body,
        bodies: body::budget(config.max_body),
        answers: AnswerMemory::within(2 * config.max_body),
        stats: context.stats,
        calls: Calls {
            gate: context.gate.clone(),
            ledger: context.ledger.clone(),
            reads: config.reads,
            last_large: Default::default(),
            compared: Default::default(),
            pool: Arc::new(pool),
            write_queue: context.write_queue.clone(),
            stats: context.stats,
            uri: context.uri.clone(),
            hold: config.hold,
            others,
        },
        pages: Pages {
            uri: context.uri.clone(),
            checkpoint: config.checkpoint.display().to_string(),
            upstream: context.reach.upstream.clone(),
            gate: context.gate.clone(),
            ledger: context.ledger.clone(),
            nodes: context.nodes.clone(),
            board: context.board.clone(),
            clients,
            stats: context.stats,
            rate: Rate::new(Instant::now()),
            hide: config.hide.clone(),
            stop: halt,
            state: Default::default(),
        },
    }
}
