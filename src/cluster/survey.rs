//! Judges the endpoints and the robot's name in `--cluster`. [`Etcd::try_each`](super::etcd::Etcd::try_each) and
//! [`Etcd::robots`](super::etcd::Etcd::robots) gather the facts.

use std::time::Duration;

use super::etcd::{EtcdError, Tried};
use crate::cli::cluster_args::ROBOT;

/// How long an endpoint may take to answer.
pub const LIMIT: Duration = Duration::from_secs(3);

/// One problem with `--cluster`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Complaint {
    pub what: String,
    /// How to correct the problem.
    pub todo: String,
    /// Whether the problem may pass by itself: an etcd that does not answer may be starting.
    pub may_pass: bool,
}

/// The problems of the endpoints.
pub fn complaints(tried: &[Tried]) -> Vec<Complaint> {
    let failed = tried.iter().filter_map(|one| {
        let error = one.cluster.as_ref().err()?;
        Some(complaint(&one.endpoint, error))
    });
    let mut found: Vec<_> = failed.collect();
    let mut good = tried.iter().filter_map(|one| {
        let cluster = one.cluster.as_ref().ok()?;
        Some((&one.endpoint, *cluster))
    });
    if let Some((first, cluster)) = good.next()
        && let Some((other, _)) = good.find(|(_, other)| *other != cluster)
    {
        found.push(Complaint {
            what: format!("{first} and {other} belong to two different etcd clusters"),
            todo: "name the members of one cluster in --cluster; on Debian, etcd starts as a cluster of its own \
                   until it is set up (docs/several-computers.md)"
                .to_owned(),
            may_pass: false,
        });
    }
    found
}

fn complaint(endpoint: &str, error: &EtcdError) -> Complaint {
    let (what, todo) = match error {
        EtcdError::PeerPort { .. } => (
            error.to_string(),
            "write the port for clients in --cluster, usually 2379",
        ),
        EtcdError::Connect { .. } => (
            error.to_string(),
            "check this address in --cluster, and that etcd runs there",
        ),
        EtcdError::Silent { .. } | EtcdError::Lost { .. } => (
            format!("{endpoint} does not answer as etcd does: {error}"),
            "check this address in --cluster, and that etcd runs there",
        ),
        EtcdError::NotEtcd { .. } => (
            error.to_string(),
            "check host and port of this address in --cluster: etcd serves clients at 2379",
        ),
        // These errors say what to do.
        _ => (
            format!("{endpoint}: {error}"),
            "correct this, then restart rosrescue",
        ),
    };
    Complaint {
        what,
        todo: todo.to_owned(),
        may_pass: matches!(
            error,
            EtcdError::Connect { .. } | EtcdError::Silent { .. } | EtcdError::Lost { .. }
        ),
    }
}

/// Warns if `robot` has no keys in etcd although the robots `others` have: its name may be misspelt.
pub fn typo(robot: &str, others: &[String]) -> Option<Complaint> {
    if others.is_empty() || others.iter().any(|other| other == robot) {
        return None;
    }
    let names: Vec<_> = others.iter().map(|name| format!("`{name}`")).collect();
    let default = match robot == ROBOT {
        true => " (the name if --cluster gives none)",
        false => "",
    };
    Some(Complaint {
        what: format!(
            "etcd has no robot `{robot}`{default} yet, but it has {}",
            names.join(", ")
        ),
        todo:
            "check for a typo in the robot's name, which is after the last address in --cluster: it is the same on \
             all computers of a robot"
                .to_owned(),
        may_pass: false,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tried(endpoint: &str, cluster: Result<u64, EtcdError>) -> Tried {
        Tried {
            endpoint: endpoint.to_owned(),
            cluster,
        }
    }

    fn one(error: EtcdError) -> Complaint {
        let found = complaints(&[
            tried("http://a:2379", Ok(1)),
            tried("http://b:2380", Err(error)),
            tried("http://c:2379", Ok(1)),
        ]);
        let [complaint] = <[Complaint; 1]>::try_from(found).expect("one complaint");
        complaint
    }

    #[test]
    fn a_wrong_endpoint_is_named_with_what_to_do_while_the_others_work() {
        let endpoint = "http://b:2380".to_owned();
        let peer = one(EtcdError::PeerPort {
            endpoint: endpoint.clone(),
        });
        assert!(
            peer.what
                .contains("http://b:2380 is etcd's port for its peers")
        );
        assert!(peer.todo.contains("2379") && !peer.may_pass, "{peer:?}");
        let unknown = one(EtcdError::Connect {
            endpoint,
            why: "Name or service not known".to_owned(),
        });
        assert!(
            unknown
                .what
                .contains("http://b:2380: Name or service not known")
        );
        assert!(unknown.todo.contains("--cluster") && unknown.may_pass);
        let silent = one(EtcdError::Silent { limit: LIMIT });
        assert!(
            silent.what.contains("http://b:2380") && silent.may_pass,
            "{silent:?}"
        );
        let access = one(EtcdError::Full);
        assert!(access.what.starts_with("http://b:2380: "), "{access:?}");
    }

    #[test]
    fn endpoints_of_two_clusters_are_named() {
        let all = |last| {
            complaints(&[
                tried("http://a:2379", Ok(1)),
                tried("http://b:2379", Ok(1)),
                tried("http://c:2379", Ok(last)),
            ])
        };
        assert_eq!(all(1), []);
        let found = all(2);
        assert!(
            found[0]
                .what
                .contains("http://a:2379 and http://c:2379 belong to two different"),
            "{found:?}"
        );
    }

    #[test]
    fn a_robot_that_is_not_in_etcd_may_be_a_typo_if_another_one_is() {
        assert_eq!(typo("arm", &[]), None);
        assert_eq!(typo("arm", &["arm".to_owned(), "leg".to_owned()]), None);
        let said = typo("amr", &["arm".to_owned()]).unwrap();
        assert_eq!(said.what, "etcd has no robot `amr` yet, but it has `arm`");
        assert!(said.todo.contains("typo"), "{said:?}");
        let left_out = typo(ROBOT, &["arm".to_owned()]).unwrap();
        assert!(
            left_out.what.contains("if --cluster gives none"),
            "{left_out:?}"
        );
    }
}
