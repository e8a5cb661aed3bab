//! The robot's state in etcd, written by one computer and read by another.

use std::{
    io::{Read, Write},
    net::TcpStream,
    time::Instant,
};

use rescue_core::{
    checkpoint::format::{self, Checkpoint, Record, RecordContent, Session},
    cluster::{
        journal::{self, Progress},
        machine::{EtcdAnswer, Op, RevisionGuard},
    },
};
use ros1_master::master::{Method, Request};
use rosrescue::cluster::replica::{Replica, ReplicaError};

use crate::servers::{LIMIT, Servers, keys, settings};

fn replica(servers: &Servers) -> Replica {
    Replica {
        client: servers.client(),
        keys: keys(),
        limit: LIMIT,
    }
}

fn record(seq: u64, bytes: usize) -> Record {
    let key = format!("/p{seq}");
    let value = "x".repeat(bytes);
    let params = ["/n", key.as_str(), value.as_str()];
    let entry = RecordContent::call(Request::new(Method::SetParam, params));
    Record { seq, entry }
}

/// The simplest possible leader.
struct Leader {
    replica: Replica,
    guard: RevisionGuard,
    beat: u64,
}

impl Leader {
    async fn new(servers: &Servers) -> Self {
        let replica = replica(servers);
        let view = replica.client.view(&keys(), LIMIT).await.unwrap();
        let guard = RevisionGuard {
            seq: 0,
            ..view.guard()
        };
        let seq = 0;
        let claim = Op::Claim {
            guard,
            claim: 1,
            begins: Some(1),
            seq,
            settled: true,
        };
        let answer = replica
            .run(&settings("a"), &claim, None, None)
            .await
            .unwrap();
        let guard = match answer {
            EtcdAnswer::Applied { revision, .. } => RevisionGuard {
                origin: revision,
                leader: revision,
                alive: revision,
                seq: 0,
            },
            // If the answer comes late, the request is sent again and finds itself done.
            EtcdAnswer::Is(view) if (view.leader.as_ref()).is_some_and(|it| it.claim == 1) => {
                view.guard()
            }
            answer => panic!("{answer:?}"),
        };
        Self {
            replica,
            guard,
            beat: 0,
        }
    }

    /// Commits all records, in as many heartbeats as it takes.
    async fn commit(&mut self, records: &[Record]) {
        for record in records {
            let parts = journal::parts(&self.replica.keys, record).unwrap();
            let leads = self.replica.prepare(self.guard.leader, &parts).await;
            assert!(leads.unwrap());
        }
        let mut rest = records;
        while let Some(last) = rest.last() {
            self.beat += 1;
            let beat = Op::Beat {
                guard: self.guard,
                claim: 1,
                claimed_at: 0,
                beat: self.beat,
                seq: last.seq,
                released: None,
                settled: true,
            };
            let entry = journal::pack(&self.replica.keys, rest).unwrap().entry;
            let settings = settings("a");
            let answer = self.replica.run(&settings, &beat, entry.as_ref(), None);
            let seq = match answer.await.unwrap() {
                EtcdAnswer::Applied { revision, seq } => {
                    (self.guard.alive, self.guard.seq) = (revision, seq);
                    seq
                }
                // On a busy computer an answer of etcd may be lost. The request is then sent again, and finds itself done.
                EtcdAnswer::Is(view)
                    if (view.alive.as_ref()).is_some_and(|alive| alive.beat == self.beat) =>
                {
                    self.guard = view.guard();
                    view.seq()
                }
                answer => panic!("{answer:?}"),
            };
            rest = &rest[rest.iter().take_while(|record| record.seq <= seq).count()..];
        }
    }
}

#[tokio::test]
async fn a_follower_reads_everything_that_the_leader_commits_even_a_map_of_20_mb() {
    let servers = Servers::new(3).await;
    let mut leader = Leader::new(&servers).await;
    let sizes = [10, 100, 300 << 10, 5, 20 << 20, 1];
    let records: Vec<_> = (1..)
        .zip(sizes)
        .map(|(seq, bytes)| record(seq, bytes))
        .collect();
    let follower = replica(&servers);
    let start = follower.load(Progress::default()).await.unwrap();
    let range = follower.keys.small();
    let mut watch = follower.client.watch(range, start.view.revision, LIMIT);
    let began = Instant::now();
    leader.commit(&records).await;
    println!("20 MB are committed in {:?}", began.elapsed());
    let loaded = follower.load(Progress::default()).await.unwrap();
    assert!(loaded.records == records && loaded.checkpoint.is_none());
    assert_eq!(loaded.view.guard(), leader.guard);
    // A watch returns the same records when they arrive.
    let (mut progress, mut seen) = (Progress::default(), Vec::new());
    while seen.len() < records.len() {
        for change in watch.next().await.unwrap() {
            if follower.keys.seq_of(&change.key).is_some() {
                let kv = change.kv.unwrap();
                let new = follower.records(&kv, change.revision).await.unwrap();
                seen.extend(progress.take(new, kv.value.len()).unwrap());
            }
        }
    }
    assert!(seen == records);
    // After one more record, only that record is read.
    leader.commit(&[record(7, 1)]).await;
    let more = follower.load(loaded.progress).await.unwrap();
    assert_eq!(more.records, [record(7, 1)]);
}

