//! Whether a checkpoint's session continues, or the robot was switched on anew.
//!
//! A robot that is switched on in the morning must not start with yesterday's parameters.

use std::collections::BTreeMap;

use crate::{
    checkpoint::format::{Checkpoint, Entry, Record, Session},
    master::{Displaced, Master, Request},
};

/// When a checkpoint is restored at start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Restore {
    /// If the session continues: same boot and no orderly stop, or a registered node still lives.
    Auto,
    /// Always.
    Always,
    /// Never: the old file is kept under another name.
    Never,
}

/// What is known about a recorded session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Evidence {
    /// The computer has not rebooted since.
    pub same_boot: bool,
    /// rosrescue was stopped in order.
    pub closed: bool,
    /// A registered node answers. After a reboot only nodes on other computers count.
    pub node_alive: bool,
}

/// Whether a checkpoint is restored, and the reason in words.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Decision {
    Restore(&'static str),
    /// Start a new session.
    Fresh(&'static str),
}

/// Whether the decision depends on [`Evidence::node_alive`], which takes time to find out.
pub fn depends_on_nodes(policy: Restore, evidence: Evidence) -> bool {
    let with = |node_alive| {
        decide(
            policy,
            Evidence {
                node_alive,
                ..evidence
            },
        )
    };
    with(true) != with(false)
}

/// Whether the recorded session goes on, and why: it does after a kill, and after an orderly stop or a boot
/// only if one of its nodes is alive.
pub fn decide(policy: Restore, evidence: Evidence) -> Decision {
    let Evidence {
        same_boot,
        closed,
        node_alive,
    } = evidence;
    match policy {
        Restore::Always => Decision::Restore("--restore always"),
        Restore::Never => Decision::Fresh("--restore never"),
        Restore::Auto if same_boot && !closed => {
            Decision::Restore("the session goes on: rosrescue was not stopped in order")
        }
        Restore::Auto if node_alive => Decision::Restore("the session goes on: nodes are alive"),
        Restore::Auto if closed => {
            Decision::Fresh("rosrescue was stopped in order and no node is alive")
        }
        Restore::Auto => Decision::Fresh("the computer was booted anew and no node is alive"),
    }
}

/// The state rebuilt from a checkpoint and its records.
#[derive(Debug, Default)]
pub struct Rebuilt {
    pub mirror: Master,
    pub session: Option<Session>,
    /// Writes that have not reached the master yet, in order.
    pub pending: Vec<Request>,
    /// Nodes whose names were taken in the records or shortly before the snapshot, in the order of their addresses. It is not known which were
    /// told to shut down.
    pub displaced: Vec<Displaced>,
    /// Why the snapshot was left out: it is not the state of a master.
    pub trouble: Option<String>,
}

pub fn rebuild(checkpoint: Option<Checkpoint>, records: Vec<Record>) -> Rebuilt {
    let mut rebuilt = Rebuilt::default();
    // With the number of each write's record, or of the snapshot.
    let mut pending: Vec<(u64, Request)> = Vec::new();
    let mut displaced = BTreeMap::new();
    if let Some(checkpoint) = checkpoint {
        let writes = checkpoint.pending.into_iter();
        pending.extend(writes.map(|call| (checkpoint.seq, call.into())));
        rebuilt.session = Some(checkpoint.session);
        let owed = checkpoint.displaced.into_iter();
        displaced.extend(owed.map(|it| (it.api.clone(), it)));
        match Master::from_snapshot(checkpoint.snapshot) {
            Ok(state) => rebuilt.mirror = state,
            Err(error) => rebuilt.trouble = Some(error.to_string()),
        }
    }
    let delivered = |session: &Option<Session>| session.as_ref().map_or(0, |it| it.delivered);
    for Record { seq, entry } in records {
        match entry {
            Entry::Call {
                call,
                pending: waits,
            } => {
                let request = Request::from(call);
                let calls = request.calls().into_iter();
                let taken = calls.filter_map(|call| rebuilt.mirror.displaced_by(call));
                displaced.extend(taken.map(|it| (it.api.clone(), it)));
                rebuilt.mirror.apply_telling(&request, &mut ());
                if let Some(session) = &mut rebuilt.session {
                    session.cluster_seq += 1;
                }
                if waits {
                    pending.push((seq, request));
                }
            }
            Entry::Session(session) => {
                if session.delivered > delivered(&rebuilt.session) {
                    pending.retain(|(seq, _)| *seq > session.delivered);
                }
                rebuilt.session = Some(session);
            }
        }
    }
    rebuilt.pending = pending.into_iter().map(|(_, call)| call).collect();
    rebuilt.displaced = displaced.into_values().collect();
    rebuilt
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::xmlrpc::Call;

    fn write(seq: u64, pending: bool) -> Record {
        let params = vec!["/n".into(), format!("/p{seq}").into(), 1.into()];
        let call = Call::new("setParam", params);
        let entry = Entry::Call { call, pending };
        Record { seq, entry }
    }

    fn delivered(seq: u64, delivered: u64) -> Record {
        let entry = Entry::Session(Session {
            delivered,
            ..Session::default()
        });
        Record { seq, entry }
    }

    /// The numbers of the writes that wait, of those in a snapshot as of record 5 and in `records`.
    fn waiting(records: &[Record]) -> Vec<String> {
        let Entry::Call { call, .. } = write(4, true).entry else {
            unreachable!()
        };
        let mut checkpoint = Checkpoint {
            seq: 5,
            pending: vec![call],
            ..Checkpoint::default()
        };
        checkpoint.session.delivered = 3;
        let rebuilt = rebuild(Some(checkpoint), records.to_vec());
        let name = |call: &Request| call.params()[1].as_str().unwrap().to_owned();
        rebuilt.pending.iter().map(name).collect()
    }

    #[test]
    fn writes_wait_until_they_were_delivered() {
        let mut records = vec![write(6, false), write(7, true), write(8, true)];
        assert_eq!(waiting(&records), ["/p4", "/p7", "/p8"]);
        // The session changed for another reason.
        records.push(delivered(9, 3));
        assert_eq!(waiting(&records), ["/p4", "/p7", "/p8"]);
        // That of the snapshot counts as of the snapshot.
        records.push(delivered(10, 4));
        assert_eq!(waiting(&records), ["/p4", "/p7", "/p8"]);
        records.push(delivered(11, 7));
        assert_eq!(waiting(&records), ["/p8"]);
        records.extend([write(12, true), delivered(13, 12)]);
        assert_eq!(waiting(&records), [""; 0]);
        records.push(write(14, true));
        assert_eq!(waiting(&records), ["/p14"]);
    }

    /// The number of the last call in the computers' journal, of a file with `records` after a snapshot of call 7.
    fn cluster_seq(records: Vec<Record>) -> u64 {
        let mut checkpoint = Checkpoint::default();
        checkpoint.session.cluster_seq = 7;
        rebuild(Some(checkpoint), records)
            .session
            .unwrap()
            .cluster_seq
    }

    #[test]
    fn each_call_after_the_session_was_written_is_one_more_in_the_computers_journal() {
        let session = |seq, cluster_seq| {
            let entry = Entry::Session(Session {
                cluster_seq,
                ..Session::default()
            });
            Record { seq, entry }
        };
        assert_eq!(cluster_seq(Vec::new()), 7);
        assert_eq!(cluster_seq(vec![write(1, false), write(2, true)]), 9);
        let records = vec![write(1, false), session(2, 8), write(3, false)];
        assert_eq!(cluster_seq(records), 9);
        // What was not recorded makes the number unknown.
        let records = vec![write(1, false), session(2, 0), write(3, false)];
        assert_eq!(cluster_seq(records), 1);
    }

    #[test]
    fn who_was_displaced_is_known_from_the_records() {
        let publish = |topic: &str, port: u16| {
            let api = format!("http://n:{port}/");
            let params = ["/n", topic, "x/Y", &api].map(Into::into);
            Call::new("registerPublisher", params.to_vec())
        };
        let calls = [("/a", 1), ("/b", 1), ("/a", 2), ("/c", 1), ("/a", 3)];
        let records = (1..).zip(calls).map(|(seq, (topic, port))| Record {
            seq,
            entry: Entry::call(publish(topic, port)),
        });
        let displaced = rebuild(None, records.collect()).displaced;
        let displaced = displaced.iter().map(|it| (it.api.as_str(), &it.topics));
        assert_eq!(
            displaced.collect::<Vec<_>>(),
            [
                // Once, with what it did last.
                ("http://n:1/", &vec!["/c".to_owned()]),
                ("http://n:2/", &vec!["/a".to_owned()]),
            ]
        );
    }

    fn restores(policy: Restore, same_boot: bool, closed: bool, node_alive: bool) -> bool {
        let evidence = Evidence {
            same_boot,
            closed,
            node_alive,
        };
        matches!(decide(policy, evidence), Decision::Restore(_))
    }

    #[test]
    fn a_session_goes_on_after_a_crash_or_while_nodes_live() {
        assert!(
            restores(Restore::Auto, true, false, false),
            "crash and start"
        );
        assert!(
            !restores(Restore::Auto, true, true, false),
            "orderly stop and start"
        );
        assert!(
            restores(Restore::Auto, true, true, true),
            "orderly stop, nodes alive"
        );
        assert!(!restores(Restore::Auto, false, false, false), "reboot");
        assert!(
            restores(Restore::Auto, false, false, true),
            "reboot, nodes on another computer"
        );
    }

    #[test]
    fn nodes_are_asked_only_if_it_matters() {
        for (policy, same_boot, closed, matters) in [
            (Restore::Auto, true, false, false),
            (Restore::Auto, true, true, true),
            (Restore::Auto, false, false, true),
            (Restore::Auto, false, true, true),
            (Restore::Always, false, true, false),
            (Restore::Never, false, true, false),
        ] {
            for node_alive in [false, true] {
                let evidence = Evidence {
                    same_boot,
                    closed,
                    node_alive,
                };
                let depends = depends_on_nodes(policy, evidence);
                assert_eq!(depends, matters, "{policy:?} {evidence:?}");
            }
        }
    }

    #[test]
    fn always_and_never_say_so_outright() {
        for evidence in 0..8 {
            let [boot, closed, alive] = [1, 2, 4].map(|bit| evidence & bit != 0);
            assert!(restores(Restore::Always, boot, closed, alive));
            assert!(!restores(Restore::Never, boot, closed, alive));
        }
    }
}
