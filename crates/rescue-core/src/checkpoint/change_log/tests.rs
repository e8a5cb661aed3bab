use super::*;
use crate::checkpoint::format::Checkpoint;
use ros1_master::{master::Method, xmlrpc::Value};
use test_support::dice::Dice;

fn set(key: &str, value: i32) -> Request {
    Request::new(
        Method::SetParam,
        ["/n".into(), key.into(), Value::from(value)],
    )
}

fn publish(node: &str, topic: &str, api: &str) -> Request {
    Request::new(Method::RegisterPublisher, [node, topic, "x/Y", api])
}

/// Writes a history: files whose records are `calls`, each with its time, `each` records in a file. The snapshot of
/// each file has the time of the last record before it.
fn history(calls: &[(u64, Request)], each: usize) -> Vec<Vec<u8>> {
    let mut master = Master::default();
    let (mut seq, mut at) = (0, 0);
    let mut files = Vec::new();
    for calls in calls.chunks(each) {
        let mut checkpoint = Checkpoint {
            seq,
            snapshot: master.snapshot(),
            ..Checkpoint::default()
        };
        checkpoint.session.at = at;
        let encoded = format::encode_checkpoint(&checkpoint, 1).unwrap();
        let mut bytes = encoded.bytes;
        for (time, call) in calls {
            (seq, at) = (seq + 1, *time);
            let origin = Origin::At([10, 0, 0, 5].into());
            let entry = RecordContent::labelled(call.clone(), Label { at, origin });
            bytes.extend(format::encode_record(&Record { seq, entry }, encoded.stamp).unwrap());
            master.apply(call);
        }
        files.push(bytes);
    }
    files
}

fn reader() -> LogReader {
    LogReader::new(crate::hide::DEFAULT.parse().unwrap())
}

fn text(entry: &LogEntry) -> String {
    let change = entry.change.as_ref().unwrap();
    let shown = |value: &Option<String>| value.clone().unwrap_or_else(|| "-".to_owned());
    format!(
        "{} {} {} {} {:?} {}: {} -> {}",
        entry.seq,
        entry.at,
        shown(&entry.caller),
        shown(&entry.from),
        change.what,
        change.name,
        shown(&change.a),
        shown(&change.b)
    )
}

#[test]
fn the_log_has_old_and_new_values_and_nothing_that_changed_nothing() {
    let calls = [
        set("/a/x", 1),
        set("/a/x", 1),
        set("/a/x", 2),
        set("/wifi/password", 7),
        publish("/n", "/t", "http://n:1/"),
        publish("/n", "/t", "http://n:1/"),
        publish("/n", "/t", "http://n:2/"),
        Request::new(Method::UnregisterPublisher, ["/n", "/t", "http://n:2/"]),
        Request::new(Method::DeleteParam, ["/n", "/a"]),
    ];
    let calls: Vec<_> = (1..).map(|at| at * 10).zip(calls).collect();
    let expected = [
        "1 10 /n 10.0.0.5 Parameter /a/x: - -> 1",
        "3 30 /n 10.0.0.5 Parameter /a/x: 1 -> 2",
        "4 40 /n 10.0.0.5 Parameter /wifi/password: - -> \"(hidden)\"",
        "5 50 /n 10.0.0.5 Node /n: - -> http://n:1/",
        "5 50 /n 10.0.0.5 Publisher /t: - -> x/Y",
        "7 70 /n 10.0.0.5 Node /n: http://n:1/ -> http://n:2/",
        "8 80 /n 10.0.0.5 Node /n: http://n:2/ -> -",
        "8 80 /n 10.0.0.5 Publisher /t: x/Y -> -",
        "9 90 /n 10.0.0.5 Parameter /a/x: 2 -> -",
    ];
    for each in [1, 2, 3, 100] {
        let mut reader = reader();
        for file in history(&calls, each) {
            reader.read(&file).unwrap();
            // A file that is read again adds nothing.
            reader.read(&file).unwrap();
        }
        let entries: Vec<_> = reader.take_entries().iter().map(text).collect();
        assert_eq!(entries, expected, "{each} records in a file");
    }
}

