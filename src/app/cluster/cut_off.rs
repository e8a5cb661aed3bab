//! Writes that were answered while this computer was alone: kept beside the checkpoint until they have been
//! sent to the leader.

use std::{
    collections::VecDeque,
    path::{Path, PathBuf},
};

use crate::{
    checkpoint::{
        format::{Checkpoint, Entry, Record},
        session,
        store::{Store, StoreError},
    },
    cluster::merge::{self, Changes, Pending},
    ledger::{
        Change,
        journal::{DISK_PATIENCE, SILENT},
    },
    limit::rarely,
    master::{Master, Request},
    wait,
};

/// Most times alone that are kept apart.
const TIMES_MOST: usize = 8;
/// Most writes of a time whose own record in the journal is recognised.
const EXPECTED_MOST: usize = 4_000;
/// The file is written anew when it has outgrown what is needed, and this many bytes.
const FILE_BYTES: u64 = 64 << 10;

/// One time alone.
#[derive(Clone)]
pub(super) struct Time {
    /// The state when this computer was cut off.
    pub(super) base: Master,
    /// What was answered since.
    pub(super) pending: Pending,
    /// What others have changed since.
    pub(super) changes: Changes,
    /// How many of the writes were given to the journal, too.
    expected: usize,
}

impl Time {
    fn new(base: Master) -> Self {
        Self {
            base,
            pending: Pending::default(),
            changes: Changes::default(),
            expected: 0,
        }
    }
}

pub(super) struct CutOff {
    /// Those whose writes have not all reached the leader, the oldest first; never empty.
    times: VecDeque<Time>,
    store: Option<Store>,
    /// The bytes of the file's journal when it was written anew.
    written: u64,
}

fn path_of(checkpoint: &Path) -> PathBuf {
    let mut name = checkpoint.as_os_str().to_owned();
    name.push(".alone");
    name.into()
}

impl CutOff {
    /// What an earlier process has left. `goes_on`: whether its session does; if not, the file is kept under
    /// another name.
    pub(super) async fn left(checkpoint: &Path, goes_on: bool) -> Option<Self> {
        let path = path_of(checkpoint);
        let opened = wait::within(DISK_PATIENCE, move || {
            if !path.exists() {
                return None;
            }
            let mut opened = Store::open(&path);
            if let (Ok((store, Some(_))), false) = (&mut opened, goes_on) {
                keep_of_session(store);
                return None;
            }
            Some(opened)
        });
        let unread = |error: &dyn std::fmt::Display| tracing::error!(%error, "cannot read the writes made while this computer was cut off; they are not sent");
        let (store, loaded) = match opened.await {
            Some(None) => return None,
            Some(Some(Ok((store, loaded)))) => (store, loaded?),
            Some(Some(Err(error))) => {
                unread(&error);
                return None;
            }
            None => {
                unread(&SILENT);
                return None;
            }
        };
        let base = session::rebuild(loaded.checkpoint, Vec::new()).mirror;
        let mut time = Time::new(base);
        for record in loaded.records {
            if let Entry::Call { call, .. } = record.entry {
                time.pending.add(&Request::from(call));
            }
        }
        tracing::info!(
            calls = time.pending.len(),
            "an earlier process was cut off; its writes are sent once there is a leader"
        );
        let mut this = Self::of(time);
        this.write(store).await;
        Some(this)
    }

    fn of(time: Time) -> Self {
        Self {
            times: VecDeque::from([time]),
            store: None,
            written: 0,
        }
    }

    /// This computer is cut off in the state `base`.
    pub(super) async fn new(checkpoint: &Path, base: Master) -> Self {
        let path = path_of(checkpoint);
        let mut this = Self::of(Time::new(base));
        match wait::within(DISK_PATIENCE, move || Store::open_over(&path)).await {
            Some(Ok(store)) => this.write(store).await,
            Some(Err(error)) => say_unkept(&error),
            None => say_unkept(&SILENT),
        }
        this
    }

    /// Writes all times into the file. It tells no limits between them: after a crash they are one.
    async fn write(&mut self, mut store: Store) {
        let Some(first) = self.times.front() else {
            return;
        };
        let checkpoint = Checkpoint {
            seq: store.seq(),
            snapshot: first.base.snapshot(),
            ..Checkpoint::default()
        };
        let calls = self.times.iter().flat_map(|time| time.pending.calls());
        let entries = entries(calls);
        let write = move || {
            let written = store.begin(&checkpoint);
            let written = written.and_then(|()| store.append(&entries).map(|_| ()));
            (written, store)
        };
        self.keep(write).await;
        self.written = self.store.as_ref().map_or(0, Store::journal_bytes);
    }

