//! Judges port, addresses and names, and the facts about `--cluster`.

use super::{
    super::{
        computers::{Cluster, Unusable},
        facts::{Host, Port, SetupFacts},
        ros::Responder,
    },
    Findings, list, named,
};
use crate::{cluster::survey, ros_env};

/// A name lookup that takes longer than this, in milliseconds, is a finding: it delays every call to the node.
const SLOW: u128 = 1000;
/// Subject of findings about clients that bypass rosrescue.
const BYPASS: &str = "unprotected";
const CLUSTER: &str = "--cluster";
const AGAIN: &str = "restart it with the ROS_MASTER_URI of rosrescue: its changes are not recorded";

impl Findings {
    pub(super) fn port(&mut self, facts: &SetupFacts) {
        let Ok(Port {
            number,
            error,
            taken,
        }) = &facts.port
        else {
            // The finding about ROS_MASTER_URI reports this error.
            return;
        };
        if let Some(error) = error {
            let todo = "choose another port or address: --port, ROS_IP";
            return self.bad("port", format!("cannot listen at {number}: {error}"), todo);
        }
        let Some(taken) = taken else {
            return self.ok("port", format!("{number} is free"));
        };
        let by = match taken.by.as_slice() {
            [] => "a process that only root can see".to_owned(),
            all => all.iter().map(named).collect::<Vec<_>>().join(", "),
        };
        match &taken.server {
            Responder::Rosrescue {
                version,
                unprotected,
                ..
            } => {
                self.ok(
                    "port",
                    format!("{number}: rosrescue {version} runs here: {by}"),
                );
                if version != facts.version {
                    let own = facts.version;
                    self.note(
                        "port",
                        format!("the running rosrescue is {version}, this program is {own}"),
                        "restart rosrescue when the robot is at rest",
                    );
                }
                if let Some(why) = unprotected {
                    let todo = "see docs/operations.md";
                    self.bad(
                        "checkpoint",
                        format!("the running one is unprotected: {why}"),
                        todo,
                    );
                }
            }
            Responder::Master(pid) => {
                let pid = pid.map_or_else(String::new, |pid| format!("kill {pid}, or "));
                self.bad(
                    "port",
                    format!("{number} is in use by a master without rosrescue: {by}"),
                    format!(
                        "stop that roscore or roslaunch ({pid}Ctrl-C where it runs), or keep it and use \
                         `rosrescue proxy`"
                    ),
                );
            }
            _ => self.bad(
                "port",
                format!("{number} is in use by a program that is not a master: {by}"),
                "stop it, or choose another port with --port and in ROS_MASTER_URI",
            ),
        }
    }

    pub(super) fn master_uri(&mut self, facts: &SetupFacts) {
        const SUBJECT: &str = "ROS_MASTER_URI";
        let Some(uri) = &facts.env.master_uri else {
            return self.warn(
                SUBJECT,
                "is not set: roscpp nodes do not start",
                "source ROS's setup.bash, or export ROS_MASTER_URI=http://HOST:11311",
            );
        };
        let parsed = match ros_env::MasterUri::parse(uri) {
            Ok(parsed) => parsed,
            Err(error) => {
                return self.bad(
                    SUBJECT,
                    error.to_string(),
                    "export it with a host and a port",
                );
            }
        };
        if uri.trim() != uri {
            let todo = "export it without spaces";
            return self.bad(
                SUBJECT,
                format!("`{uri}` begins or ends with a space"),
                todo,
            );
        }
        let Some(host) = &facts.master_host else {
            return;
        };
        match &host.addresses {
            Err(why) => self.bad(
                SUBJECT,
                format!("{uri}: {} has no address ({why})", host.name),
                format!(
                    "add `ADDRESS {}` to /etc/hosts, or use an address",
                    host.name
                ),
            ),
            Ok(addresses) if !host.is_here => self.bad(
                SUBJECT,
                format!(
                    "{uri} is another computer ({}), but rosrescue would run here",
                    list(addresses)
                ),
                "check on that computer, or export the address of this one",
            ),
            Ok(_) => match &facts.port {
                Ok(Port { number, .. }) if *number != parsed.port => self.bad(
                    SUBJECT,
                    format!(
                        "{uri} has port {}, but rosrescue would use {number}",
                        parsed.port
                    ),
                    "nodes from this shell would not find it: use the same port for both",
                ),
                _ => self.ok(SUBJECT, format!("{uri} is this computer")),
            },
        }
    }

