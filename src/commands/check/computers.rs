//! Asks etcd for the facts about `--cluster`.

use rescue_core::cluster::journal::Keys;
use serde::Deserialize;

use crate::{
    cli::ClusterArgs,
    cluster::{
        etcd::{Credentials, Etcd, EtcdError, Options, Tls, Tried},
        survey::LIMIT,
    },
    commands::running,
    config::{ClusterConfig, ClusterError},
    ros_env::MasterUri,
};

/// What etcd says about the robot and this computer.
#[derive(Debug)]
pub(in crate::commands::check) struct Cluster {
    pub(super) robot: String,
    /// This computer's name and address.
    pub(super) name: String,
    pub(super) uri: String,
    /// How each etcd server answered.
    pub(super) tried: Vec<Tried>,
    /// The present or last leader. `None` if etcd does not know the robot.
    pub(super) leader: Option<String>,
    /// The robots in etcd, if this robot is not among them.
    pub(super) others: Vec<String>,
    /// Address of another computer that has this computer's name.
    pub(super) namesake: Option<String>,
}

/// Why the cluster options cannot be used.
#[derive(Debug, thiserror::Error)]
pub(in crate::commands::check) enum Unusable {
    #[error(transparent)]
    Options(#[from] ClusterError),
    #[error(transparent)]
    Etcd(#[from] EtcdError),
}

/// The part of a computer's entry in etcd that the check needs.
#[derive(Deserialize)]
struct MemberEntry {
    uri: String,
}

impl Cluster {
    /// Gathers the facts. `None` without `--cluster`. `usual` is the address where other computers reach this one by
    /// default.
    pub(super) async fn gather(
        args: &ClusterArgs,
        usual: &MasterUri,
        hostname: &str,
    ) -> Option<Result<Self, Unusable>> {
        match ClusterConfig::new(args, usual, hostname) {
            Ok(config) => Some(Self::read_etcd(config?).await),
            Err(error) => Some(Err(error.into())),
        }
    }

    async fn read_etcd(config: ClusterConfig) -> Result<Self, Unusable> {
        let client = Etcd::new(&Options {
            endpoints: config.endpoints,
            access: Credentials {
                tls: Tls {
                    ca: config.ca,
                    cert: config.cert,
                    key: config.key,
                },
                user: config.user,
            },
        })?;
        let keys = Keys::new(&config.robot);
        let tried = client.try_each(&keys, LIMIT).await;
        let (mut leader, mut others, mut namesake) = (None, Vec::new(), None);
        if tried.iter().any(|one| one.cluster.is_ok()) {
            let view = client.view(&keys, LIMIT).await;
            leader = view.as_ref().ok().and_then(|view| view.leader.clone());
            if view.is_ok() && leader.is_none() {
                others = client.robots(LIMIT).await.unwrap_or_default();
            }
            namesake = namesake_of(&client, &keys, &config.name, &config.advertised).await;
        }
        Ok(Self {
            robot: config.robot,
            name: config.name,
            uri: config.advertised.to_string(),
            tried,
            leader: leader.map(|leader| leader.name),
            others,
            namesake,
        })
    }
}

/// The address of another computer that is registered under `name`.
async fn namesake_of(client: &Etcd, keys: &Keys, name: &str, own: &MasterUri) -> Option<String> {
    let key = keys.member(name);
    let found = client
        .range(&(key.clone()..format!("{key}\0")), LIMIT)
        .await;
    let found = found.ok()?.kvs.pop()?;
    let MemberEntry { uri } = serde_json::from_slice(&found.value).ok()?;
    let at = MasterUri::parse(&uri).ok()?;
    (at != *own && !running::is_here(&at).await).then_some(uri)
}