    /// Whether the file has grown to twice what is needed.
    fn has_outgrown(&self) -> bool {
        let Some(store) = &self.store else {
            return false;
        };
        let needed = self.written.max(store.snapshot_bytes()).max(FILE_BYTES);
        store.journal_bytes() > self.written.saturating_add(needed)
    }

    /// Has `work` done, and takes the store back. No store is left of a disk that is silent.
    async fn keep(
        &mut self,
        work: impl FnOnce() -> (Result<(), StoreError>, Store) + Send + 'static,
    ) {
        let Some((done, store)) = wait::within(DISK_PATIENCE, work).await else {
            return say_unkept(&SILENT);
        };
        if let Err(error) = done {
            say_unkept(&error);
        }
        self.store = Some(store);
    }

    /// This computer is cut off once more, in the state `base`.
    pub(super) fn again(&mut self, base: Master) {
        // The writes of the earlier times may still be on their way.
        let earlier: Vec<_> = self
            .times
            .iter()
            .flat_map(|time| time.pending.calls().cloned())
            .collect();
        let is_empty = self
            .times
            .back()
            .is_some_and(|last| last.pending.is_empty());
        if is_empty && self.times.len() > 1 {
            self.times.pop_back();
        }
        // The oldest one may be on its way.
        if self.times.len() >= TIMES_MOST
            && let Some(second) = self.times.remove(2)
            && let Some(first) = self.times.get_mut(1)
        {
            // What others have changed since the first one counts for both.
            second
                .pending
                .calls()
                .for_each(|call| first.pending.add(call));
        }
        let mut time = Time::new(base);
        time.changes.expect(earlier);
        self.times.push_back(time);
    }

    /// Others may have run `calls` of this computer, or may still: they are no changes of theirs.
    pub(super) fn expect(&mut self, calls: impl IntoIterator<Item = Request>) {
        if let Some(time) = self.times.back_mut() {
            time.changes.expect(calls);
        }
    }

    /// The journal has these records now.
    pub(super) fn note(&mut self, records: &[Record]) {
        for time in &mut self.times {
            note(&mut time.changes, records);
        }
    }

    /// The journal's state is `is`, and was `was`, or that in which this computer was cut off. The records in
    /// between are not known.
    pub(super) fn note_difference(&mut self, was: Option<&Master>, is: &Master) {
        for time in &mut self.times {
            let was = was.unwrap_or(&time.base);
            time.changes.note_difference(was, is);
        }
    }

    /// `state`, that of the others, with what was answered alone and has not reached them.
    pub(super) fn on(&self, state: &Master) -> Master {
        let mut state = state.clone();
        for time in &self.times {
            for call in merge::merge(&time.changes, &state, time.pending.calls()).send {
                state.apply_telling(&call, &mut ());
            }
        }
        state
    }

    /// Keeps what was answered. `given`: whether it is given to the journal, too, which may take it.
    pub(super) async fn add<'a>(
        &mut self,
        changes: impl IntoIterator<Item = &'a Change>,
        given: bool,
    ) {
        let Some(time) = self.times.back_mut() else {
            return;
        };
        let mut calls = Vec::new();
        for change in changes {
            // A state comes from a master, not from a node.
            let Change::Call(record, _) = change else {
                continue;
            };
            let Entry::Call { call, .. } = &record.entry else {
                continue;
            };
            let call = Request::from(call.clone());
            // No more than the first ones are on their way at once.
            if given && time.expected < EXPECTED_MOST {
                time.expected += 1;
                time.changes.expect_record(record.seq, call.clone());
            }
            calls.push(call);
        }
        self.append(calls).await;
    }

    async fn append(&mut self, calls: Vec<Request>) {
        if calls.is_empty() {
            return;
        }
        if let Some(time) = self.times.back_mut() {
            calls.iter().for_each(|call| time.pending.add(call));
        }
        if let Some(mut store) = self.store.take() {
            let entries = entries(&calls);
            let append = move || (store.append(&entries).map(|_| ()), store);
            self.keep(append).await;
        }
        if self.has_outgrown()
            && let Some(store) = self.store.take()
        {
            self.write(store).await;
        }
    }

    /// How many writes are kept.
    pub(super) fn len(&self) -> usize {
        self.times.iter().map(|time| time.pending.len()).sum()
    }

    /// The oldest time.
    pub(super) fn first(&self) -> Option<Time> {
        self.times.front().cloned()
    }

    /// The writes of the oldest time have reached the leader. Returns what is left.
    pub(super) async fn sent(mut self) -> Option<Self> {
        self.times.pop_front();
        if self.times.is_empty() {
            return None;
        }
        if let Some(store) = self.store.take() {
            self.write(store).await;
        }
        Some(self)
    }

    /// What was answered this time is in the journal after all. Returns what is left of earlier times.
    pub(super) fn resumed(mut self) -> Option<Self> {
        self.times.pop_back();
        Some(self).filter(|left| !left.times.is_empty())
    }
}