    /// Findings about a master that answers on another computer.
    pub(super) fn elsewhere(&mut self, facts: &SetupFacts, uri: &str) {
        const SUBJECT: &str = "ROS_MASTER_URI";
        match &facts.elsewhere {
            Some(Responder::Rosrescue { version, .. }) => self.ok(
                SUBJECT,
                format!("{uri} is rosrescue {version} on another computer; only nodes run here"),
            ),
            _ => self.warn(
                SUBJECT,
                format!("{uri} is a master without rosrescue on another computer"),
                "run `rosrescue check` on that computer",
            ),
        }
        if let Some(host) = &facts.elsewhere_host
            && let Err(why) = &host.addresses
        {
            let name = &host.name;
            self.warn(
                SUBJECT,
                format!("the master calls itself {name}, which has no address here ({why})"),
                format!("add `ADDRESS {name}` to /etc/hosts of this computer"),
            );
        }
    }

    /// Checks `ROS_IP` and `ROS_HOSTNAME`.
    pub(super) fn address(&mut self, facts: &SetupFacts) {
        let env = &facts.env;
        for (subject, value) in [("ROS_HOSTNAME", &env.hostname), ("ROS_IP", &env.ip)] {
            let Some(value) = value else { continue };
            if value.trim() != value {
                let todo = format!("export {subject}={}", value.trim());
                self.bad(
                    subject,
                    format!("`{value}` begins or ends with a space"),
                    todo,
                );
            } else if ros_env::bad_override(&|name| (name == subject).then(|| value.clone()))
                .is_some()
            {
                let todo = "write one without port or http://, as in robot or 10.0.0.7";
                self.bad(
                    subject,
                    format!("`{value}` is not a host name or an address"),
                    todo,
                );
            } else if subject == "ROS_IP" && value.parse::<std::net::IpAddr>().is_err() {
                let todo = "use ROS_HOSTNAME for a name, and ROS_IP for an address";
                self.warn(subject, format!("`{value}` is not an address"), todo);
            }
        }
        if let (Some(hostname), Some(ip)) = (&env.hostname, &env.ip)
            && hostname != ip
        {
            self.warn(
                "ROS_IP",
                format!("{ip} is ignored: ROS_HOSTNAME={hostname} comes first"),
                "unset one of the two",
            );
        }
    }

    /// Checks the name that nodes of this computer register.
    pub(super) fn own_name(&mut self, facts: &SetupFacts) {
        let (own, env) = (&facts.own, &facts.env);
        let is_set = env.hostname.is_some() || env.ip.is_some();
        let (subject, name) = match is_set {
            true if env.hostname.is_some() => ("ROS_HOSTNAME", &own.name),
            true => ("ROS_IP", &own.name),
            false => ("host name", &own.name),
        };
        if name.trim() != name {
            // The finding about the variable reports the spaces.
            return;
        }
        let other_computer = other_computer(facts);
        match &own.addresses {
            Err(why) => self.bad(
                subject,
                format!("{name} has no address ({why}): no other node reaches the nodes of this computer"),
                format!("add `ADDRESS {name}` to /etc/hosts, or export ROS_IP=ADDRESS"),
            ),
            Ok(_) if !own.is_here => self.bad(
                subject,
                format!("{}, which is not this computer", leads(own)),
                format!("correct {name} in /etc/hosts, or export ROS_IP with an address of this computer"),
            ),
            Ok(_) if own.is_loopback() => {
                let what = format!("{}, which other computers cannot reach", leads(own));
                let todo = "export ROS_IP with this computer's network address before anything starts";
                match other_computer {
                    Some(other) => {
                        self.bad(subject, format!("{what}, but {other} is part of the robot"), todo);
                    }
                    None if is_set => self.note(subject, what, ""),
                    None => self.warn(
                        subject,
                        format!("{what} (Debian's /etc/hosts)"),
                        format!("fine for a robot with one computer; otherwise {todo}"),
                    ),
                }
            }
            Ok(_) => self.ok(subject, leads(own)),
        }
        self.slow(subject, own);
    }

