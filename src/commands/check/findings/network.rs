//! Judges port, addresses and names, and the facts about `--cluster`.

use std::collections::BTreeMap;

use super::{
    super::{
        computers::{Cluster, Unusable},
        facts::{Host, Port, Process, SetupFacts},
        reach::{Outcome, Reached},
        ros::Responder,
    },
    Findings, list, named,
};
use crate::{cluster::survey, commands::counted, ros_env, status::summary::shortened};

/// A name lookup that takes longer than this, in milliseconds, is a finding: it delays every call to the node.
const SLOW: u128 = 1000;
/// Subject of findings about clients that bypass rosrescue.
const BYPASS: &str = "unprotected";
const CLUSTER: &str = "--cluster";
/// Subject of findings about other computers of the robot.
const NETWORK: &str = "network";

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
            let todo = "run `rosrescue core -p 11411`, and `export ROS_MASTER_URI=http://localhost:11411` where nodes \
                        start";
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
                        format!("when the robot is at rest, {}, and start it again", stop(&taken.by)),
                    );
                }
                if let Some(why) = unprotected {
                    let folder = facts.disk.folder.display();
                    self.bad(
                        "checkpoint",
                        format!("the running one is unprotected: {why}"),
                        format!(
                            "`df -h {folder}` shows if the disk is full; {}. Or start rosrescue with another \
                             --checkpoint",
                            delete_logs()
                        ),
                    );
                }
            }
            Responder::Master(pid) => {
                let stop = match pid {
                    Some(pid) => format!("stop it: `kill {pid}`"),
                    None => stop(&taken.by),
                };
                self.bad(
                    "port",
                    format!("{number} is in use by a master without rosrescue: {by}"),
                    format!(
                        "{stop}, or Ctrl-C where roscore or roslaunch runs. To keep it, start it with `rosmaster \
                         --core -p 11312`, and `rosrescue proxy --master http://localhost:11312`"
                    ),
                );
            }
            _ => self.bad(
                "port",
                format!("{number} is in use by a program that is not a master: {by}"),
                format!(
                    "{}, or run `rosrescue core -p 11411`, and `export ROS_MASTER_URI=http://localhost:11411` where \
                     nodes start",
                    stop(&taken.by)
                ),
            ),
        }
    }

    pub(super) fn master_uri(&mut self, facts: &SetupFacts) {
        const SUBJECT: &str = "ROS_MASTER_URI";
        let Some(uri) = &facts.env.master_uri else {
            return self.warn(
                SUBJECT,
                "is not set: roscpp nodes do not start",
                format!("`export ROS_MASTER_URI={}`", own_uri(facts)),
            );
        };
        let parsed = match ros_env::MasterUri::parse(uri) {
            Ok(parsed) => parsed,
            Err(error) => {
                return self.bad(
                    SUBJECT,
                    error.to_string(),
                    format!("`export ROS_MASTER_URI={}`", own_uri(facts)),
                );
            }
        };
        if uri.trim() != uri {
            let todo = format!("`export ROS_MASTER_URI={}`", uri.trim());
            return self.bad(
                SUBJECT,
                format!("`{uri}` begins or ends with a space"),
                todo,
            );
        }
        if !ros_env::MasterUri::has_port(uri) {
            let what = format!(
                "{uri} has no port: roscpp nodes do not start, and rospy nodes call port 80"
            );
            let todo = format!(
                "`export ROS_MASTER_URI={parsed}`{}",
                self.lasting(facts, SUBJECT)
            );
            return self.bad(SUBJECT, what, todo);
        }
        let Some(host) = &facts.master_host else {
            return;
        };
        match &host.addresses {
            Err(why) => self.bad(
                SUBJECT,
                format!("{uri}: {} has no address ({why})", host.name),
                format!(
                    "if it is this computer, `export ROS_MASTER_URI={}`, else {}",
                    own_uri(facts),
                    add_host("ADDRESS", &host.name)
                ),
            ),
            Ok(addresses) if !host.is_here => self.bad(
                SUBJECT,
                format!(
                    "{uri} is another computer ({}), but rosrescue would run here",
                    list(addresses)
                ),
                format!(
                    "run `rosrescue check` on that computer, or `export ROS_MASTER_URI={}`{}",
                    own_uri(facts),
                    self.lasting(facts, SUBJECT)
                ),
            ),
            Ok(_) => match &facts.port {
                Ok(Port { number, .. }) if *number != parsed.port => self.bad(
                    SUBJECT,
                    format!(
                        "{uri} has port {}, but rosrescue would use {number}",
                        parsed.port
                    ),
                    format!(
                        "nodes from this shell would not find it: `export ROS_MASTER_URI={}`",
                        own_uri(facts)
                    ),
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
                add_host(&first_address(facts.master_host.as_ref()), name),
            );
        }
    }

    /// Checks `ROS_IP` and `ROS_HOSTNAME`.
    pub(super) fn address(&mut self, facts: &SetupFacts) {
        let env = &facts.env;
        for (subject, value) in [("ROS_HOSTNAME", &env.hostname), ("ROS_IP", &env.ip)] {
            let Some(value) = value else { continue };
            if value.trim() != value || subject == "ROS_IP" && value.contains(' ') {
                let todo = match subject {
                    "ROS_IP" => format!("`export ROS_IP={}`", chosen_address(facts, value)),
                    _ => format!("`export {subject}={}`", value.trim()),
                };
                let what = match value.trim().contains(' ') {
                    true => format!("`{value}` is more than one address"),
                    false => format!("`{value}` begins or ends with a space"),
                };
                self.bad(subject, what, todo + &self.lasting(facts, subject));
            } else if ros_env::bad_override(&|name| (name == subject).then(|| value.clone()))
                .is_some()
            {
                self.bad(
                    subject,
                    format!("`{value}` is not a host name or an address"),
                    set_address(facts) + &self.lasting(facts, subject),
                );
            } else if subject == "ROS_IP" && value.parse::<std::net::IpAddr>().is_err() {
                let todo = format!("`unset ROS_IP; export ROS_HOSTNAME={value}`");
                self.warn(subject, format!("`{value}` is not an address"), todo);
            }
        }
        if let (Some(hostname), Some(ip)) = (&env.hostname, &env.ip)
            && hostname != ip
        {
            self.warn(
                "ROS_IP",
                format!("{ip} is ignored: ROS_HOSTNAME={hostname} comes first"),
                "`unset ROS_IP`, or `unset ROS_HOSTNAME` to use the address",
            );
        }
    }

    /// Reports variables that every new shell sets to something else.
    pub(super) fn shell(&mut self, facts: &SetupFacts) {
        let env = &facts.env;
        for setting in &facts.shell {
            let variable = setting.variable;
            let present = match variable {
                "ROS_MASTER_URI" => &env.master_uri,
                "ROS_IP" => &env.ip,
                _ => &env.hostname,
            };
            let at = format!("{}:{}", setting.file.display(), setting.line);
            let (file, line) = (setting.file.display(), setting.line);
            let value = &setting.value;
            match present {
                Some(present) if present == value => {}
                Some(present) => self.warn(
                    variable,
                    format!("is {present} here, but {at} sets {value} in every new shell"),
                    format!("`sed -i '{line}s|.*|export {variable}={present}|' {file}`, or `source {file}` here"),
                ),
                None => self.warn(
                    variable,
                    format!("is not set here, but {at} sets {value} in every new shell"),
                    format!("`sed -i {line}d {file}`, or `source {file}` here"),
                ),
            }
        }
    }

    /// How to correct the file that sets `variable` in every new shell, if there is one.
    fn lasting(&self, facts: &SetupFacts, variable: &str) -> String {
        let mut settings = facts.shell.iter();
        let Some(setting) = settings.find(|setting| setting.variable == variable) else {
            return String::new();
        };
        let (file, line) = (setting.file.display(), setting.line);
        format!(". {file}:{line} sets the old value: `sed -i {line}d {file}`")
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
        if name.contains(' ') {
            // The finding about the variable reports the spaces.
            return;
        }
        let set_address = set_address(facts) + &self.lasting(facts, subject);
        let other_computer = other_computer(facts);
        match &own.addresses {
            Err(why) => self.bad(
                subject,
                format!("{name} has no address ({why}): no other node reaches the nodes of this computer"),
                match facts.local {
                    Some(local) => {
                        format!("{}, or {set_address}", add_host(&local.to_string(), name))
                    }
                    None => set_address,
                },
            ),
            Ok(_) if !own.is_here => self.bad(
                subject,
                format!("{}, which is not this computer", leads(own)),
                match name.parse::<std::net::IpAddr>() {
                    Ok(_) => set_address,
                    Err(_) => format!("{set_address}. `grep -n {name} /etc/hosts` shows a wrong entry"),
                },
            ),
            Ok(_) if own.is_loopback() => {
                let what = format!("{}, which other computers cannot reach", leads(own));
                match other_computer {
                    Some(other) => {
                        let what = format!("{what}, but {other} is part of the robot");
                        self.bad(subject, what, set_address);
                    }
                    None if is_set => self.note(subject, what, ""),
                    None => self.warn(
                        subject,
                        format!("{what} (Debian's /etc/hosts)"),
                        format!("fine for a robot with one computer; otherwise {set_address}"),
                    ),
                }
            }
            Ok(_) => self.ok(subject, leads(own)),
        }
        self.slow(subject, own);
    }

    /// Checks whether the registered address of this computer may change.
    pub(super) fn lease(&mut self, facts: &SetupFacts) {
        let Some(lease) = &facts.lease else { return };
        let how = match (lease.is_leased, lease.is_wireless) {
            (true, true) => "a leased (DHCP) address of Wi-Fi",
            (true, false) => "a leased (DHCP) address",
            _ => "an address of Wi-Fi",
        };
        let (address, interface, name) = (&lease.address, &lease.interface, &facts.own.name);
        let (subject, what) = match (&facts.env.hostname, &facts.env.ip) {
            (None, Some(_)) => ("ROS_IP", address.clone()),
            (Some(_), _) if name == address => ("ROS_HOSTNAME", address.clone()),
            (Some(_), _) => ("ROS_HOSTNAME", format!("{name} is {address},")),
            (None, None) => ("host name", format!("{name} is {address},")),
        };
        let link = if name == address { " is" } else { "" };
        self.warn(
            subject,
            format!(
                "{what}{link} {how} ({interface}): when it changes, no node reaches this computer's nodes"
            ),
            format!(
                "reserve it in the DHCP server for the hardware address that `cat \
                 /sys/class/net/{interface}/address` prints"
            ),
        );
    }

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
                    "start it with `env -u ROS_HOSTNAME ROS_IP=127.0.0.1 rosmaster --core -p {}`",
                    uri.port
                ),
            );
        }
    }

    /// Reports computers of the robot that cannot be reached from here.
    pub(super) fn reached(&mut self, facts: &SetupFacts) {
        let mut hosts: BTreeMap<&str, Vec<&Reached>> = BTreeMap::new();
        for reached in &facts.reached {
            hosts
                .entry(&reached.address.host)
                .or_default()
                .push(reached);
        }
        let ports = &facts.ports_of_nodes;
        for (host, all) in hosts {
            let own = all.iter().find_map(|it| it.from);
            let own = own.map_or_else(|| address_of_this(facts), |own| own.to_string());
            let blocked = all.iter().filter(|it| it.outcome != Outcome::Answered);
            let list: Vec<_> = blocked
                .map(|it| format!("{} ({})", it.address.port, it.of))
                .collect();
            if list.is_empty() {
                let tried = counted(all.len(), "port");
                self.ok(NETWORK, format!("{host} answers at {tried} of nodes"));
                continue;
            }
            let is_on = all.iter().any(|it| match it.outcome {
                Outcome::Answered => true,
                Outcome::Blocked { is_on } => is_on,
            });
            let (list, number) = (shortened(&list), list.len());
            if is_on {
                self.bad(
                    NETWORK,
                    format!(
                        "{host} is on, but does not answer at {number} of {} tried: {list}. A firewall drops the \
                         packets",
                        counted(all.len(), "port")
                    ),
                    format!(
                        "the robot's computers need the master's port and TCP {ports} in both directions: on {host}, \
                         run `sudo ufw allow from {own}`, or without ufw `sudo iptables -I INPUT -s {own} -j ACCEPT`"
                    ),
                );
            } else {
                self.warn(
                    NETWORK,
                    format!("{host} does not answer at {list}: it is off, out of reach, or behind a firewall"),
                    format!(
                        "`ping -c 3 {host}`. Its firewall has to let in TCP {ports} and the master's port from {own}"
                    ),
                );
            }
        }
        let Some((firewall, other)) = facts.firewall.zip(other_host(facts)) else {
            return;
        };
        let from = first_address(Some(other));
        let allow = match firewall {
            "ufw" => {
                format!("`sudo ufw status` shows what it allows; `sudo ufw allow from {from}`")
            }
            _ => format!("`sudo firewall-cmd --zone=trusted --add-source={from}`"),
        };
        self.note(
            NETWORK,
            format!(
                "this computer's firewall ({firewall}) has to let in TCP {ports} and the master's port from {}",
                other.name
            ),
            allow,
        );
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
                format!(
                    "every new connection waits this long: {}",
                    add_host(&first_address(Some(host)), &host.name)
                ),
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
                        "where the nodes run, `export ROS_IP=$(hostname -I | cut -d' ' -f1)` and start them again; or \
                         {}",
                        add_host("ADDRESS", name)
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
                let todo = "with these options, core does not start: `rosrescue core --help` explains them";
                return self.bad(CLUSTER, error.to_string(), todo);
            }
            Some(Err(Unusable::Etcd(error))) => {
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
    other_host(facts).map(|host| host.name.clone())
}

