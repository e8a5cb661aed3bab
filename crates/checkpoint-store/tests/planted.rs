//! Files that others have planted beside a checkpoint.

#![allow(clippy::unwrap_used, reason = "a test")]

use std::fs::{self, File};
use std::io::{self, Write};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

use checkpoint_store::{Store, change_log::files};
use flate2::{Compression, read::MultiGzDecoder, write::GzEncoder};
use rescue_core::checkpoint::format::{Checkpoint, Label, RecordContent, decode};
use ros1_master::{
    master::{Method, Request},
    xmlrpc::Value,
};

/// Sets `/a` `writes` times, and begins a part of the log for every 20 writes.
fn record_parts(path: &Path, writes: u64) -> Option<String> {
    let mut store = Store::open(path).unwrap().0;
    store.keep_log(64 << 10);
    let mut trouble = None;
    for write in 0..writes {
        if write % 20 == 0 {
            // A snapshot that does not follow from the records begins a part.
            let checkpoint = Checkpoint {
                seq: store.seq(),
                follows: false,
                ..Checkpoint::default()
            };
            store.begin(&checkpoint).unwrap();
            trouble = store.take_log_trouble().or(trouble);
        }
        let params = [
            Value::from("/n"),
            "/a".into(),
            i32::try_from(write).unwrap().into(),
        ];
        let call = Request::new(Method::SetParam, params);
        let labelled = RecordContent::labelled(call, Label::default());
        store.append(&[labelled]).unwrap();
    }
    trouble
}

fn beside(path: &Path, suffix: &str) -> PathBuf {
    format!("{}{suffix}", path.display()).into()
}

/// The numbers of the records in the readable files of the log, and why the others are unreadable.
fn numbers(path: &Path) -> (Vec<u64>, Vec<String>) {
    let (mut numbers, mut unread) = (Vec::new(), Vec::new());
    for file in files(path).unwrap() {
        match file.read() {
            Ok(text) => {
                let records = decode(&text).unwrap().records.into_iter();
                numbers.extend(records.map(|record| record.seq));
            }
            Err(error) => unread.push(format!("{}: {error}", file.path.display())),
        }
    }
    numbers.dedup();
    (numbers, unread)
}

#[test]
fn planted_links_are_neither_followed_nor_do_they_stop_the_log() {
    let folder = tempfile::tempdir().unwrap();
    let (path, victim) = (folder.path().join("c.yaml"), folder.path().join("victim"));
    fs::write(&victim, "a secret of another file").unwrap();
    record_parts(&path, 60);
    let before = numbers(&path).0;
    // The next numbers, among them those of parts that will be closed.
    for (suffix, target) in [
        (".log-3", victim.as_path()),
        (".log-4", Path::new("/dev/zero")),
        (".log-5.gz", &victim),
        (".log-9", &victim),
    ] {
        let _ = fs::remove_file(beside(&path, suffix));
        symlink(target, beside(&path, suffix)).unwrap();
    }
    record_parts(&path, 200);
    let (after, unread) = numbers(&path);
    for file in fs::read_dir(folder.path()).unwrap() {
        let file = file.unwrap().path();
        let is_link = file.symlink_metadata().unwrap().is_symlink();
        if !is_link && file.extension().is_some_and(|it| it == "gz") {
            let text = MultiGzDecoder::new(File::open(&file).unwrap());
            let text = io::read_to_string(text).unwrap();
            assert!(!text.contains("a secret"), "{}", file.display());
        }
    }
    assert_eq!(
        fs::read_to_string(&victim).unwrap(),
        "a secret of another file"
    );
    let new: Vec<u64> = after
        .iter()
        .copied()
        .filter(|number| *number > before.len() as u64)
        .collect();
    assert_eq!(new.len(), 200, "{after:?}");
    assert!(
        unread
            .iter()
            .any(|why| why.contains("log-9: it is a symbolic link")),
        "{unread:?}"
    );
}

#[test]
fn a_planted_number_hides_no_history() {
    for number in [u64::MAX, u64::MAX - 1, 1 << 40] {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("c.yaml");
        record_parts(&path, 60);
        fs::copy(&path, beside(&path, &format!(".log-{number}"))).unwrap();
        assert_eq!(record_parts(&path, 60), None);
        let (numbers, unread) = numbers(&path);
        assert_eq!(numbers, (1..=120).collect::<Vec<_>>(), "{number}");
        assert!(
            unread.iter().any(|why| why.contains(&number.to_string())),
            "{unread:?}"
        );
    }
}

#[test]
fn a_planted_archive_is_refused_before_it_takes_memory() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("c.yaml");
    record_parts(&path, 60);
    let planted = beside(&path, ".log-7.gz");
    let first_line = fs::read_to_string(&path).unwrap();
    let first_line = first_line.lines().next().unwrap().to_owned() + "\n";
    for start in ["", &first_line] {
        let mut encoder = GzEncoder::new(File::create(&planted).unwrap(), Compression::fast());
        encoder.write_all(start.as_bytes()).unwrap();
        let zeros = vec![0; 1 << 20];
        for _ in 0..100 {
            encoder.write_all(&zeros).unwrap();
        }
        encoder.finish().unwrap();
        let file = files(&path)
            .unwrap()
            .into_iter()
            .find(|file| file.path == planted);
        let before = peak_memory();
        let Err(error) = file.unwrap().read() else {
            panic!("a planted file was believed");
        };
        let error = error.to_string();
        let taken = peak_memory() - before;
        // 64 MiB of records, at most.
        assert!(taken < 80 << 10, "{taken} KiB: {error}");
        assert!(error.contains("is not a part of the log"), "{error}");
    }
}

/// The most memory that this process has had, in KiB.
fn peak_memory() -> u64 {
    let status = fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    line.unwrap()
        .trim()
        .trim_end_matches(" kB")
        .parse()
        .unwrap()
}
