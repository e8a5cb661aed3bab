//! Who has the port.

use checkpoint_store::LockHolder;

use super::{
    super::super::{
        Severity::{Note, Problem, Warning},
        facts::{PortInUse, SetupFacts},
        ros::Responder,
    },
    one, port, process, rosrescue, taken, todo,
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
            port(facts).taken = taken(rosrescue());
            facts.version = "2.0.0";
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

#[test]
fn a_stopped_rosrescue_is_continued() {
    let stopped = |facts: &mut SetupFacts| {
        port(facts).taken = taken(Responder::Silent);
        facts.disk.holder = Some(LockHolder { pid: Some(7) });
    };
    let words = "a program that does not answer: who (process 7, port 11311)";
    one(Problem, "port", words, stopped);
    let todo = todo(stopped);
    assert!(todo.starts_with("`kill -CONT 7` continues"), "{todo}");
}

#[test]
fn systemd_is_never_stopped() {
    let [systemd, own] = [process(1, "systemd", 11311), process(8, "rosrescue", 11311)];
    for (server, by, command) in [
        (rosrescue(), vec![systemd.clone(), own], "`kill 8`"),
        (
            Responder::Other,
            vec![systemd.clone()],
            "`systemctl list-sockets`",
        ),
        // A service with a wrong option, between two starts.
        (
            Responder::Silent,
            vec![systemd],
            "`journalctl -u rosrescue`",
        ),
    ] {
        let todo = todo(|facts| {
            port(facts).taken = Some(PortInUse { by, server });
            facts.version = "2.0.0";
        });
        assert!(todo.contains(command) && !todo.contains("kill 1"), "{todo}");
    }
}