fn other_host(facts: &SetupFacts) -> Option<&Host> {
    let hosts = facts.node_hosts.iter().map(|(host, _)| host);
    let mut far = hosts.chain(&facts.master_host);
    far.find(|host| host.addresses.is_ok() && !host.is_here)
}

/// The first address of `host`, or a placeholder.
fn first_address(host: Option<&Host>) -> String {
    let first = host.and_then(|host| host.addresses.as_ref().ok()?.first());
    first.map_or_else(|| "ADDRESS".to_owned(), ToString::to_string)
}

/// The `ROS_MASTER_URI` of nodes that use a master of this computer.
fn own_uri(facts: &SetupFacts) -> String {
    let own = &facts.own;
    let port = facts
        .port
        .as_ref()
        .map_or(ros_env::DEFAULT_MASTER_PORT, |port| port.number);
    let host = match own.is_here && own.addresses.is_ok() {
        true => own.name.clone(),
        false => "localhost".to_owned(),
    };
    ros_env::MasterUri { host, port }.to_string()
}

/// This computer's address, or a command that prints it.
fn address_of_this(facts: &SetupFacts) -> String {
    let local = facts.local.map(|address| address.to_string());
    local.unwrap_or_else(|| "$(hostname -I | cut -d' ' -f1)".to_owned())
}

