//! Judges the facts: what they mean for the robot, and what to do.

mod bypass;
mod computers;
mod names;
mod network;
mod port;
mod ros;
mod system;
#[cfg(test)]
mod tests;
mod todo;
mod variables;

use super::{
    Finding, Severity,
    facts::{Process, SetupFacts},
    ros::Responder,
};

/// Turns the facts into findings.
pub(super) fn from_facts(facts: &SetupFacts) -> Vec<Finding> {
    let mut found = Findings(Vec::new());
    if let (Some(Responder::Rosrescue { .. } | Responder::Master(_)), Some(uri)) =
        (&facts.elsewhere, &facts.env.master_uri)
    {
        // Only nodes run on this computer. The master's own setup is checked on the master's computer.
        found.elsewhere(facts, uri);
        found.address(facts);
        found.own_name(facts);
        found.lease(facts);
        found.shell(facts);
        found.strays(facts);
        found.launches(&facts.launches);
        found.nodes(facts);
        found.reached(facts);
        found.files(facts.files);
        found.clock(&facts.clock);
        found.cluster(facts);
        found.memory(facts.memory);
        return found.0;
    }
    found.port(facts);
    found.master_uri(facts);
    found.address(facts);
    found.own_name(facts);
    found.lease(facts);
    found.shell(facts);
    found.strays(facts);
    found.bypass(facts);
    found.launches(&facts.launches);
    found.nodes(facts);
    found.reached(facts);
    found.disk(&facts.disk, facts.port.as_ref().ok());
    found.files(facts.files);
    found.clock(&facts.clock);
    found.ros(facts);
    found.masters(facts);
    found.systemd(facts);
    found.cluster(facts);
    found.memory(facts.memory);
    found.0
}

struct Findings(Vec<Finding>);

impl Findings {
    fn add(&mut self, severity: Severity, subject: &'static str, what: String, todo: String) {
        self.0.push(Finding {
            severity,
            subject,
            what,
            todo,
        });
    }

    fn ok(&mut self, subject: &'static str, what: impl Into<String>) {
        self.add(Severity::Ok, subject, what.into(), String::new());
    }

    fn note(&mut self, subject: &'static str, what: impl Into<String>, todo: impl Into<String>) {
        self.add(Severity::Note, subject, what.into(), todo.into());
    }

    fn warn(&mut self, subject: &'static str, what: impl Into<String>, todo: impl Into<String>) {
        self.add(Severity::Warning, subject, what.into(), todo.into());
    }

    fn bad(&mut self, subject: &'static str, what: impl Into<String>, todo: impl Into<String>) {
        self.add(Severity::Problem, subject, what.into(), todo.into());
    }
}

fn named(process: &Process) -> String {
    let Process { pid, name, ports } = process;
    match ports.first() {
        Some(port) => format!("{name} (process {pid}, port {port})"),
        None => format!("{name} (process {pid})"),
    }
}

fn list(addresses: &[std::net::IpAddr]) -> String {
    let all: Vec<_> = addresses.iter().map(ToString::to_string).collect();
    all.join(", ")
}
