//! Judges programs that use another master than rosrescue.

use std::collections::BTreeMap;

use super::{
    super::facts::{Process, SetupFacts},
    Findings, named,
    todo::own_uri,
};
use crate::{ros_env, status::summary::shortened};

/// Subject of findings about clients that bypass rosrescue.
const BYPASS: &str = "unprotected";

impl Findings {
    /// Reports running nodes of other masters.
    pub(super) fn strays(&mut self, facts: &SetupFacts) {
        let mut by_uri: BTreeMap<&str, Vec<&Process>> = BTreeMap::new();
        for (process, uri) in &facts.strays {
            by_uri.entry(uri).or_default().push(process);
        }
        for (uri, processes) in by_uri {
            let port = ros_env::MasterUri::parse(uri).ok().map(|uri| uri.port);
            let names: Vec<_> = processes.iter().map(|process| named(process)).collect();
            let started = match names.as_slice() {
                [one] => format!("{one} was"),
                all => format!("{} processes were", all.len()),
            };
            let list = match names.as_slice() {
                [_] => String::new(),
                all => format!(": {}", shortened(all)),
            };
            let pids: Vec<_> = processes.iter().map(|it| it.pid.to_string()).collect();
            let again = format!(
                "`kill {}`, and start them again after `export ROS_MASTER_URI={}`",
                pids.join(" "),
                own_uri(facts)
            );
            let what = format!("{started} started with ROS_MASTER_URI={uri}");
            if facts.behind.as_ref().map(|behind| behind.uri.port) == port && port.is_some() {
                let what = format!("{what}, the master behind rosrescue{list}");
                self.warn(
                    BYPASS,
                    what,
                    format!("their changes are not recorded: {again}"),
                );
            } else {
                let what = format!("{what}{list}");
                self.warn(
                    "ROS_MASTER_URI",
                    what,
                    format!("if they are nodes of this robot, {again}"),
                );
            }
        }
    }

    /// Reports clients that talk directly to the master behind a `proxy`.
    pub(super) fn bypass(&mut self, facts: &SetupFacts) {
        let Some(behind) = &facts.behind else { return };
        let uri = &behind.uri;
        let talks = match behind.bypassing.as_slice() {
            [] => None,
            [one] => Some(format!("{one} talks directly to the master at {uri}")),
            all => Some(format!(
                "{} clients talk directly to the master at {uri}: {}",
                all.len(),
                shortened(all)
            )),
        };
        if let Some(talks) = talks {
            let todo = format!(
                "their changes are not recorded: start them again after `export ROS_MASTER_URI={}`",
                own_uri(facts)
            );
            self.warn(BYPASS, talks, todo);
        }
        if behind.is_open {
            self.warn(
                BYPASS,
                format!(
                    "the master at {uri} accepts connections from other computers, which can bypass rosrescue"
                ),
                format!(
                    "start it with `env -u ROS_HOSTNAME -u ROS_IPV6 ROS_IP=127.0.0.1 rosmaster --core -p {}`",
                    uri.port
                ),
            );
        }
    }
}