/// Notes records of the journal.
pub(super) fn note(changes: &mut Changes, records: &[Record]) {
    for record in records {
        if let Entry::Call { call, .. } = &record.entry {
            changes.note(record.seq, &Request::from(call.clone()));
        }
    }
}

fn entries<'a>(calls: impl IntoIterator<Item = &'a Request>) -> Vec<Entry> {
    let calls = calls.into_iter().cloned();
    calls.map(|call| Entry::call(call.into())).collect()
}

/// Removes what was kept beside `checkpoint`: all of it has been sent.
pub(super) async fn remove(checkpoint: &Path) {
    let path = path_of(checkpoint);
    // Late is in time for the next start.
    wait::within(DISK_PATIENCE, move || remove_files(path)).await;
}

fn remove_files(path: PathBuf) {
    let previous = crate::checkpoint::store::previous_of(&path);
    for path in [path, previous] {
        if let Err(error) = std::fs::remove_file(&path)
            && error.kind() != std::io::ErrorKind::NotFound
        {
            tracing::warn!(
                path = %path.display(),
                %error,
                "cannot delete the file of writes that were sent; delete it, or they are sent again"
            );
        }
    }
}

/// Keeps the writes of a session that is over under another name.
fn keep_of_session(store: &mut Store) {
    match store.set_aside("session") {
        Ok(Some(kept)) => tracing::warn!(
            kept = %kept.display(),
            "writes made while cut off belong to an ended session; they are kept in a file, not sent"
        ),
        Ok(None) => {}
        Err(error) => {
            tracing::error!(%error, "cannot store the writes of an ended session under another name")
        }
    }
}

