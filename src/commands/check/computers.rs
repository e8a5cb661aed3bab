//! Asks etcd about `--cluster`. Judges nothing.

use serde::Deserialize;

use crate::{
    cli::ClusterArgs,
    cluster::{
        etcd::{Access, Etcd, EtcdError, Options, Tls, Tried},
        journal::Keys,
        survey::LIMIT,
    },
    commands::running,
    config::{ClusterConfig, ClusterError},
    ros_env::MasterUri,
};

/// What the options of several computers lead to.
#[derive(Debug)]
pub(in crate::commands::check) struct Cluster {
    pub(super) robot: String,
    /// This computer's name and address.
    pub(super) name: String,
    pub(super) uri: String,
    /// Each endpoint.
    pub(super) tried: Vec<Tried>,
    /// Who leads the robot or led it last; none if etcd does not know the robot.
    pub(super) leader: Option<String>,
    /// Other robots in etcd, if this one is not.
    pub(super) others: Vec<String>,
    /// Where another computer with this one's name is.
    pub(super) namesake: Option<String>,
}

/// Why they lead nowhere.
#[derive(Debug, thiserror::Error)]
pub(in crate::commands::check) enum Unusable {
    #[error(transparent)]
    Options(#[from] ClusterError),
    #[error(transparent)]
    Etcd(#[from] EtcdError),
}

/// What is needed of an entry among the members.
#[derive(Deserialize)]
struct Entry {
    uri: String,
}

impl Cluster {
    /// None without `--cluster`. `usual`: where others reach this computer.
    pub(super) async fn look(
        args: &ClusterArgs,
        usual: &MasterUri,
        hostname: &str,
    ) -> Option<Result<Self, Unusable>> {
        match ClusterConfig::new(args, usual, hostname) {
            Ok(config) => Some(Self::ask(config?).await),
            Err(error) => Some(Err(error.into())),
        }
    }

    async fn ask(config: ClusterConfig) -> Result<Self, Unusable> {
        let client = Etcd::new(&Options {
            endpoints: config.endpoints,
            access: Access {
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

/// The address that the entry of `name` among the members has, if it is another computer's.
async fn namesake_of(client: &Etcd, keys: &Keys, name: &str, own: &MasterUri) -> Option<String> {
    let key = keys.member(name);
    let found = client
        .range(&(key.clone()..format!("{key}\0")), LIMIT)
        .await;
    let found = found.ok()?.kvs.pop()?;
    let Entry { uri } = serde_json::from_slice(&found.value).ok()?;
    let at = MasterUri::parse(&uri).ok()?;
    (at != *own && !running::is_here(&at).await).then_some(uri)
}
