//! Files that are damaged, belong to another program, or are gone.

use std::fs::{self, File};
use std::path::Path;

use checkpoint_store::{OpenError, Store};

use super::{checkpoint, entry, names, place, seqs, started};

#[test]
fn a_torn_record_is_cut_off_and_kept() {
    let (folder, path) = place();
    drop(started(&path, 3));
    let bytes = fs::read(&path).unwrap();
    fs::write(&path, &bytes[..bytes.len() - 5]).unwrap();
    let (mut store, loaded) = Store::open(&path).unwrap();
    let loaded = loaded.unwrap();
    assert_eq!(loaded.records.len(), 2);
    assert!(loaded.exact && loaded.damage.is_empty());
    assert!(loaded.torn.unwrap().contains("c.yaml.torn-1"));
    let torn = fs::read_to_string(folder.path().join("c.yaml.torn-1")).unwrap();
    assert!(torn.starts_with("- {seq: 3"));

    // Recording continues where the torn record was cut off, and that record never comes back.
    store.begin(&checkpoint(2)).unwrap();
    store.append(&[entry(33)]).unwrap();
    drop(store);
    let (_, loaded) = Store::open(&path).unwrap();
    let loaded = loaded.unwrap();
    assert!(loaded.exact && loaded.torn.is_none() && loaded.damage.is_empty());
    assert_eq!(
        loaded
            .records
            .iter()
            .map(|r| (r.seq, r.entry.clone()))
            .collect::<Vec<_>>(),
        [(3, entry(33))]
    );
}

#[test]
fn the_previous_generation_replaces_a_damaged_snapshot() {
    let (folder, path) = place();
    let mut store = started(&path, 3);
    store.begin(&checkpoint(3)).unwrap();
    store.append(&[entry(4), entry(5)]).unwrap();
    drop(store);
    let whole = fs::read(&path).unwrap();
    for at in [10, 200] {
        let mut bytes = whole.clone();
        bytes[at] ^= 4;
        fs::write(&path, &bytes).unwrap();
        let (store, loaded) = Store::open(&path).unwrap();
        let loaded = loaded.unwrap();
        assert_eq!(loaded.checkpoint, Some(checkpoint(0)));
        assert_eq!(seqs(&loaded.records), [1, 2, 3, 4, 5]);
        assert!(loaded.exact, "{:?}", loaded.damage);
        assert!(
            loaded
                .damage
                .iter()
                .any(|sentence| sentence.contains("c.yaml.broken-"))
        );
        assert_eq!(store.seq(), 5);
    }
    assert_eq!(
        names(folder.path()),
        [
            "c.yaml",
            "c.yaml.broken-1",
            "c.yaml.broken-2",
            "c.yaml.lock",
            "c.yaml.previous"
        ]
    );
}

#[test]
fn a_damaged_file_never_replaces_a_good_previous_generation() {
    let (_folder, path) = place();
    let mut store = started(&path, 3);
    store.begin(&checkpoint(3)).unwrap();
    drop(store);
    for _ in 0..2 {
        let mut bytes = fs::read(&path).unwrap();
        bytes[200] ^= 4;
        fs::write(&path, &bytes).unwrap();
        let (mut store, loaded) = Store::open(&path).unwrap();
        let loaded = loaded.unwrap();
        assert_eq!(loaded.checkpoint, Some(checkpoint(0)));
        assert_eq!(loaded.records.len(), 3);
        store.begin(&checkpoint(3)).unwrap();
    }
}

#[test]
fn a_file_restored_from_a_copy_has_the_state_of_the_copy() {
    let (_folder, path) = place();
    let mut store = started(&path, 2);
    let copy = fs::read(&path).unwrap();
    store.begin(&checkpoint(2)).unwrap();
    store.append(&[entry(3)]).unwrap();
    store.begin(&checkpoint(3)).unwrap();
    drop(store);
    fs::write(&path, copy).unwrap();
    let loaded = Store::open(&path).unwrap().1.unwrap();
    assert_eq!(loaded.checkpoint, Some(checkpoint(0)));
    assert_eq!(loaded.records.len(), 2);
    assert!(
        loaded.exact && loaded.damage.is_empty(),
        "{:?}",
        loaded.damage
    );
}

#[test]
fn a_lost_record_is_reported_and_the_others_are_used() {
    let (_folder, path) = place();
    drop(started(&path, 3));
    let text = fs::read_to_string(&path).unwrap();
    fs::write(&path, text.replacen("\"/p2\"", "\"/q2\"", 1)).unwrap();
    let (mut store, loaded) = Store::open(&path).unwrap();
    let loaded = loaded.unwrap();
    assert_eq!(seqs(&loaded.records), [1, 3]);
    assert!(!loaded.exact);
    assert_eq!(loaded.damage.len(), 3, "{:?}", loaded.damage);
    assert!(loaded.damage[1].contains("the records 2 to 2 are lost"));
    store.begin(&checkpoint(3)).unwrap();
}

#[test]
fn without_any_snapshot_the_records_are_still_used() {
    let (_folder, path) = place();
    drop(started(&path, 3));
    let mut bytes = fs::read(&path).unwrap();
    bytes[200] ^= 1;
    fs::write(&path, &bytes).unwrap();
    let loaded = checkpoint_store::read(&path).unwrap().unwrap();
    assert!(loaded.checkpoint.is_none() && !loaded.exact);
    assert_eq!(loaded.records.len(), 3);
}

