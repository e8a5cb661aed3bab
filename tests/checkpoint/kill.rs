//! A process that records on a real disk is killed with SIGKILL at any moment.

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use checkpoint_store::{Store, SyncJob};
use rescue_core::checkpoint::format::{Checkpoint, RecordContent};
use ros1_master::{
    master::{Method, Request},
    xmlrpc::Value,
};

const FILE: &str = "ROSRESCUE_TEST_CHECKPOINT";

/// The process to kill: records without end, with syncs and compactions in between, and prints the number of
/// each record once it has been recorded. Record `n` sets the parameter `n`.
fn write_until_killed(path: &Path) -> ! {
    let (mut store, _) = Store::open(path).unwrap();
    let checkpoint = |seq: u64| {
        let mut checkpoint = Checkpoint {
            seq,
            ..Checkpoint::default()
        };
        checkpoint
            .snapshot
            .params
            .insert("n".to_owned(), Value::from(seq as i32));
        checkpoint
    };
    store.begin(&checkpoint(store.seq())).unwrap();
    let mut output = std::io::stderr();
    let mut append = |store: &mut Store| {
        let next = store.seq() + 1;
        let params = ["/w".into(), "/n".into(), Value::from(next as i32)];
        let call = Request::new(Method::SetParam, params);
        let seq = store.append(&[RecordContent::call(call)]).unwrap();
        writeln!(output, "recorded {seq}").unwrap();
    };
    loop {
        for _ in 0..20 {
            append(&mut store);
        }
        let job = store.begin_compaction(checkpoint(store.seq())).unwrap();
        append(&mut store);
        let done = std::thread::spawn(move || job.run());
        for _ in 0..5 {
            append(&mut store);
        }
        let done = done.join().unwrap();
        append(&mut store);
        store.finish_compaction(done).unwrap();
        let synced = store.sync_job().map(SyncJob::run);
        store.synced(synced.unwrap()).unwrap();
    }
}

#[test]
fn acknowledged_records_survive_a_kill() {
    // The test starts itself again as the process to kill.
    if let Some(path) = std::env::var_os(FILE) {
        write_until_killed(path.as_ref());
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("c.yaml");
    let rounds = 40;
    let mut least = 0;
    for round in 0..rounds {
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args([
                "--exact",
                "kill::acknowledged_records_survive_a_kill",
                "--nocapture",
                "--test-threads=1",
            ])
            .env(FILE, &path)
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
        // Kill it while it records, at a time that differs from round to round.
        let first = lines.next().unwrap().unwrap();
        std::thread::sleep(Duration::from_micros(round * 997 % 20_000));
        child.kill().unwrap();
        child.wait().unwrap();
        // The last line may be incomplete.
        let said = std::iter::once(first).chain(lines.map_while(Result::ok));
        let last = said
            .filter_map(|line| line.strip_prefix("recorded ")?.parse::<u64>().ok())
            .max();
        least = least.max(last.unwrap_or(0));

        let (mut store, loaded) = Store::open(&path).unwrap();
        let loaded = loaded.unwrap();
        assert!(
            loaded.exact && loaded.damage.is_empty(),
            "{:?}",
            loaded.damage
        );
        let state = match loaded.records.last().map(|record| &record.entry) {
            Some(RecordContent::Call { call, .. }) => call.params()[2].clone(),
            _ => loaded.checkpoint.unwrap().snapshot.params["n"].clone(),
        };
        assert_eq!(state, Value::from(store.seq() as i32));
        assert!(
            store.seq() >= least,
            "round {round}: found {} of at least {least} records",
            store.seq()
        );
        // In every other round the next process starts from the file as the kill has left it.
        if round % 2 == 0 {
            let mut checkpoint = Checkpoint {
                seq: store.seq(),
                ..Checkpoint::default()
            };
            checkpoint.snapshot.params.insert("n".to_owned(), state);
            store.begin(&checkpoint).unwrap();
        }
    }
    assert!(least > rounds);
}
