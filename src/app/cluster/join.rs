//! Creates what this process needs to run as one of several computers.

use std::{collections::VecDeque, net::IpAddr, sync::Arc, time::Duration};

use rescue_core::{
    checkpoint::session::RestorePolicy,
    cluster::{
        journal::Keys,
        machine::{ANSWER_LIMIT, Commit, Settings, View, WhenAlone},
        member::{LocalCheckpoint, Member},
        standing::{JournalPosition, Standing},
    },
    hide::Hide,
};
use tokio::{
    sync::{mpsc, watch},
    task::{JoinSet, block_in_place},
};
use tokio_util::sync::CancellationToken;

use super::{ClusterDriver, facts::ComputerFacts, partition_writes::PartitionWritesFile};
use crate::{
    app::context::Context,
    cluster::{
        etcd::{Credentials, Etcd, EtcdError, Options, Tls},
        replica::Replica,
    },
    config::{ClusterConfig, ClusterSync, WhenCutOff},
    process::{self, Rosmaster},
    server::others::{Forwarded, MemberAddresses, Others, Shown},
    upstream::peer::Peers,
};

/// What this process needs to run as one of several computers.
pub(in crate::app) struct ClusterSetup {
    pub(in crate::app) config: ClusterConfig,
    pub(in crate::app) context: Arc<Context>,
    pub(in crate::app) rosmaster: Rosmaster,
    pub(in crate::app) rosout: bool,
    pub(in crate::app) restore: RestorePolicy,
    /// How long a call waits while nothing can answer it (`--hold`).
    pub(in crate::app) hold: Duration,
    /// Whether the mirror is from a checkpoint whose session continues.
    pub(in crate::app) restored: bool,
    /// The parameters whose values are hidden.
    pub(in crate::app) hide: Hide,
    /// Cancelled when calls are no longer taken.
    pub(in crate::app) halt: CancellationToken,
}

/// Creates the handle through which calls reach the other computers, and the driver to run.
pub(in crate::app) async fn join(
    setup: ClusterSetup,
) -> Result<(Others, ClusterDriver), EtcdError> {
    let config = &setup.config;
    let client = Etcd::new(&Options {
        endpoints: config.endpoints.clone(),
        access: Credentials {
            tls: Tls {
                ca: config.ca.clone(),
                cert: config.cert.clone(),
                key: config.key.clone(),
            },
            user: config.user.clone(),
        },
    })?;
    let settings = Settings {
        name: config.name.clone(),
        id: process::new_id(),
        uri: config.advertised.to_string(),
        boot: match config.advertised.host.parse::<IpAddr>() {
            Ok(_) => String::new(),
            Err(_) => process::boot_id(),
        },
        version: env!("CARGO_PKG_VERSION").to_owned(),
        ttl: config.ttl,
        commit: match config.sync {
            ClusterSync::Always => Commit::Always,
            ClusterSync::Interval => Commit::Interval,
        },
        alone: match config.alone {
            WhenCutOff::Serve => WhenAlone::Serve,
            WhenCutOff::Refuse => WhenAlone::Refuse,
        },
    };
    let context = &setup.context;
    context.ledger.leave();
    // A master left by an earlier process may have outdated state.
    let writable = context.ledger.seen_store().is_some();
    block_in_place(|| setup.rosmaster.kill_orphans(writable));
    let known = setup.restored;
    let (standing, standing_rx) = watch::channel(Standing::NoLeader { known });
    let (handovers_tx, handovers) = mpsc::channel(1);
    let position = watch::Sender::new(JournalPosition::default());
    let shown = Arc::new(Shown::new());
    let forwarded = Arc::<Forwarded>::default();
    let peers = Arc::new(Peers::new(context.reach.probe_timeout));
    let members = MemberAddresses::default();
    let others = Others {
        standing: standing_rx,
        peers: peers.clone(),
        handovers: handovers_tx,
        passing: Arc::default(),
        forwarded: forwarded.clone(),
        served: setup.context.served.clone(),
        members: members.clone(),
        followed: position.subscribe(),
        shown: shown.clone(),
        // A call may have to wait for the next leader. That takes the time to live, and longer if etcd must elect its
        // own leader first.
        hold: setup.hold.max(2 * config.ttl),
    };
    let (partition_writes, left) =
        PartitionWritesFile::load(&context.checkpoint, setup.restored).await;
    let session = context.ledger.session();
    let own = LocalCheckpoint {
        state: context.ledger.with_mirror(Clone::clone),
        restored: setup.restored,
        term: session.term,
        journal_number: session.cluster_journal,
        seq: session.cluster_seq,
    };
    let keys = Keys::new(&config.robot);
    let id = settings.id.clone();
    let driver = ClusterDriver {
        facts: ComputerFacts::new(&settings, members),
        member: Member::new(settings, keys.clone(), own, left, id),
        replica: Replica {
            client,
            keys,
            limit: ANSWER_LIMIT,
        },
        setup,
        standing,
        position,
        shown,
        peers,
        forwarded,
        handovers,
        handover: None,
        inbox: VecDeque::new(),
        work: JoinSet::new(),
        beside: JoinSet::new(),
        watch: None,
        watched: View::default(),
        duties: None,
        endings: JoinSet::new(),
        partition_writes,
        trouble: Arc::default(),
    };
    Ok((others, driver))
}