/// The number of read requests that the only member has answered.
fn reads(servers: &Servers) -> u64 {
    let address = servers.endpoints(0)[0].replace("http://", "");
    let mut stream = TcpStream::connect(&address).unwrap();
    let request = format!("GET /metrics HTTP/1.0\r\nHost: {address}\r\n\r\n");
    stream.write_all(request.as_bytes()).unwrap();
    let mut page = String::new();
    stream.read_to_string(&mut page).unwrap();
    let line = page.lines().find(|line| {
        line.starts_with("grpc_server_handled_total")
            && line.contains("grpc_code=\"OK\",grpc_method=\"Range\"")
    });
    let count = line.and_then(|line| line.rsplit(' ').next());
    count.unwrap().parse().unwrap()
}

/// A computer that merges its writes reads the journal again and again. With a long journal each complete read took
/// over 10 s on a busy computer.
#[tokio::test]
async fn known_records_of_a_long_journal_are_not_read_again() {
    let servers = Servers::new(1).await;
    let mut leader = Leader::new(&servers).await;
    for seq in 1..=300 {
        leader.commit(&[record(seq, 1)]).await;
    }
    let follower = replica(&servers);
    let before = reads(&servers);
    let known = follower.load(Progress::default()).await.unwrap();
    let whole = reads(&servers) - before;
    leader.commit(&[record(301, 1)]).await;
    let before = reads(&servers);
    let more = follower.load(known.progress).await.unwrap();
    assert_eq!(more.records, [record(301, 1)]);
    assert_eq!(more.view.guard(), leader.guard);
    let rest = reads(&servers) - before;
    assert!(rest <= 2 && whole > 5, "{whole} requests, then {rest}");
}

#[tokio::test]
async fn a_snapshot_replaces_the_journal_before_it() {
    let servers = Servers::new(1).await;
    let mut leader = Leader::new(&servers).await;
    let records: Vec<_> = (1..=50).map(|seq| record(seq, 30 << 10)).collect();
    leader.commit(&records).await;
    let follower = replica(&servers);
    let before = follower.load(Progress::default()).await.unwrap();
    assert!(before.progress.wants_snapshot());
    let mut state = Checkpoint {
        seq: 50,
        session: Session {
            id: "run".to_owned(),
            ..Session::default()
        },
        ..Checkpoint::default()
    };
    for round in 0..2 {
        let value = "y".repeat(3 << 20).as_str().into();
        state.snapshot.params.insert("map".to_owned(), value);
        state.seq = 50 + round;
        let term = leader.guard.leader;
        let replica = &leader.replica;
        let bytes = format::encode_checkpoint(&state, 1).unwrap().bytes;
        assert!(bytes.len() > 3 << 20);
        for (term, leads) in [(term + 1, false), (term, true)] {
            let written = replica.write_snapshot(term, state.seq, &bytes).await;
            assert_eq!(written.unwrap(), leads);
        }
        leader
            .replica
            .client
            .compact(leader.guard.alive, LIMIT)
            .await
            .unwrap();
        leader.commit(&[record(51 + round, 10)]).await;
    }
    let joined = follower.load(Progress::default()).await.unwrap();
    assert_eq!(joined.checkpoint.as_ref().map(|state| state.seq), Some(51));
    assert!(joined.checkpoint == Some(state));
    assert_eq!(joined.records, [record(52, 10)]);
    assert!(!joined.progress.wants_snapshot());
    // A follower that has read up to the snapshot continues from there.
    let mut known = Progress::default();
    known.seq = 51;
    let on = follower.load(known).await.unwrap();
    assert!(on.checkpoint.is_none() && on.records == [record(52, 10)]);
    // The old journal has been deleted.
    let all = format!("{}a", keys().prefix())..format!("{}z", keys().prefix());
    let all = follower.client.range(&all, LIMIT).await.unwrap();
    let sizes: usize = all.kvs.iter().map(|kv| kv.value.len()).sum();
    assert!(sizes < 4 << 20, "{sizes}");
}

/// Without this, a slow reader would never finish while others write.
#[tokio::test]
async fn a_reader_gets_announced_parts_although_the_leader_has_replaced_them() {
    let servers = Servers::new(1).await;
    let mut leader = Leader::new(&servers).await;
    let large = [record(1, 1 << 20)];
    leader.commit(&large).await;
    let follower = replica(&servers);
    let journal = follower.keys.journal_after(0);
    let found = follower.client.range(&journal, LIMIT).await.unwrap();
    let state = Checkpoint {
        seq: 1,
        ..Checkpoint::default()
    };
    let term = leader.guard.leader;
    let bytes = format::encode_checkpoint(&state, 1).unwrap().bytes;
    let written = leader.replica.write_snapshot(term, state.seq, &bytes).await;
    assert!(written.unwrap());
    let records = follower.records(&found.kvs[0], found.revision).await;
    assert!(records.unwrap() == large);
}

