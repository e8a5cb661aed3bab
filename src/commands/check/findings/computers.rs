//! Judges `--cluster`: its options, and what etcd says.

use super::{
    super::{computers::Cluster, facts::SetupFacts},
    Findings,
};
use crate::cluster::survey;

const CLUSTER: &str = "--cluster";

impl Findings {
    pub(super) fn cluster(&mut self, facts: &SetupFacts) {
        let cluster = match facts.cluster.as_deref() {
            None => return,
            Some(Ok(cluster)) => cluster,
            Some(Err(error)) => {
                let todo = "with these options, core does not start: `rosrescue core --help` explains them";
                return self.bad(CLUSTER, error.to_string(), todo);
            }
        };
        let all = cluster.tried.len();
        let good = cluster.tried.iter().filter(|one| one.cluster.is_ok());
        let good = good.count();
        for complaint in survey::complaints(&cluster.tried) {
            match good * 2 > all {
                true => self.warn(CLUSTER, complaint.what, complaint.todo),
                false => self.bad(CLUSTER, complaint.what, complaint.todo),
            }
        }
        if good == all {
            self.ok(CLUSTER, format!("all {all} members of etcd answer"));
        }
        self.robot(cluster);
        if let Some(uri) = &cluster.namesake {
            let Cluster { name, uri: own, .. } = cluster;
            self.bad(
                "--cluster-name",
                format!(
                    "another computer has the same name, {name}: it is at {uri}, this one is at {own}"
                ),
                format!("give this computer a unique name, as in `rosrescue core --cluster-name {name}-2`"),
            );
        } else {
            self.ok(
                "--cluster-name",
                format!("this computer is {}, at {}", cluster.name, cluster.uri),
            );
        }
    }

    fn robot(&mut self, cluster: &Cluster) {
        let robot = &cluster.robot;
        match (&cluster.leader, survey::typo(robot, &cluster.others)) {
            (Some(leader), _) => self.ok(
                CLUSTER,
                format!("etcd has the robot {robot}, last led by {leader}"),
            ),
            (None, Some(typo)) => self.warn(CLUSTER, typo.what, typo.todo),
            (None, None) => {}
        }
    }
}