fn say_unkept(error: &dyn std::fmt::Display) {
    rarely!(
        error,
        %error,
        "writes that are answered alone cannot be kept on the disk; a crash of rosrescue itself would lose \
         them. Free or repair the disk"
    );
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ledger::Source, master::Method, xmlrpc::Value};

    fn set(key: &str, value: i32) -> Request {
        let params = [Value::from("/n"), key.into(), value.into()];
        Request::new(Method::SetParam, params)
    }

    fn change(seq: u64, call: Request) -> Change {
        let entry = Entry::call(call.into());
        Change::Call(Record { seq, entry }, Source::Here)
    }

    fn calls_of(time: &Time) -> Vec<Request> {
        time.pending.calls().cloned().collect()
    }

    fn base() -> Master {
        let mut base = Master::default();
        base.apply(&set("/before", 1));
        base
    }

    /// The files in the folder of `checkpoint`.
    fn files(checkpoint: &Path) -> Vec<String> {
        let entries = std::fs::read_dir(checkpoint.parent().unwrap()).unwrap();
        let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let mut names: Vec<_> = names.filter(|name| !name.ends_with(".lock")).collect();
        names.sort();
        names
    }

    #[tokio::test]
    async fn what_was_answered_alone_is_read_back_by_the_next_process_and_by_the_one_after_it() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoint = folder.path().join("chkpt.yaml");
        let calls = [set("/a", 1), set("/b", 2)];
        let mut cut_off = CutOff::new(&checkpoint, base()).await;
        cut_off.add(&[change(5, calls[0].clone())], false).await;
        // It was read from a master.
        let state = Box::new(Master::default());
        cut_off
            .add(
                &[Change::State { seq: 6, state }, change(7, calls[1].clone())],
                false,
            )
            .await;
        drop(cut_off);
        for _ in 0..2 {
            let left = CutOff::left(&checkpoint, true).await.unwrap();
            let left = left.first().unwrap();
            assert!(left.base == base());
            assert_eq!(calls_of(&left), calls);
        }
        remove(&checkpoint).await;
        assert_eq!(files(&checkpoint), [""; 0]);
        assert!(CutOff::left(&checkpoint, true).await.is_none());
    }

    #[tokio::test]
    async fn of_a_session_that_is_over_the_writes_are_kept_under_another_name_and_not_sent() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoint = folder.path().join("chkpt.yaml");
        let mut cut_off = CutOff::new(&checkpoint, base()).await;
        cut_off.add(&[change(5, set("/a", 1))], false).await;
        drop(cut_off);
        assert!(CutOff::left(&checkpoint, false).await.is_none());
        let kept = files(&checkpoint);
        assert!(!kept.is_empty() && !kept.contains(&"chkpt.yaml.alone".to_owned()));
        let text = std::fs::read_to_string(folder.path().join(&kept[0])).unwrap();
        assert!(
            text.contains("/before") || text.contains("before"),
            "{text}"
        );
        assert!(CutOff::left(&checkpoint, true).await.is_none());
    }

    #[tokio::test]
    async fn a_time_alone_that_was_none_leaves_the_writes_of_the_one_before() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoint = folder.path().join("chkpt.yaml");
        let mut cut_off = CutOff::new(&checkpoint, base()).await;
        cut_off.add(&[change(5, set("/a", 1))], false).await;
        cut_off.again(base());
        cut_off.add(&[change(6, set("/b", 2))], false).await;
        // etcd has the second after all.
        let left = cut_off.resumed().unwrap();
        assert_eq!(calls_of(&left.first().unwrap()), [set("/a", 1)]);
        let only = CutOff::new(&folder.path().join("other.yaml"), base()).await;
        assert!(only.resumed().is_none());
    }

    /// The first one's writes are on their way when the second begins.
    #[tokio::test]
    async fn of_two_times_alone_the_second_goes_on_from_the_first() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoint = folder.path().join("chkpt.yaml");
        let others = base();
        let mut cut_off = CutOff::new(&checkpoint, others.clone()).await;
        cut_off.add(&[change(5, set("/count", 1))], false).await;
        let second = cut_off.on(&others);
        assert_eq!(second.params().get("count"), Some(&1.into()));
        cut_off.again(second);
        cut_off.add(&[change(6, set("/count", 2))], false).await;
        // A crash loses neither: the second is all that is left of them.
        let path = folder.path().join("copy.yaml");
        std::fs::copy(path_of(&checkpoint), path_of(&path)).unwrap();
        let left = CutOff::left(&path, true).await.unwrap();
        assert_eq!(calls_of(&left.first().unwrap()), [set("/count", 2)]);
        // The others get the first.
        let first = cut_off.first().unwrap();
        let merged = merge::merge(&first.changes, &others, first.pending.calls());
        assert_eq!(merged.send, [set("/count", 1)]);
        let mut others = others;
        others.apply(&set("/count", 1));
        let Change::Call(record, _) = change(7, set("/count", 1)) else {
            unreachable!();
        };
        cut_off.note(&[record]);
        let cut_off = cut_off.sent().await.unwrap();
        let second = cut_off.first().unwrap();
        let merged = merge::merge(&second.changes, &others, second.pending.calls());
        assert_eq!(merged.send, [set("/count", 2)]);
        assert_eq!(merged.lost, []);
        let left = CutOff::left(&checkpoint, true);
        assert!(left.await.is_none(), "it is locked");
        assert!(cut_off.sent().await.is_none());
        let left = CutOff::left(&checkpoint, true).await.unwrap();
        assert_eq!(calls_of(&left.first().unwrap()), [set("/count", 2)]);
    }

    #[tokio::test]
    async fn what_cannot_be_kept_is_still_sent() {
        let folder = tempfile::tempdir().unwrap();
        let mut cut_off = CutOff::new(&folder.path().join("no/folder.yaml"), base()).await;
        cut_off.add(&[change(5, set("/a", 1))], false).await;
        assert_eq!(calls_of(&cut_off.first().unwrap()), [set("/a", 1)]);
    }

    #[tokio::test]
    async fn parameters_that_are_set_again_and_again_take_no_more_memory_and_no_larger_file() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoint = folder.path().join("chkpt.yaml");
        let mut cut_off = CutOff::new(&checkpoint, base()).await;
        let mut largest = 0;
        for round in 0..300 {
            let calls = (0..10).map(|key| change(5, set(&format!("/k{key}"), round)));
            let calls: Vec<_> = calls.collect();
            cut_off.add(&calls, true).await;
            let bytes = std::fs::metadata(path_of(&checkpoint)).unwrap().len();
            largest = largest.max(bytes);
        }
        let expected: Vec<_> = (0..10).map(|key| set(&format!("/k{key}"), 299)).collect();
        assert_eq!(calls_of(&cut_off.first().unwrap()), expected);
        assert!(largest < 3 * FILE_BYTES, "{largest}");
        drop(cut_off);
        let left = CutOff::left(&checkpoint, true).await.unwrap();
        assert_eq!(calls_of(&left.first().unwrap()), expected);
    }

    #[tokio::test]
    async fn a_network_that_comes_and_goes_piles_up_no_times() {
        let folder = tempfile::tempdir().unwrap();
        let mut cut_off = CutOff::new(&folder.path().join("chkpt.yaml"), base()).await;
        for value in 0..50 {
            cut_off.again(base());
            cut_off.again(base());
            cut_off.add(&[change(5, set("/a", value))], false).await;
        }
        assert!(cut_off.times.len() <= TIMES_MOST);
        let last = cut_off.times.back().unwrap();
        assert_eq!(calls_of(last), [set("/a", 49)]);
        // What was written this time only is in the journal.
        let left = cut_off.resumed().unwrap();
        assert_eq!(calls_of(&left.times[0]), []);
        assert_eq!(calls_of(left.times.back().unwrap()), [set("/a", 48)]);
    }
}
