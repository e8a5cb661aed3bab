//! Who has the port.

use super::{
    super::super::{
        Severity::{Note, Problem, Warning},
        facts::PortInUse,
        ros::Responder,
    },
    one, port, process, rosrescue, taken,
};

#[test]
fn who_has_the_port() {
    one(
        Problem,
        "port",
        "a master without rosrescue: who (process 7, port 11311)",
        |facts| {
            port(facts).taken = taken(Responder::Master(Some(7)));
            facts.masters = vec![process(7, "rosmaster", 11311)];
        },
    );
    one(Problem, "port", "a program that is not a master", |facts| {
        port(facts).taken = taken(Responder::Other);
    });
    one(
        Problem,
        "port",
        "a process that only root can see",
        |facts| {
            port(facts).taken = Some(PortInUse {
                by: Vec::new(),
                server: Responder::Silent,
            });
        },
    );
    one(Problem, "port", "cannot listen at 11311: denied", |facts| {
        port(facts).error = Some("denied".to_owned());
    });
    one(
        Note,
        "port",
        "the running rosrescue is 1.0.0, this program is 2.0.0",
        |facts| {
            port(facts).taken = taken(rosrescue(None));
            facts.version = "2.0.0";
        },
    );
    one(
        Problem,
        "checkpoint",
        "unprotected: the disk is full",
        |facts| {
            port(facts).taken = taken(rosrescue(Some("the disk is full")));
        },
    );
    one(
        Warning,
        "masters",
        "rosmaster (process 9, port 12000)",
        |facts| {
            facts.masters = vec![process(9, "rosmaster", 12000)];
        },
    );
}