    /// Checks whether the address in `ROS_IP` may change.
    pub(super) fn lease(&mut self, facts: &SetupFacts) {
        let Some(lease) = &facts.lease else { return };
        let how = match (lease.is_leased, lease.is_wireless) {
            (true, true) => "a leased (DHCP) address of Wi-Fi",
            (true, false) => "a leased (DHCP) address",
            _ => "an address of Wi-Fi",
        };
        let ip = facts.env.ip.as_deref().unwrap_or_default();
        self.warn(
            "ROS_IP",
            format!(
                "{ip} is {how} ({}): when it changes, no node reaches this computer's nodes",
                lease.interface
            ),
            "give the interface a fixed address, or use ROS_HOSTNAME with a name that follows the address",
        );
    }

    /// Reports running nodes of another master.
    pub(super) fn strays(&mut self, facts: &SetupFacts) {
        for (process, uri) in &facts.strays {
            let port = ros_env::MasterUri::parse(uri).ok().map(|uri| uri.port);
            if facts.behind.as_ref().map(|behind| behind.uri.port) == port && port.is_some() {
                self.warn(
                    BYPASS,
                    format!(
                        "{} was started with ROS_MASTER_URI={uri}, the master behind rosrescue",
                        named(process)
                    ),
                    AGAIN,
                );
                continue;
            }
            self.warn(
                "ROS_MASTER_URI",
                format!("{} was started with ROS_MASTER_URI={uri}", named(process)),
                "if it is a node of this robot, restart it with the URI of this robot",
            );
        }
    }

    /// Reports clients that talk directly to the master behind a `proxy`.
    pub(super) fn bypass(&mut self, facts: &SetupFacts) {
        let Some(behind) = &facts.behind else { return };
        let uri = &behind.uri;
        for who in &behind.bypassing {
            self.warn(
                BYPASS,
                format!("{who} talks directly to the master at {uri}"),
                AGAIN,
            );
        }
        if behind.is_open {
            self.warn(
                BYPASS,
                format!(
                    "the master at {uri} accepts connections from other computers, which can bypass rosrescue"
                ),
                "start it with ROS_IP=127.0.0.1 and without ROS_HOSTNAME",
            );
        }
    }

    fn slow(&mut self, subject: &'static str, host: &Host) {
        if host.addresses.is_ok() && host.took.as_millis() > SLOW {
            self.warn(
                subject,
                format!(
                    "the lookup of {} takes {} ms",
                    host.name,
                    host.took.as_millis()
                ),
                "add it to /etc/hosts: every new connection waits this long",
            );
        }
    }

    pub(super) fn nodes(&mut self, facts: &SetupFacts) {
        for (host, nodes) in &facts.node_hosts {
            let nodes = nodes.join(", ");
            if let Err(why) = &host.addresses {
                let name = &host.name;
                self.bad(
                    "nodes",
                    format!("{nodes} registered at {name}, which has no address here ({why})"),
                    format!(
                        "add `ADDRESS {name}` to /etc/hosts of this computer, or set ROS_IP where the \
                         nodes run"
                    ),
                );
            }
            self.slow("nodes", host);
        }
        let known = facts
            .node_hosts
            .iter()
            .filter(|(host, _)| host.addresses.is_ok());
        let known: Vec<_> = known.map(|(host, _)| &*host.name).collect();
        if !known.is_empty() && known.len() == facts.node_hosts.len() {
            self.ok(
                "nodes",
                format!(
                    "all hosts of the nodes have addresses: {}",
                    known.join(", ")
                ),
            );
        }
    }

    pub(super) fn cluster(&mut self, facts: &SetupFacts) {
        let cluster = match facts.cluster.as_deref() {
            None => return,
            Some(Ok(cluster)) => cluster,
            Some(Err(Unusable::Options(error))) => {
                let todo = "correct the options: with these, `core` does not start";
                return self.bad(CLUSTER, error.to_string(), todo);
            }
            Some(Err(Unusable::Etcd(error))) => {
                let todo = "correct the etcd options: with these, `core` does not start";
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
                "give this computer a unique name with --cluster-name",
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

/// Describes a name with its addresses, or an address.
fn leads(host: &Host) -> String {
    let addresses = list(host.addresses.as_deref().unwrap_or_default());
    match addresses == host.name {
        true => addresses,
        false => format!("{} is {addresses}", host.name),
    }
}

/// Another computer of the robot, if one is known.
fn other_computer(facts: &SetupFacts) -> Option<String> {
    let hosts = facts.node_hosts.iter().map(|(host, _)| host);
    let mut far = hosts.chain(&facts.master_host);
    let far = far.find(|host| host.addresses.is_ok() && !host.is_here)?;
    Some(far.name.clone())
}
