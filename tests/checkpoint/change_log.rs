//! The log of changes over a long time.

use std::path::Path;
use std::time::Instant;

use checkpoint_store::{Store, change_log::files};
use rescue_core::checkpoint::{
    change_log::LogReader,
    format::{Checkpoint, Label, Origin, RecordContent},
};
use ros1_master::{
    master::{Master, Method, Request},
    xmlrpc::Value,
};

/// Time of the first record, in milliseconds since 1970.
const START: u64 = 1_764_115_200_000;

/// A robot with this many nodes, with seven registrations each.
fn robot(nodes: usize) -> Master {
    let mut master = Master::default();
    for number in 0..nodes {
        let (node, api) = (format!("/node_{number:03}"), format!("http://r:{number}/"));
        for topic in 0..5 {
            let topic = format!("/topic_{}", number * 5 + topic);
            let params = [&*node, &*topic, "std_msgs/String", &*api];
            master.apply(&Request::new(Method::RegisterPublisher, params));
        }
        for service in ["get_loggers", "set_logger_level"] {
            let service = format!("{node}/{service}");
            let params = [&*node, &*service, "rosrpc://r:5", &*api];
            master.apply(&Request::new(Method::RegisterService, params));
        }
    }
    master
}

/// Records a write per second for this long, as `benches/computers/day.rs` does. Every hour one of them sets `/rare`.
/// Returns the bytes of all records.
fn record(path: &Path, seconds: u64, nodes: usize) -> u64 {
    let mut master = robot(nodes);
    let mut store = Store::open(path).unwrap().0;
    store.keep_log(48 << 20);
    let begin = |store: &mut Store, master: &Master| {
        let mut checkpoint = Checkpoint {
            seq: store.seq(),
            snapshot: master.snapshot(),
            follows: true,
            ..Checkpoint::default()
        };
        checkpoint.session.at = START + store.seq() * 1_000;
        store.begin(&checkpoint).unwrap();
    };
    begin(&mut store, &master);
    let mut bytes = 0;
    for second in 1..=seconds {
        let key = match second % 3_600 {
            0 => "/rare".to_owned(),
            _ => format!("/robot/part_{}/state", second % 50),
        };
        let value = second as f64 * 0.1;
        let params: [Value; 3] = ["/robot_state".into(), key.into(), value.into()];
        let call = Request::new(Method::SetParam, params);
        let label = Label {
            at: START + second * 1_000,
            origin: Origin::At([127, 0, 0, 1].into()),
        };
        master.apply(&call);
        let before = store.journal_bytes();
        store
            .append(&[RecordContent::labelled(call, label)])
            .unwrap();
        bytes += store.journal_bytes() - before;
        if store.wants_compaction() {
            begin(&mut store, &master);
        }
    }
    assert_eq!(store.take_log_trouble(), None);
    bytes
}

fn read_all(path: &Path) -> LogReader {
    let mut reader = LogReader::new("".parse().unwrap());
    for file in files(path).unwrap() {
        reader.read(&file.read().unwrap()).unwrap();
    }
    reader
}

/// `ROSRESCUE_DAYS=30 ROSRESCUE_LOG_FOLDER=FOLDER cargo test --release --test checkpoint a_long_log -- --nocapture`
/// measures a month. The folder then has a checkpoint for `rosrescue log`.
#[test]
fn a_long_log_has_every_record_once() {
    let temporary = tempfile::tempdir().unwrap();
    let folder = std::env::var("ROSRESCUE_LOG_FOLDER").map(Into::into);
    let folder = folder.unwrap_or_else(|_| temporary.path().to_owned());
    let path = folder.join("c.yaml");
    let days = std::env::var("ROSRESCUE_DAYS").map(|days| days.parse::<u64>().unwrap());
    let seconds = days.map_or(20_000, |days| days * 86_400);
    let bytes = record(&path, seconds, 80);
    let parts = files(&path).unwrap();
    assert!(parts.len() > 3, "{}", parts.len());
    let size: u64 = parts
        .iter()
        .filter_map(|file| Some(file.path.metadata().ok()?.len()))
        .sum();
    let begun = Instant::now();
    let entries = read_all(&path).take_entries();
    println!(
        "{seconds} records of {} bytes; the log has {:.1} MiB, and is read in {:.1?}",
        bytes / seconds,
        size as f64 / 1_048_576.0,
        begun.elapsed()
    );
    let seqs: Vec<u64> = entries.iter().map(|entry| entry.seq).collect();
    assert_eq!(seqs, (1..=seconds).collect::<Vec<_>>());
}
