//! Programs that use another master.

use super::{
    super::super::{Severity::Warning, facts::UpstreamMaster},
    one, process,
};
use crate::ros_env::MasterUri;

#[test]
fn nodes_of_another_master_are_found() {
    one(
        Warning,
        "ROS_MASTER_URI",
        "48 processes were started with ROS_MASTER_URI=http://other:11311: node (process 1, port 40001), ",
        |facts| {
            facts.strays = (1..49)
                .map(|number| {
                    let process = process(number, "node", 40_000 + u16::try_from(number).unwrap());
                    (process, "http://other:11311".to_owned())
                })
                .collect();
        },
    );
    one(
        Warning,
        "ROS_MASTER_URI",
        "camera (process 9, port 40000) was started with ROS_MASTER_URI=http://other:11311",
        |facts| {
            facts.strays = vec![(
                process(9, "camera", 40_000),
                "http://other:11311".to_owned(),
            )];
        },
    );
}

#[test]
fn clients_that_bypass_rosrescue_are_reported() {
    let behind = |bypassing: &[&str], is_open| {
        Some(UpstreamMaster {
            uri: MasterUri::parse("http://robot:11312").unwrap(),
            bypassing: bypassing.iter().map(|&who| who.to_owned()).collect(),
            is_open,
        })
    };
    one(
        Warning,
        "unprotected",
        "rosout (process 9) talks directly to the master at http://robot:11312/",
        |facts| facts.behind = behind(&["rosout (process 9)"], false),
    );
    one(
        Warning,
        "unprotected",
        "accepts connections from other computers",
        |facts| facts.behind = behind(&[], true),
    );
    one(
        Warning,
        "unprotected",
        "camera (process 9, port 40000) was started with ROS_MASTER_URI=http://localhost:11312, the master behind",
        |facts| {
            facts.behind = behind(&[], false);
            facts.strays = vec![(
                process(9, "camera", 40_000),
                "http://localhost:11312".to_owned(),
            )];
        },
    );
}