#[test]
fn a_change_without_a_record_and_the_events_of_a_session_are_listed() {
    let mut reader = reader();
    let file = |value: i32, change: &dyn Fn(&mut Session)| {
        let mut master = Master::default();
        master.apply(&set("/a", value));
        let mut checkpoint = Checkpoint {
            seq: 5,
            snapshot: master.snapshot(),
            ..Checkpoint::default()
        };
        checkpoint.session.at = 77;
        change(&mut checkpoint.session);
        format::encode_checkpoint(&checkpoint, 1).unwrap().bytes
    };
    reader.read(&file(1, &|_| ())).unwrap();
    assert_eq!(reader.take_entries(), []);
    reader.read(&file(2, &|_| ())).unwrap();
    let entries: Vec<_> = reader.take_entries().iter().map(text).collect();
    assert_eq!(entries, ["5 77 - - Parameter /a: 1 -> 2"]);
    let events = |change: &dyn Fn(&mut Session), reader: &mut LogReader| {
        reader.read(&file(2, change)).unwrap();
        let entries = reader.take_entries().into_iter();
        entries.map(|it| it.event.unwrap()).collect::<Vec<_>>()
    };
    let rescued = events(&|session| session.incarnation = 2, &mut reader);
    assert_eq!(
        rescued,
        ["another master was brought to the state: number 2"]
    );
    let closed = |session: &mut Session| (session.incarnation, session.closed) = (2, true);
    assert_eq!(events(&closed, &mut reader), ["rosrescue was stopped"]);
    let term =
        |session: &mut Session| (session.incarnation, session.closed, session.term) = (2, true, 9);
    assert_eq!(
        events(&term, &mut reader),
        ["a computer took over as the leader: term 9"]
    );
}

/// The state at `time` in a history of these files, oldest first.
fn past(files: &[Vec<u8>], time: u64) -> Option<Moment> {
    let mut found = None;
    for file in files {
        found = Some(moment(file, time).unwrap()?);
        if span(file).unwrap().latest > time {
            break;
        }
    }
    found
}

/// The clock jumps back and forth by hours. The state at a time is that before the first record with a later time,
/// however the records are spread over files.
#[test]
fn a_clock_that_jumps_reorders_and_loses_nothing() {
    for seed in 0..30 {
        let mut dice = Dice(seed);
        let mut at = 1_764_000_000_000;
        let calls: Vec<_> = (0..60)
            .map(|value| {
                at = match dice.below(10) {
                    0 => at - 7_200_000,
                    1 => at + 7_200_000,
                    _ => at + 1_000,
                };
                let key = format!("/p{}", dice.below(4));
                (at, set(&key, value))
            })
            .collect();
        let files = history(&calls, 1 + dice.below(20) as usize);
        for (time, _) in &calls {
            let later = calls.iter().position(|(at, _)| at > time);
            let end = later.unwrap_or(calls.len());
            let mut oracle = Master::default();
            for (_, call) in &calls[..end] {
                oracle.apply(call);
            }
            let found = past(&files, *time);
            let Some(found) = found.filter(|found| found.seq > 0) else {
                assert_eq!(end, 0, "seed {seed}, time {time}");
                continue;
            };
            assert!(found.exact);
            assert_eq!(found.seq, end as u64, "seed {seed}, time {time}");
            assert!(found.rebuilt.mirror == oracle, "seed {seed}, time {time}");
        }
        let mut reader = reader();
        files.iter().for_each(|file| reader.read(file).unwrap());
        let entries = reader.take_entries();
        assert!(entries.iter().map(|entry| entry.seq).is_sorted());
        assert_eq!(entries.len(), 60, "seed {seed}");
    }
}

#[test]
fn before_the_first_time_there_is_no_state() {
    let files = history(&[(50, set("/a", 1)), (60, set("/a", 2))], 1);
    assert!(moment(&files[1], 49).unwrap().is_none());
    // The first snapshot has no time, so it counts as older than everything.
    assert_eq!(moment(&files[0], 49).unwrap().unwrap().seq, 0);
    assert!(moment(b"text", 1).is_err());
}
