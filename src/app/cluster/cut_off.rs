//! Writes that were answered while this computer was alone: kept beside the checkpoint until they have been
//! sent to the leader.

use std::{
    collections::VecDeque,
    path::{Path, PathBuf},
};

use crate::{
    checkpoint::{
        format::{Checkpoint, Entry},
        session,
        store::{Store, StoreError},
    },
    cluster::merge,
    ledger::{
        Change,
        journal::{DISK_PATIENCE, SILENT},
    },
    limit::rarely,
    master::{Master, Request},
    wait,
};

/// One time alone.
#[derive(Clone)]
pub(super) struct Time {
    /// The state when this computer was cut off.
    pub(super) base: Master,
    /// What was answered since, in order.
    pub(super) calls: Vec<Request>,
}

pub(super) struct CutOff {
    /// Those whose writes have not all reached the leader, the oldest first; never empty.
    times: VecDeque<Time>,
    store: Option<Store>,
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
        let unread = |error: &dyn std::fmt::Display| tracing::error!(%error, "the writes of a time alone cannot be read, and are not sent");
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
        let calls = loaded.records.into_iter();
        let calls: Vec<Request> = calls
            .filter_map(|record| match record.entry {
                Entry::Call { call, .. } => Some(Request::from(call)),
                Entry::Session(_) => None,
            })
            .collect();
        tracing::info!(
            calls = calls.len(),
            "an earlier process was alone; its writes are sent when a computer leads"
        );
        let mut this = Self::of(Time { base, calls });
        this.write(store).await;
        Some(this)
    }

    fn of(time: Time) -> Self {
        Self {
            times: VecDeque::from([time]),
            store: None,
        }
    }

    /// This computer is cut off in the state `base`.
    pub(super) async fn new(checkpoint: &Path, base: Master) -> Self {
        let path = path_of(checkpoint);
        let calls = Vec::new();
        let mut this = Self::of(Time { base, calls });
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
        let calls = self.times.iter().flat_map(|time| &time.calls);
        let entries = entries(calls);
        let write = move || {
            let written = store.begin(&checkpoint);
            let written = written.and_then(|()| store.append(&entries).map(|_| ()));
            (written, store)
        };
        self.keep(write).await;
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
        let calls = Vec::new();
        self.times.push_back(Time { base, calls });
    }

    /// `state`, that of the others, with what was answered alone and has not reached them.
    pub(super) fn on(&self, state: &Master) -> Master {
        let mut state = state.clone();
        for Time { base, calls } in &self.times {
            for call in merge::merge(base, &state, calls).send {
                state.apply_telling(&call, &mut ());
            }
        }
        state
    }

    /// Keeps what was answered.
    pub(super) async fn add<'a>(&mut self, changes: impl IntoIterator<Item = &'a Change>) {
        let calls = changes.into_iter().filter_map(|change| match change {
            Change::Call(record) => match &record.entry {
                Entry::Call { call, .. } => Some(Request::from(call.clone())),
                Entry::Session(_) => None,
            },
            // It comes from a master, not from a node.
            Change::State { .. } => None,
        });
        self.append(calls.collect()).await;
    }

    async fn append(&mut self, calls: Vec<Request>) {
        if calls.is_empty() {
            return;
        }
        if let Some(mut store) = self.store.take() {
            let entries = entries(&calls);
            let append = move || (store.append(&entries).map(|_| ()), store);
            self.keep(append).await;
        }
        if let Some(time) = self.times.back_mut() {
            time.calls.extend(calls);
        }
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
                "writes that were sent cannot be removed and would be sent again; remove the file"
            );
        }
    }
}

/// Keeps the writes of a session that is over under another name.
fn keep_of_session(store: &mut Store) {
    match store.set_aside("session") {
        Ok(Some(kept)) => tracing::warn!(
            kept = %kept.display(),
            "writes of a time alone belong to a session that is over; they are kept, and not sent"
        ),
        Ok(None) => {}
        Err(error) => tracing::error!(%error, "the writes of a time alone cannot be kept"),
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
    use crate::{checkpoint::format::Record, master::Method, xmlrpc::Value};

    fn set(key: &str, value: i32) -> Request {
        let params = [Value::from("/n"), key.into(), value.into()];
        Request::new(Method::SetParam, params)
    }

    fn change(seq: u64, call: Request) -> Change {
        let entry = Entry::call(call.into());
        Change::Call(Record { seq, entry })
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
        cut_off.add(&[change(5, calls[0].clone())]).await;
        // It was read from a master.
        let state = Box::new(Master::default());
        cut_off
            .add(&[Change::State { seq: 6, state }, change(7, calls[1].clone())])
            .await;
        drop(cut_off);
        for _ in 0..2 {
            let left = CutOff::left(&checkpoint, true).await.unwrap();
            let left = left.first().unwrap();
            assert!(left.base == base());
            assert_eq!(left.calls, calls);
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
        cut_off.add(&[change(5, set("/a", 1))]).await;
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
        cut_off.add(&[change(5, set("/a", 1))]).await;
        cut_off.again(base());
        cut_off.add(&[change(6, set("/b", 2))]).await;
        // etcd has the second after all.
        let left = cut_off.resumed().unwrap();
        assert_eq!(left.first().unwrap().calls, [set("/a", 1)]);
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
        cut_off.add(&[change(5, set("/count", 1))]).await;
        let second = cut_off.on(&others);
        assert_eq!(second.params().get("count"), Some(&1.into()));
        cut_off.again(second);
        cut_off.add(&[change(6, set("/count", 2))]).await;
        // A crash loses neither.
        let path = folder.path().join("copy.yaml");
        std::fs::copy(path_of(&checkpoint), path_of(&path)).unwrap();
        let left = CutOff::left(&path, true).await.unwrap();
        assert_eq!(
            left.first().unwrap().calls,
            [set("/count", 1), set("/count", 2)]
        );
        // The others get the first.
        let first = cut_off.first().unwrap();
        let merged = merge::merge(&first.base, &others, &first.calls);
        assert_eq!(merged.send, [set("/count", 1)]);
        let mut others = others;
        others.apply(&set("/count", 1));
        let cut_off = cut_off.sent().await.unwrap();
        let second = cut_off.first().unwrap();
        let merged = merge::merge(&second.base, &others, &second.calls);
        assert_eq!(merged.send, [set("/count", 2)]);
        assert_eq!(merged.lost, []);
        let left = CutOff::left(&checkpoint, true);
        assert!(left.await.is_none(), "it is locked");
        assert!(cut_off.sent().await.is_none());
        let left = CutOff::left(&checkpoint, true).await.unwrap();
        assert_eq!(left.first().unwrap().calls, [set("/count", 2)]);
    }

    #[tokio::test]
    async fn what_cannot_be_kept_is_still_sent() {
        let folder = tempfile::tempdir().unwrap();
        let mut cut_off = CutOff::new(&folder.path().join("no/folder.yaml"), base()).await;
        cut_off.add(&[change(5, set("/a", 1))]).await;
        assert_eq!(cut_off.first().unwrap().calls, [set("/a", 1)]);
    }
}