/// The address in `value` that other computers see, or its first one.
fn chosen_address(facts: &SetupFacts, value: &str) -> String {
    let local = facts.local.map(|address| address.to_string());
    let words = || value.split_whitespace();
    let local = local.filter(|local| words().any(|word| word == local));
    local.unwrap_or_else(|| words().next().unwrap_or_default().to_owned())
}

/// How to register this computer's nodes at an address that others reach.
fn set_address(facts: &SetupFacts) -> String {
    let unset = match facts.env.hostname {
        Some(_) => "unset ROS_HOSTNAME; ",
        None => "",
    };
    let address = address_of_this(facts);
    format!("`{unset}export ROS_IP={address}` before anything starts")
}

/// How to give `name` an address on this computer.
fn add_host(address: &str, name: &str) -> String {
    format!("`echo {address} {name} | sudo tee -a /etc/hosts`")
}

/// How to stop the processes that have a port.
fn stop(processes: &[Process]) -> String {
    let pids: Vec<_> = processes
        .iter()
        .map(|process| process.pid.to_string())
        .collect();
    match pids.as_slice() {
        [] => "`sudo rosrescue check` names the process".to_owned(),
        pids => format!("stop it: `kill {}`", pids.join(" ")),
    }
}

/// How to free space on the disk of ROS's logs. `rosclean purge` would delete the checkpoint, too.
pub(super) fn delete_logs() -> String {
    "`find ~/.ros/log -name '*.log*' -mtime +2 -delete` deletes old logs".to_owned()
}