#[test]
fn a_file_removed_under_a_running_store_is_noticed_by_the_next_check() {
    let (_folder, path) = place();
    let mut store = started(&path, 1);
    fs::remove_file(&path).unwrap();
    let done = store.check_job().unwrap().run();
    assert!(
        store
            .checked(done)
            .unwrap_err()
            .to_string()
            .contains("removed")
    );
    assert!(store.unprotected().is_some());
    store.begin(&checkpoint(1)).unwrap();
    assert!(store.unprotected().is_none() && path.is_file());
}

#[test]
fn files_that_a_crash_left_unfinished_are_removed() {
    let (folder, path) = place();
    drop(started(&path, 1));
    for name in [
        "c.yaml.new-7",
        "c.yaml.previous.new",
        "c.yaml.broken-2.new",
        "c.yaml.rescue-3.new",
        "c.yaml.log-4.gz.new",
        "c.yaml.report.new",
    ] {
        fs::write(folder.path().join(name), "# rosrescue").unwrap();
    }
    let (store, _) = Store::open(&path).unwrap();
    drop(store);
    assert_eq!(names(folder.path()), ["c.yaml", "c.yaml.lock"]);
}

#[test]
fn files_of_other_programs_with_similar_names_stay() {
    let (folder, path) = place();
    drop(started(&path, 1));
    let others = [
        // Of another rosrescue, whose checkpoint is `c.yaml.2`.
        "c.yaml.2.previous.new",
        "c.yaml.log-x.gz.new",
        "c.yaml.log.new",
        "c.yaml.new-x",
        "c.yaml.urdf.new",
        "d.yaml.new-1",
    ];
    for name in others {
        fs::write(folder.path().join(name), "# rosrescue").unwrap();
    }
    let (store, _) = Store::open(&path).unwrap();
    drop(store);
    let mut expected = [&["c.yaml", "c.yaml.lock"][..], &others].concat();
    expected.sort_unstable();
    assert_eq!(names(folder.path()), expected);
}

#[test]
fn a_file_of_another_format_is_refused_and_left_alone() {
    let (_folder, path) = place();
    let line = "# rosrescue checkpoint v9 header=";
    let text = format!("{line}{:08x}\nnew: true\n", crc32c::crc32c(line.as_bytes()));
    fs::write(&path, &text).unwrap();
    let error = Store::open(&path).err().unwrap();
    assert!(
        matches!(error, OpenError::OtherVersion { version: 9, .. }),
        "{error}"
    );
    assert_eq!(fs::read_to_string(&path).unwrap(), text);
}

#[test]
fn the_error_names_a_folder_that_cannot_be_created() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    fs::write(&file, "").unwrap();
    let error = Store::open(&file.join("c.yaml")).err().unwrap();
    let text = error.to_string();
    assert!(
        text.contains("file/c.yaml") && text.contains("--checkpoint"),
        "{text}"
    );
}

#[test]
fn a_previous_generation_of_a_later_history_adds_nothing() {
    let (_folder, path) = place();
    let mut store = started(&path, 0);
    let mut copy = fs::read(&path).unwrap();
    store.begin(&checkpoint(0)).unwrap();
    for nth in 1..=5 {
        store.append(&[entry(nth)]).unwrap();
    }
    store.begin(&checkpoint(5)).unwrap();
    drop(store);
    // The checkpoint is an old and damaged copy. The previous generation belongs to a later history.
    copy[200] ^= 4;
    fs::write(&path, copy).unwrap();
    let (mut store, loaded) = Store::open(&path).unwrap();
    assert!(!loaded.unwrap().damage.is_empty());
    let restored = checkpoint(store.seq());
    store.begin(&restored).unwrap();
    drop(store);
    let loaded = Store::open(&path).unwrap().1.unwrap();
    assert_eq!(
        (loaded.checkpoint, loaded.records),
        (Some(restored), vec![])
    );
    assert!(loaded.exact, "{:?}", loaded.damage);
}

#[test]
fn what_cannot_be_read_is_kept_and_replaced_by_the_previous_generation() {
    let make_folder = |path: &Path| {
        fs::remove_file(path).unwrap();
        fs::create_dir_all(path.join("within")).unwrap();
    };
    let make_too_large = |path: &Path| {
        let file = File::options().write(true).open(path).unwrap();
        file.set_len((1 << 30) + 1).unwrap();
    };
    for spoil in [&make_folder as &dyn Fn(&Path), &make_too_large] {
        let (folder, path) = place();
        let mut store = started(&path, 3);
        store.begin(&checkpoint(3)).unwrap();
        drop(store);
        spoil(&path);
        let look = |path: &Path| {
            let metadata = fs::metadata(path).unwrap();
            (metadata.file_type(), metadata.len())
        };
        let before = look(&path);
        let (mut store, loaded) = Store::open(&path).unwrap();
        let loaded = loaded.unwrap();
        assert_eq!(loaded.checkpoint, Some(checkpoint(0)));
        assert_eq!(seqs(&loaded.records), [1, 2, 3]);
        let damage = &loaded.damage[0];
        assert!(
            damage.contains("cannot read") && !loaded.exact,
            "{damage:?}"
        );
        store.begin(&checkpoint(3)).unwrap();
        store.append(&[entry(4)]).unwrap();
        drop(store);
        let loaded = Store::open(&path).unwrap().1.unwrap();
        assert_eq!(loaded.checkpoint, Some(checkpoint(3)));
        assert_eq!(loaded.records.len(), 1);
        let aside = folder.path().join("c.yaml.unreadable-1");
        assert_eq!(look(&aside), before);
    }
}
