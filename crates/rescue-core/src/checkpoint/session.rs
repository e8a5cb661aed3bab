//! Decides whether a checkpoint's session continues, or whether the robot was switched on again.
//!
//! A *session* begins when rosrescue starts and restores no state. It survives crashes. A robot that is switched on in
//! the morning needs a new session, because it must not start with yesterday's parameters.

use std::collections::BTreeMap;

use crate::checkpoint::format::{Checkpoint, PendingWrite, Record, RecordContent, Session};
use ros1_master::master::{Displaced, Master};

/// When to restore a checkpoint at the start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RestorePolicy {
    /// Restore it if the session continues: there was no reboot and no clean stop, or a registered node is still alive.
    Auto,
    /// Always restore it.
    Always,
    /// Do not restore it at a first start, and keep the old file under another name. A rosrescue that is started again
    /// after a crash continues its session.
    Never,
}

/// What is known about the session in a checkpoint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SessionEvidence {
    /// Whether the computer has not rebooted since the session began.
    pub same_boot: bool,
    /// Whether rosrescue ended the session with a clean stop.
    pub closed: bool,
    /// Whether a registered node answers. After a reboot only nodes on other computers count.
    pub node_alive: bool,
    /// Whether the guardian has started this process in place of one that had served calls.
    pub restarted: bool,
}

