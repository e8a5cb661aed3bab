//! A computer begins to take part.

use std::{
    collections::VecDeque,
    net::IpAddr,
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use hyper::header::HeaderValue;
use tokio::{
    sync::{mpsc, watch},
    task::{JoinSet, block_in_place},
};
use tokio_util::sync::CancellationToken;

use super::{Background, CutOff, Known, Member, Outgoing};
use crate::{
    app::{duty::Context, startup},
    checkpoint::session::Restore,
    cluster::{
        etcd::{Access, Etcd, EtcdError, Options, Tls},
        journal::{Keys, Progress},
        machine::{ANSWER_LIMIT, Commit, Machine, Settings, View, WhenAlone},
        replica::Replica,
        way::{Place, Way},
    },
    config::{ClusterConfig, ClusterSync, WhenCutOff},
    hide::Hide,
    master::Master,
    process::Rosmaster,
    server::others::{Forwarded, Others},
    upstream::peer::Peers,
};

/// It is best to know what was before one claims; but not for longer.
const START_BY: Duration = Duration::from_secs(2);

/// What a computer among several is given.
pub(in crate::app) struct Given {
    pub(in crate::app) config: ClusterConfig,
    pub(in crate::app) context: Arc<Context>,
    pub(in crate::app) rosmaster: Rosmaster,
    pub(in crate::app) rosout: bool,
    /// Identifies this process.
    pub(in crate::app) instance: HeaderValue,
    pub(in crate::app) restore: Restore,
    /// How long a call waits that nobody can answer.
    pub(in crate::app) hold: Duration,
    /// Whether the mirror is from a checkpoint whose session continues.
    pub(in crate::app) restored: bool,
    /// Which values of parameters the log does not show.
    pub(in crate::app) hide: Hide,
    /// Cancelled when calls are no longer taken.
    pub(in crate::app) halt: CancellationToken,
}

/// Where the other computers are asked, and the task to run.
pub(in crate::app) async fn join(given: Given) -> Result<(Others, Member), EtcdError> {
    let config = &given.config;
    let client = Etcd::new(&Options {
        endpoints: config.endpoints.clone(),
        access: Access {
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
        id: startup::kernel_id("/proc/sys/kernel/random/uuid"),
        uri: config.advertised.to_string(),
        boot: match config.advertised.host.parse::<IpAddr>() {
            Ok(_) => String::new(),
            Err(_) => startup::kernel_id("/proc/sys/kernel/random/boot_id"),
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
    let context = &given.context;
    context.ledger.leave();
    // One that an earlier process left may hold what others have changed since.
    block_in_place(|| given.rosmaster.claim_orphan(None));
    let known = given.restored;
    let (way, way_rx) = watch::channel(Way::Nobody { known });
    let (handovers_tx, handovers) = mpsc::channel(1);
    let followed = watch::Sender::new(Place::default());
    let forwarded = Arc::<Forwarded>::default();
    let peers = Arc::new(Peers::new(given.instance.clone(), context.probe_timeout));
    let others = Others {
        way: way_rx,
        peers: peers.clone(),
        handovers: handovers_tx,
        passing: Arc::default(),
        forwarded: forwarded.clone(),
        served: given.context.served.clone(),
        followed: followed.subscribe(),
        // A restored mirror may be old: it shows nothing before etcd's journal has been read.
        told: Arc::new(Mutex::new(Place {
            term: 0,
            seq: given.restored.into(),
        })),
        // The next leader needs the time to live, and etcd may have to choose a leader of its own before.
        hold: given.hold.max(2 * config.ttl),
    };
    let cut_off = CutOff::left(&context.checkpoint, given.restored).await;
    let member = Member {
        machine: Machine::new(settings.clone()),
        replica: Replica {
            client,
            keys: Keys::new(&config.robot),
            limit: ANSWER_LIMIT,
        },
        known: Known::new(&settings),
        trouble: Arc::default(),
        background: Background::default(),
        settings,
        given,
        leads: watch::Sender::new(Way::Nobody { known }),
        way,
        peers,
        forwarded,
        followed,
        handovers,
        inbox: VecDeque::new(),
        start_by: Some(Instant::now() + START_BY),
        requests: JoinSet::new(),
        view: View::default(),
        watch: None,
        loading: None,
        load_at: Some(Instant::now()),
        loaded: false,
        wanted: None,
        reported: 0,
        held: Master::default(),
        displaced: Default::default(),
        progress: Progress::default(),
        outgoing: Outgoing::default(),
        duty: None,
        endings: JoinSet::new(),
        cut_off,
        merging: None,
        ours: false,
        before: None,
        was_released: false,
        led: false,
        namesake: None,
        namesakes: None,
        deciding: None,
        probe: None,
        probe_at: None,
        released: None,
        release_by: None,
        ending_roscore: None,
    };
    Ok((others, member))
}
