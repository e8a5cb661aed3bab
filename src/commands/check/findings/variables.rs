//! Judges ROS's environment variables, and the files that set them in every new shell.

use super::{
    super::{
        facts::{Port, SetupFacts},
        ros::Responder,
    },
    Findings, list,
    todo::{first_address, host_entry, own_uri, set_address},
};
use crate::ros_env;

impl Findings {
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
                    host_entry("ADDRESS", &host.name)
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
                host_entry(&first_address(facts.master_host.as_ref()), name),
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
                    format!("`sed -i '{line}s/^/#/' {file}`, or `source {file}` here"),
                ),
            }
        }
    }

    /// How to correct the file that sets `variable` in every new shell, if there is one. The line becomes a comment and is
    /// not deleted, because other advice names other lines of the same file by their numbers.
    pub(super) fn lasting(&self, facts: &SetupFacts, variable: &str) -> String {
        let mut settings = facts.shell.iter();
        let Some(setting) = settings.find(|setting| setting.variable == variable) else {
            return String::new();
        };
        let (file, line) = (setting.file.display(), setting.line);
        format!(". {file}:{line} sets the old value: `sed -i '{line}s/^/#/' {file}`")
    }
}

/// The address in `value` that other computers see, or its first one.
fn chosen_address(facts: &SetupFacts, value: &str) -> String {
    let local = facts.local.map(|address| address.to_string());
    let words = || value.split_whitespace();
    let local = local.filter(|local| words().any(|word| word == local));
    local.unwrap_or_else(|| words().next().unwrap_or_default().to_owned())
}