/// Whether to restore a checkpoint, and why.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Decision {
    Restore(&'static str),
    /// Begin a new session.
    Fresh(&'static str),
}

/// Whether the decision depends on [`SessionEvidence::node_alive`], which takes time to find out.
pub fn depends_on_nodes(policy: RestorePolicy, evidence: SessionEvidence) -> bool {
    let with = |node_alive| {
        decide(
            policy,
            SessionEvidence {
                node_alive,
                ..evidence
            },
        )
    };
    with(true) != with(false)
}

/// Decides whether the session in a checkpoint continues. A session continues after a kill. After a clean stop or a
/// reboot it continues only if one of its nodes is alive. [`RestorePolicy::Never`] is about first starts: after a kill,
/// a start by the guardian is none, and neither is one that finds a node of the session alive, as after a restart by
/// systemd.
pub fn decide(policy: RestorePolicy, evidence: SessionEvidence) -> Decision {
    let SessionEvidence {
        same_boot,
        closed,
        node_alive,
        restarted,
    } = evidence;
    let crashed = same_boot && !closed;
    match policy {
        RestorePolicy::Always => Decision::Restore("--restore always"),
        RestorePolicy::Never if !crashed || !(restarted || node_alive) => {
            Decision::Fresh("--restore never")
        }
        RestorePolicy::Never | RestorePolicy::Auto if crashed => {
            Decision::Restore("rosrescue was not stopped cleanly")
        }
        RestorePolicy::Never | RestorePolicy::Auto if node_alive => {
            Decision::Restore("nodes are alive")
        }
        RestorePolicy::Never | RestorePolicy::Auto if closed => {
            Decision::Fresh("rosrescue was stopped cleanly and no node is alive")
        }
        RestorePolicy::Never | RestorePolicy::Auto => {
            Decision::Fresh("the computer was rebooted and no node is alive")
        }
    }
}

/// The state rebuilt from a checkpoint and its records.
#[derive(Debug, Default)]
pub struct Rebuilt {
    pub mirror: Master,
    pub session: Option<Session>,
    /// Writes that have not reached the master yet, in order.
    pub pending: Vec<PendingWrite>,
    /// Nodes whose names were taken in the records or shortly before the snapshot, ordered by address. It is unknown
    /// which of them were told to shut down.
    pub displaced: Vec<Displaced>,
    /// If the snapshot was not used because no master can be in its state: the reason.
    pub trouble: Option<String>,
}

pub fn rebuild(checkpoint: Option<Checkpoint>, records: Vec<Record>) -> Rebuilt {
    let mut rebuilt = Rebuilt::default();
    let mut displaced = BTreeMap::new();
    if let Some(checkpoint) = checkpoint {
        rebuilt.pending = checkpoint.pending;
        rebuilt.session = Some(checkpoint.session);
        let owed = checkpoint.displaced.into_iter();
        displaced.extend(owed.map(|it| (it.api.clone(), it)));
        match Master::from_snapshot(checkpoint.snapshot) {
            Ok(state) => rebuilt.mirror = state,
            Err(error) => rebuilt.trouble = Some(error.to_string()),
        }
    }
    for Record { seq, entry } in records {
        match entry {
            RecordContent::Call {
                call,
                pending: waits,
                label,
            } => {
                let calls = call.calls().into_iter();
                let taken = calls.filter_map(|call| rebuilt.mirror.displaced_by(call));
                displaced.extend(taken.map(|it| (it.api.clone(), it)));
                rebuilt.mirror.apply_telling(&call, &mut ());
                label.origin.note_in(&mut rebuilt.mirror, &call);
                if let Some(session) = &mut rebuilt.session {
                    session.cluster_seq += 1;
                }
                if waits {
                    rebuilt.pending.push(PendingWrite { seq, call });
                }
            }
            RecordContent::Session(session) => {
                rebuilt
                    .pending
                    .retain(|write| write.seq > session.delivered);
                rebuilt.session = Some(*session);
            }
        }
    }
    rebuilt.displaced = displaced.into_values().collect();
    rebuilt
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::checkpoint::format::Label;
    use ros1_master::master::{Method, Request};
    use ros1_master::xmlrpc::Value;

    fn write(seq: u64, pending: bool) -> Record {
        let params = [Value::from("/n"), format!("/p{seq}").into(), 1.into()];
        let call = Request::new(Method::SetParam, params);
        let entry = RecordContent::Call {
            call,
            pending,
            label: Label::default(),
        };
        Record { seq, entry }
    }

    fn delivered(seq: u64, delivered: u64) -> Record {
        let session = Session {
            delivered,
            ..Session::default()
        };
        let entry = RecordContent::Session(session.into());
        Record { seq, entry }
    }

    /// The pending writes: number 4 in a snapshot taken at record 5, and those in `records`.
    fn waiting(records: &[Record]) -> Vec<String> {
        let RecordContent::Call { call, .. } = write(4, true).entry else {
            unreachable!()
        };
        let mut checkpoint = Checkpoint {
            seq: 5,
            pending: vec![PendingWrite { seq: 4, call }],
            ..Checkpoint::default()
        };
        checkpoint.session.delivered = 3;
        let rebuilt = rebuild(Some(checkpoint), records.to_vec());
        let name = |write: &PendingWrite| write.call.params()[1].as_str().unwrap().to_owned();
        rebuilt.pending.iter().map(name).collect()
    }

    #[test]
    fn pending_writes_wait_until_they_are_delivered() {
        let mut records = vec![write(6, false), write(7, true), write(8, true)];
        assert_eq!(waiting(&records), ["/p4", "/p7", "/p8"]);
        // A session record written for another reason changes nothing.
        records.push(delivered(9, 3));
        assert_eq!(waiting(&records), ["/p4", "/p7", "/p8"]);
        records.push(delivered(10, 4));
        assert_eq!(waiting(&records), ["/p7", "/p8"]);
        records.push(delivered(11, 7));
        assert_eq!(waiting(&records), ["/p8"]);
        records.extend([write(12, true), delivered(13, 12)]);
        assert_eq!(waiting(&records), [""; 0]);
        records.push(write(14, true));
        assert_eq!(waiting(&records), ["/p14"]);
    }

    /// Number of the last call in etcd's journal, for a file with `records` after a snapshot of call 7.
    fn cluster_seq(records: Vec<Record>) -> u64 {
        let mut checkpoint = Checkpoint::default();
        checkpoint.session.cluster_seq = 7;
        rebuild(Some(checkpoint), records)
            .session
            .unwrap()
            .cluster_seq
    }

    #[test]
    fn each_call_after_a_session_record_counts_as_one_more_in_the_etcd_journal() {
        let session = |seq, cluster_seq| {
            let session = Session {
                cluster_seq,
                ..Session::default()
            };
            let entry = RecordContent::Session(session.into());
            Record { seq, entry }
        };
        assert_eq!(cluster_seq(Vec::new()), 7);
        assert_eq!(cluster_seq(vec![write(1, false), write(2, true)]), 9);
        let records = vec![write(1, false), session(2, 8), write(3, false)];
        assert_eq!(cluster_seq(records), 9);
        // Without the session's number, the number of the following calls is unknown.
        let records = vec![write(1, false), session(2, 0), write(3, false)];
        assert_eq!(cluster_seq(records), 1);
    }

    #[test]
    fn displaced_nodes_are_found_in_the_records() {
        let publish = |topic: &str, port: u16| {
            let api = format!("http://n:{port}/");
            Request::new(Method::RegisterPublisher, ["/n", topic, "x/Y", &api])
        };
        let calls = [("/a", 1), ("/b", 1), ("/a", 2), ("/c", 1), ("/a", 3)];
        let records = (1..).zip(calls).map(|(seq, (topic, port))| Record {
            seq,
            entry: RecordContent::call(publish(topic, port)),
        });
        let displaced = rebuild(None, records.collect()).displaced;
        let displaced = displaced.iter().map(|it| (it.api.as_str(), &it.topics));
        assert_eq!(
            displaced.collect::<Vec<_>>(),
            [
                // Listed once, with the latest topics.
                ("http://n:1/", &vec!["/c".to_owned()]),
                ("http://n:2/", &vec!["/a".to_owned()]),
            ]
        );
    }

    fn restores(policy: RestorePolicy, same_boot: bool, closed: bool, node_alive: bool) -> bool {
        let evidence = SessionEvidence {
            same_boot,
            closed,
            node_alive,
            restarted: false,
        };
        matches!(decide(policy, evidence), Decision::Restore(_))
    }

    #[test]
    fn a_session_continues_after_a_crash_or_while_nodes_are_alive() {
        assert!(
            restores(RestorePolicy::Auto, true, false, false),
            "crash and start"
        );
        assert!(
            !restores(RestorePolicy::Auto, true, true, false),
            "clean stop and start"
        );
        assert!(
            restores(RestorePolicy::Auto, true, true, true),
            "clean stop, nodes alive"
        );
        assert!(
            !restores(RestorePolicy::Auto, false, false, false),
            "reboot"
        );
        assert!(
            restores(RestorePolicy::Auto, false, false, true),
            "reboot, nodes on another computer"
        );
    }

    #[test]
    fn nodes_are_asked_only_if_the_decision_depends_on_them() {
        for (policy, same_boot, closed, matters) in [
            (RestorePolicy::Auto, true, false, false),
            (RestorePolicy::Auto, true, true, true),
            (RestorePolicy::Auto, false, false, true),
            (RestorePolicy::Auto, false, true, true),
            (RestorePolicy::Always, false, true, false),
            (RestorePolicy::Never, false, true, false),
            (RestorePolicy::Never, true, true, false),
            (RestorePolicy::Never, true, false, true),
        ] {
            for node_alive in [false, true] {
                let evidence = SessionEvidence {
                    same_boot,
                    closed,
                    node_alive,
                    restarted: false,
                };
                let depends = depends_on_nodes(policy, evidence);
                assert_eq!(depends, matters, "{policy:?} {evidence:?}");
            }
        }
    }

    #[test]
    fn restore_always_restores_in_any_case() {
        for evidence in 0..8 {
            let [boot, closed, alive] = [1, 2, 4].map(|bit| evidence & bit != 0);
            assert!(restores(RestorePolicy::Always, boot, closed, alive));
        }
    }

    #[test]
    fn restore_never_is_about_a_first_start() {
        for evidence in 0..16 {
            let [same_boot, closed, node_alive, restarted] =
                [1, 2, 4, 8].map(|bit| evidence & bit != 0);
            let evidence = SessionEvidence {
                same_boot,
                closed,
                node_alive,
                restarted,
            };
            let restores =
                decide(RestorePolicy::Never, evidence) != Decision::Fresh("--restore never");
            let goes_on = same_boot && !closed && (node_alive || restarted);
            assert_eq!(restores, goes_on, "{evidence:?}");
        }
    }
}
