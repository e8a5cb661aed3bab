//! Warns at the start about mistakes in `--cluster`, even if the cluster works.

use std::time::Duration;

use crate::cluster::{
    replica::Replica,
    survey::{self, Complaint, LIMIT},
};

/// An etcd that does not answer gets a second attempt after this time, because it may be starting. Then rosrescue
/// warns.
const SECOND_LOOK: Duration = Duration::from_secs(5);

/// Tries each endpoint separately.
pub(super) async fn try_endpoints(replica: Replica) {
    let Replica { client, keys, .. } = replica;
    let found = survey::complaints(&client.try_each(&keys, LIMIT).await);
    let (may_pass, certain): (Vec<_>, Vec<_>) = found.into_iter().partition(|of| of.may_pass);
    certain.iter().for_each(warn);
    if !may_pass.is_empty() {
        tokio::time::sleep(SECOND_LOOK).await;
        let mut found = survey::complaints(&client.try_each(&keys, LIMIT).await);
        found.retain(|of| !certain.contains(of));
        found.iter().for_each(warn);
    }
}

/// Warns if `robot`, a name without keys in etcd, may be a typo of another robot's name.
pub(super) async fn warn_of_typo(replica: Replica, robot: String) {
    // By now etcd may have keys of this robot.
    if let Ok(mut robots) = replica.client.robots(LIMIT).await {
        robots.retain(|other| *other != robot);
        survey::typo(&robot, &robots).iter().for_each(warn);
    }
}

fn warn(complaint: &Complaint) {
    let Complaint { what, todo, .. } = complaint;
    tracing::warn!(what, todo, "check --cluster");
}
