//! Several computers: `--cluster`.

use std::sync::Arc;

use super::{
    super::super::{
        Severity::{Problem, Warning},
        computers::{Cluster, Unusable},
        facts::SetupFacts,
    },
    findings_of, one,
};
use crate::{
    cluster::etcd::{EtcdError, Tried},
    config::ClusterError,
};

/// A cluster of three computers without problems.
fn cluster() -> Cluster {
    let endpoints = ["http://a:2379", "http://b:2379", "http://c:2379"];
    Cluster {
        robot: "r".to_owned(),
        name: "arm-10.0.0.7".to_owned(),
        uri: "http://10.0.0.7:11311/".to_owned(),
        tried: endpoints
            .map(|endpoint| Tried {
                endpoint: endpoint.to_owned(),
                cluster: Ok(1),
            })
            .into(),
        leader: Some("base-10.0.0.1".to_owned()),
        others: Vec::new(),
        namesake: None,
    }
}

fn given(facts: &mut SetupFacts, spoil: impl FnOnce(&mut Cluster)) {
    let mut cluster = cluster();
    spoil(&mut cluster);
    facts.cluster = Some(Arc::new(Ok(cluster)));
}

fn peer_port(endpoint: &str) -> Result<u64, EtcdError> {
    Err(EtcdError::PeerPort {
        endpoint: endpoint.to_owned(),
    })
}

#[test]
fn a_cluster_without_problems_has_no_findings() {
    assert_eq!(findings_of(|facts| given(facts, |_| {})), []);
}

#[test]
fn a_wrong_endpoint_is_a_warning_while_a_majority_answers_and_a_problem_otherwise() {
    one(
        Warning,
        "--cluster",
        "http://b:2380 is etcd's port for its peers",
        |facts| {
            given(facts, |of| of.tried[1].cluster = peer_port("http://b:2380"));
        },
    );
    let found = findings_of(|facts| {
        given(facts, |of| {
            for tried in of.tried.iter_mut().skip(1) {
                tried.cluster = peer_port(&tried.endpoint);
            }
        });
    });
    assert_eq!(found.len(), 2, "{found:?}");
    assert!(found.iter().all(|of| of.severity == Problem), "{found:?}");
}

#[test]
fn a_robot_that_etcd_does_not_know_while_it_knows_another_one() {
    let unknown = |facts: &mut SetupFacts, others: &[&str]| {
        given(facts, |of| {
            of.leader = None;
            of.others = others.iter().map(|other| (*other).to_owned()).collect();
        });
    };
    one(
        Warning,
        "--cluster",
        "no robot `r` yet, but it has `robot-7`",
        |facts| {
            unknown(facts, &["robot-7"]);
        },
    );
    assert_eq!(findings_of(|facts| unknown(facts, &[])), []);
}

#[test]
fn a_computer_with_the_same_name_and_options_that_do_not_fit() {
    one(
        Problem,
        "--cluster-name",
        "http://10.0.0.9:11311/",
        |facts| {
            given(facts, |of| {
                of.namesake = Some("http://10.0.0.9:11311/".to_owned())
            });
        },
    );
    one(Problem, "--cluster", "set ROS_IP", |facts| {
        let error = ClusterError::Loopback {
            address: "127.0.0.1".to_owned(),
            endpoint: "http://a:2379".to_owned(),
        };
        facts.cluster = Some(Arc::new(Err(Unusable::Options(error))));
    });
}