#[tokio::test]
async fn a_journal_with_a_gap_is_refused() {
    let servers = Servers::new(1).await;
    let mut leader = Leader::new(&servers).await;
    for seq in 1..=4 {
        leader.commit(&[record(seq, 1)]).await;
    }
    let follower = replica(&servers);
    let (term, keys) = (leader.guard.leader, keys());
    let hole = keys.journal(3)..keys.journal(4);
    assert!(
        follower
            .client
            .delete(&keys, term, &[hole], LIMIT)
            .await
            .unwrap()
    );
    let damage = || async {
        let loaded = follower.load(Progress::default()).await.unwrap();
        loaded.damage.unwrap().to_string()
    };
    let error = damage().await;
    assert!(error.contains("record 4 where 3 was expected"), "{error}");
    let end = keys.journal(4)..keys.journal(5);
    assert!(
        follower
            .client
            .delete(&keys, term, &[end], LIMIT)
            .await
            .unwrap()
    );
    let short = ReplicaError::Short {
        found: 2,
        expected: 4,
    };
    assert_eq!(damage().await, short.to_string());
}

/// A leader that goes on without a key of its journal would acknowledge what no computer can read.
#[tokio::test]
async fn no_transaction_of_the_leader_succeeds_once_a_key_that_makes_the_journal_is_gone() {
    let servers = Servers::new(1).await;
    let keys = keys();
    let kinds = [
        keys.origin(),
        keys.leader(),
        keys.alive(),
        keys.journal(2),
        keys.prefix().to_owned(),
    ];
    for gone in kinds {
        let mut leader = Leader::new(&servers).await;
        leader.commit(&[record(1, 1), record(2, 1)]).await;
        let end = format!("{gone}\u{7f}");
        let all = [gone.clone()..end];
        let etcd = &leader.replica.client;
        let deleted = etcd.delete(&keys, leader.guard.leader, &all, LIMIT).await;
        assert!(deleted.unwrap());
        let beat = Op::Beat {
            guard: leader.guard,
            claim: 1,
            claimed_at: 0,
            beat: 9,
            seq: 2,
            released: None,
            settled: true,
        };
        let answer = leader.replica.run(&settings("a"), &beat, None, None).await;
        let EtcdAnswer::Is(view) = answer.unwrap() else {
            panic!("{gone} is gone, and the leader goes on");
        };
        let last = gone == keys.journal(2);
        assert!(view.is_torn() || view.leader.is_none() || last, "{view:?}");
    }
}

/// A restored etcd gives revisions out again, so another computer may have got this leader's.
#[tokio::test]
async fn a_transaction_of_another_claim_does_not_succeed_at_the_same_revisions() {
    let servers = Servers::new(1).await;
    let leader = Leader::new(&servers).await;
    let beat = |claim| Op::Beat {
        guard: leader.guard,
        claim,
        claimed_at: 0,
        beat: 1,
        seq: 0,
        released: None,
        settled: true,
    };
    for (name, claim) in [("b", 1), ("a", 2)] {
        let answer = leader
            .replica
            .run(&settings(name), &beat(claim), None, None)
            .await;
        assert!(matches!(answer, Ok(EtcdAnswer::Is(_))), "{answer:?}");
    }
    let answer = leader
        .replica
        .run(&settings("a"), &beat(1), None, None)
        .await;
    assert!(
        matches!(answer, Ok(EtcdAnswer::Applied { .. })),
        "{answer:?}"
    );
}

#[tokio::test]
async fn a_whole_state_can_be_replaced_in_the_middle_of_the_journal() {
    let servers = Servers::new(1).await;
    let mut leader = Leader::new(&servers).await;
    leader.commit(&[record(1, 10), record(2, 10)]).await;
    let mut state = Checkpoint {
        seq: 3,
        ..Checkpoint::default()
    };
    let value = "z".repeat(1 << 20).as_str().into();
    state.snapshot.params.insert("map".to_owned(), value);
    let encoded = format::encode_checkpoint(&state, 1).unwrap();
    let keys = &leader.replica.keys;
    let (parts, entry) = journal::state(keys, 3, &encoded.bytes);
    let replica = leader.replica.clone();
    assert!(replica.prepare(leader.guard.leader, &parts).await.unwrap());
    leader.beat += 1;
    let beat = Op::Beat {
        guard: leader.guard,
        claim: 1,
        claimed_at: 0,
        beat: leader.beat,
        seq: 3,
        released: None,
        settled: true,
    };
    let answer = replica.run(&settings("a"), &beat, Some(&entry), None).await;
    let EtcdAnswer::Applied { revision, seq: 3 } = answer.unwrap() else {
        panic!("no journal holds the state");
    };
    (leader.guard.alive, leader.guard.seq) = (revision, 3);
    leader.commit(&[record(4, 10)]).await;
    for known in [0, 2] {
        let progress = Progress::after_snapshot(known, 0);
        let loaded = replica.load(progress).await.unwrap();
        assert!(loaded.checkpoint.as_ref() == Some(&state), "{known}");
        assert_eq!(loaded.records, [record(4, 10)]);
        assert_eq!(loaded.progress.seq, 4);
    }
}
