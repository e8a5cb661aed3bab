//! Watches while members of etcd die, and after etcd has compacted the watched revisions.

use std::time::{Duration, Instant};

use rescue_core::cluster::journal::Put;
use rosrescue::cluster::etcd::{Credentials, Watch, WatchEnd};

use crate::servers::{LIMIT, Servers, keys};

/// How long a watch may be silent: longer than a write takes, and shorter than a test may take.
const QUIET: Duration = Duration::from_secs(2);

fn entry(seq: u64) -> Put {
    Put {
        key: keys().journal(seq),
        value: format!("record {seq}").into_bytes(),
    }
}

/// Follows the journal's entries until `last`. Repeated entries are allowed, gaps are not.
async fn follow(watch: &mut Watch, seen: &mut u64, last: u64) {
    while *seen < last {
        let end = Instant::now() + LIMIT;
        let changes = loop {
            // The real driver also stops waiting again and again, because it waits for other events too.
            if let Ok(changes) = tokio::time::timeout(QUIET / 20, watch.next()).await {
                break changes;
            }
            assert!(Instant::now() < end, "the watch is silent");
        };
        for change in changes.unwrap() {
            let seq = keys().seq_of(&change.key).unwrap();
            // A repeated entry is allowed, a gap is not.
            assert!(seq <= *seen + 1, "{seq} after {seen}");
            *seen = seq.max(*seen);
        }
    }
}

#[tokio::test]
async fn a_watch_continues_at_another_member_and_misses_nothing() {
    let mut servers = Servers::new(3).await;
    let (writer, keys) = (servers.client_of(1, Credentials::default()), keys());
    let mut watch = servers.client().watch(keys.small(), 0, QUIET);
    let (mut seen, mut seq) = (0, 0);
    for (member, hangs) in [(0, false), (1, true), (2, false)] {
        let write = async |upto: u64, seq: &mut u64| {
            while *seq < upto {
                *seq += 1;
                assert!(writer.put(&keys, 0, &[entry(*seq)], LIMIT).await.unwrap());
            }
        };
        write(seq + 10, &mut seq).await;
        follow(&mut watch, &mut seen, seq).await;
        if hangs {
            servers.stop(member)
        } else {
            servers.kill(member)
        }
        write(seq + 10, &mut seq).await;
        follow(&mut watch, &mut seen, seq).await;
        if hangs {
            servers.go_on(member)
        } else {
            servers.start(member)
        }
    }
    assert_eq!(seen, 60);
}

/// A client that sends no requests of its own does not notice otherwise that its member is silent.
#[tokio::test]
async fn a_watch_leaves_a_member_that_answers_nothing_before_its_silence_is_too_long() {
    let servers = Servers::new(3).await;
    let (writer, keys) = (servers.client_of(1, Credentials::default()), keys());
    let mut watch = servers.client().watch(keys.small(), 0, 10 * LIMIT);
    let (mut seen, first, second) = (0, [entry(1)], [entry(2)]);
    assert!(writer.put(&keys, 0, &first, LIMIT).await.unwrap());
    follow(&mut watch, &mut seen, 1).await;
    servers.stop(0);
    assert!(writer.put(&keys, 0, &second, LIMIT).await.unwrap());
    follow(&mut watch, &mut seen, 2).await;
    servers.go_on(0);
}

#[tokio::test]
async fn a_watch_reports_that_etcd_has_discarded_older_changes() {
    let servers = Servers::new(1).await;
    let (client, keys) = (servers.client(), keys());
    let puts: Vec<_> = (1..=10).map(entry).collect();
    assert!(client.put(&keys, 0, &puts, LIMIT).await.unwrap());
    let found = client.range(&keys.journal_after(0), LIMIT).await.unwrap();
    client.compact(found.revision, LIMIT).await.unwrap();
    let mut watch = client.watch(keys.small(), 1, QUIET);
    let end = watch.next().await.unwrap_err();
    assert!(matches!(end, WatchEnd::Compacted), "{end:?}");
    // A watch continues from the revision that has been read.
    let mut watch = client.watch(keys.small(), found.revision, QUIET);
    assert!(client.put(&keys, 0, &[entry(11)], LIMIT).await.unwrap());
    let mut seen = 10;
    follow(&mut watch, &mut seen, 11).await;
}

#[tokio::test]
async fn long_values_arrive_complete_and_their_parts_are_not_watched() {
    let servers = Servers::new(1).await;
    let (client, keys) = (servers.client(), keys());
    let value = vec![b'x'; 1 << 20];
    let part = Put {
        key: format!("{}values/blob/1", keys.prefix()),
        value: value.clone(),
    };
    let large = |seq| Put {
        key: keys.journal(seq),
        value: value.clone(),
    };
    let all = [part, large(1), large(2), large(3), large(4), large(5)];
    assert!(client.put(&keys, 0, &all, LIMIT).await.unwrap());
    let mut watch = client.watch(keys.small(), 0, LIMIT);
    let mut seen = 0;
    follow(&mut watch, &mut seen, 5).await;
}

/// Only deletions of parts are received. They do not move the watch past changes that have not arrived.
#[tokio::test]
async fn deletions_of_parts_are_received_and_hide_no_other_change() {
    let mut servers = Servers::new(1).await;
    let (client, keys) = (servers.client(), keys());
    let part = |seq| Put {
        key: format!("{}values/blob/{seq:020}/1234/0", keys.prefix()),
        value: b"part".to_vec(),
    };
    let watch = client.watch(keys.small(), 0, LIMIT);
    let mut watch = watch.with_deletions(keys.values());
    for (seq, restarts) in [(1, false), (2, true), (3, false)] {
        assert!(client.put(&keys, 0, &[part(seq)], LIMIT).await.unwrap());
        let deleted = [keys.values()];
        assert!(client.delete(&keys, 0, &deleted, LIMIT).await.unwrap());
        assert!(client.put(&keys, 0, &[entry(seq)], LIMIT).await.unwrap());
        if restarts {
            servers.kill(0);
            servers.start(0);
        }
        let (mut gone, mut added) = (false, false);
        while !gone || !added {
            for change in watch.next().await.unwrap() {
                let is_part = keys.values().contains(&change.key);
                assert_eq!(is_part, change.kv.is_none(), "{change:?}");
                gone |= keys.record_of(&change.key) == Some(seq) && is_part;
                added |= keys.seq_of(&change.key) == Some(seq);
            }
        }
    }
}
