//! Stores this computer's partition writes beside the checkpoint, until the leader has them.

use std::{
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use checkpoint_store::{Store, StoreError, SyncJob, Synced, beside, regular_file};
use rescue_core::{
    checkpoint::{
        format::{Checkpoint, RecordContent, Session},
        session,
    },
    cluster::{member::PartitionWrites, merge::WritesToSend},
};
use ros1_master::master::Request;

use crate::{
    ledger::disk_jobs::{DISK_PATIENCE, SILENT},
    limit::rarely,
    wait,
};

/// The file is rewritten when it is twice as large as necessary and larger than this many bytes.
const FILE_BYTES: u64 = 64 << 10;
/// How long after a write the file is synced.
const SYNC_PAUSE: Duration = Duration::from_millis(100);
/// How long after a failure the file is written again. A disk that is silent takes [`DISK_PATIENCE`] of it.
const AGAIN: Duration = Duration::from_secs(20);

/// The file `CHECKPOINT.alone`, which holds the partition writes.
#[derive(Default)]
pub(super) struct PartitionWritesFile {
    /// `None` while there is nothing to keep, or while the disk hangs.
    store: Option<Store>,
    /// The size of the file's journal when it was last rewritten, in bytes.
    written: u64,
    /// Whether a sync of the file begins soon.
    sync_is_due: Arc<AtomicBool>,
    /// Whether the file may lack writes, because the disk failed or was silent.
    lacks_writes: Arc<AtomicBool>,
    /// When the whole file was last written, or could not be.
    tried_at: Option<Instant>,
}

fn file_path(checkpoint: &Path) -> PathBuf {
    beside(checkpoint, ".alone")
}

impl PartitionWritesFile {
    /// Opens the file, and returns the writes that an earlier process left. If the session of that process does not
    /// continue (`goes_on` is false), the file is kept under another name.
    pub(super) async fn load(checkpoint: &Path, goes_on: bool) -> (Self, Option<PartitionWrites>) {
        let path = file_path(checkpoint);
        let opened = wait::within(DISK_PATIENCE, move || {
            if let Err(error) = check(&path) {
                return Some(Err(error.to_string()));
            }
            if !path.exists() {
                return None;
            }
            let mut opened = Store::open(&path).map_err(|error| error.to_string());
            if let (Ok((store, Some(_))), false) = (&mut opened, goes_on) {
                set_aside(store);
                return None;
            }
            Some(opened)
        });
        let unread = |error: &dyn std::fmt::Display| tracing::error!(%error, "cannot read the writes made while this computer was cut off; they are not sent to the leader");
        let (store, loaded) = match opened.await {
            Some(Some(Ok((store, Some(loaded))))) => (store, loaded),
            Some(None | Some(Ok((_, None)))) => return Default::default(),
            Some(Some(Err(error))) => {
                unread(&error);
                return Default::default();
            }
            None => {
                unread(&SILENT);
                return Default::default();
            }
        };
        let held = loaded.session().map_or(0, |session| session.cluster_seq);
        let rebuilt = session::rebuild(loaded.checkpoint, Vec::new());
        let trouble = rebuilt.trouble;
        let trouble = trouble.map(|why| format!("the snapshot is not a valid master state: {why}"));
        for sentence in loaded.damage.iter().chain(&trouble) {
            tracing::error!(
                "the writes made while this computer was cut off are damaged: {sentence}"
            );
        }
        let base = rebuilt.mirror;
        let mut pending = WritesToSend::default();
        for record in loaded.records {
            if let RecordContent::Call { call, .. } = record.entry {
                pending.add(&call);
            }
        }
        let calls: Vec<_> = pending.calls().cloned().collect();
        tracing::info!(
            calls = calls.len(),
            "an earlier process was cut off; its writes are sent to the next leader"
        );
        let left = PartitionWrites { base, held, calls };
        let mut this = Self::default();
        this.write(store, left.clone()).await;
        (this, Some(left))
    }

    /// Replaces the file's content.
    pub(super) async fn replace(&mut self, checkpoint: &Path, writes: PartitionWrites) {
        let path = file_path(checkpoint);
        let store = match self.store.take() {
            Some(store) => Some(Ok(store)),
            None => {
                let open = move || {
                    check(&path)?;
                    Store::open_over(&path).map_err(|error| error.to_string())
                };
                wait::within(DISK_PATIENCE, open).await
            }
        };
        self.lacks_writes.store(false, Ordering::Relaxed);
        match store {
            Some(Ok(store)) => self.write(store, writes).await,
            Some(Err(error)) => note_unsaved(&self.lacks_writes, &error),
            None => note_unsaved(&self.lacks_writes, &SILENT),
        }
        self.tried_at = Some(Instant::now());
    }

    async fn write(&mut self, mut store: Store, writes: PartitionWrites) {
        let write = move || {
            let checkpoint = Checkpoint {
                seq: store.seq(),
                session: Session {
                    cluster_seq: writes.held,
                    ..Session::default()
                },
                snapshot: writes.base.snapshot(),
                ..Checkpoint::default()
            };
            let entries = entries(writes.calls);
            let written = store.begin(&checkpoint);
            let written = written.and_then(|()| store.append(&entries).map(|_| ()));
            // The file that it replaces had them synced.
            let synced = written.and_then(|()| match store.sync_job().map(SyncJob::run) {
                Some(done) => store.synced(done),
                None => Ok(()),
            });
            (synced, store)
        };
        self.have(write).await;
        self.written = self.store.as_ref().map_or(0, Store::journal_bytes);
    }

    /// Adds `calls` to the file.
    pub(super) async fn add(&mut self, calls: Vec<Request>) {
        if let Some(mut store) = self.store.take() {
            let entries = entries(calls);
            let append = move || (store.append(&entries).map(|_| ()), store);
            self.have(append).await;
            self.sync_soon();
        }
    }

    /// Syncs what was added, after a pause in which more may be added. A power cut costs no more than that.
    fn sync_soon(&self) {
        let Some(job) = self.store.as_ref().and_then(Store::sync_job) else {
            return;
        };
        if self.sync_is_due.swap(true, Ordering::Relaxed) {
            return;
        }
        let (is_due, lacks_writes) = (self.sync_is_due.clone(), self.lacks_writes.clone());
        crate::task::spawn(async move {
            tokio::time::sleep(SYNC_PAUSE).await;
            // What is added from now on gets a sync of its own.
            is_due.store(false, Ordering::Relaxed);
            let synced = crate::task::spawn_blocking(move || job.run()).await;
            if let Some(error) = synced.as_ref().ok().and_then(Synced::error) {
                note_unsaved(&lacks_writes, error);
            }
        });
    }

    /// Whether the whole file must be written again: it is twice as large as necessary, or a failure is long enough ago.
    pub(super) fn must_be_replaced(&self) -> bool {
        if self.lacks_writes.load(Ordering::Relaxed) {
            return self.tried_at.is_none_or(|at| at.elapsed() >= AGAIN);
        }
        let Some(store) = &self.store else {
            return false;
        };
        let needed = self.written.max(store.snapshot_bytes()).max(FILE_BYTES);
        store.journal_bytes() > self.written.saturating_add(needed)
    }

    /// Runs `work` with the store on another thread.
    async fn have(
        &mut self,
        work: impl FnOnce() -> (Result<(), StoreError>, Store) + Send + 'static,
    ) {
        let Some((done, store)) = wait::within(DISK_PATIENCE, work).await else {
            return note_unsaved(&self.lacks_writes, &SILENT);
        };
        if let Err(error) = done {
            note_unsaved(&self.lacks_writes, &error);
        }
        self.store = Some(store);
    }

    /// Removes the file, because all writes have been sent.
    pub(super) async fn remove(&mut self, checkpoint: &Path) {
        *self = Self::default();
        let path = file_path(checkpoint);
        // A hanging disk may remove the file later: it must only be gone before the next start.
        wait::within(DISK_PATIENCE, move || remove_files(path)).await;
    }
}

/// Refuses a file that others have planted at `path`.
fn check(path: &Path) -> Result<(), String> {
    match regular_file::length_of_ours(path) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            let path = path.display();
            Err(format!("cannot use `{path}`: {error}"))
        }
        _ => Ok(()),
    }
}

fn entries(calls: Vec<Request>) -> Vec<RecordContent> {
    calls.into_iter().map(RecordContent::call).collect()
}

fn remove_files(path: PathBuf) {
    let folder = path.parent().map(std::fs::File::open);
    let previous = checkpoint_store::previous_of(&path);
    for path in [path, previous] {
        if let Err(error) = std::fs::remove_file(&path)
            && error.kind() != std::io::ErrorKind::NotFound
        {
            tracing::warn!(
                path = %path.display(),
                %error,
                "cannot delete the file of writes that have been sent; delete it, or its writes will be sent again"
            );
        }
    }
    // Otherwise a power cut may bring the file back.
    if let Some(Ok(folder)) = folder {
        let _ = folder.sync_all();
    }
}

/// Keeps the writes of an ended session under another name.
fn set_aside(store: &mut Store) {
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

/// Logs that the file may lack writes, and has it written again.
fn note_unsaved(lacks_writes: &AtomicBool, error: &dyn std::fmt::Display) {
    lacks_writes.store(true, Ordering::Relaxed);
    rarely!(
        error,
        %error,
        "cannot store the writes made while cut off; a crash of rosrescue itself would lose them. Free space on \
         the disk or repair it"
    );
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros1_master::{
        master::{Master, Method},
        xmlrpc::Value,
    };

    fn set(key: &str, value: i32) -> Request {
        let params = [Value::from("/n"), key.into(), value.into()];
        Request::new(Method::SetParam, params)
    }

    fn base() -> Master {
        let mut base = Master::default();
        base.apply(&set("/before", 1));
        base
    }

    fn writes(calls: Vec<Request>) -> PartitionWrites {
        PartitionWrites {
            base: base(),
            held: 7,
            calls,
        }
    }

    async fn loaded(checkpoint: &Path, goes_on: bool) -> Option<PartitionWrites> {
        PartitionWritesFile::load(checkpoint, goes_on).await.1
    }

    async fn begun(checkpoint: &Path) -> PartitionWritesFile {
        let mut kept = PartitionWritesFile::default();
        kept.replace(checkpoint, writes(Vec::new())).await;
        kept
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
        let mut kept = begun(&checkpoint).await;
        kept.add(vec![set("/a", 1)]).await;
        kept.add(vec![set("/b", 2)]).await;
        drop(kept);
        for _ in 0..2 {
            let left = loaded(&checkpoint, true).await.unwrap();
            assert!(left.base == base());
            assert_eq!(left.held, 7);
            assert_eq!(left.calls, [set("/a", 1), set("/b", 2)]);
        }
        PartitionWritesFile::default().remove(&checkpoint).await;
        assert_eq!(files(&checkpoint), [""; 0]);
        assert!(loaded(&checkpoint, true).await.is_none());
    }

    #[tokio::test]
    async fn of_a_session_that_is_over_the_writes_are_kept_under_another_name_and_not_sent() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoint = folder.path().join("chkpt.yaml");
        let mut kept = begun(&checkpoint).await;
        kept.add(vec![set("/a", 1)]).await;
        drop(kept);
        assert!(loaded(&checkpoint, false).await.is_none());
        let names = files(&checkpoint);
        assert!(!names.is_empty() && !names.contains(&"chkpt.yaml.alone".to_owned()));
        let text = std::fs::read_to_string(folder.path().join(&names[0])).unwrap();
        assert!(text.contains("before"), "{text}");
        assert!(loaded(&checkpoint, true).await.is_none());
    }

    /// Without the state before the writes, the merge takes each of them for older than that of the others.
    #[tokio::test]
    async fn damage_is_logged_and_the_rest_is_sent() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoint = folder.path().join("chkpt.yaml");
        let mut kept = begun(&checkpoint).await;
        kept.add(vec![set("/a", 1)]).await;
        drop(kept);
        let path = file_path(&checkpoint);
        let text = std::fs::read_to_string(&path).unwrap();
        std::fs::write(&path, text.replacen("before", "behind", 1)).unwrap();

        let log = tempfile::NamedTempFile::new().unwrap();
        let writer = std::sync::Mutex::new(log.reopen().unwrap());
        let subscriber = tracing_subscriber::fmt().with_writer(writer).finish();
        let logging = tracing::subscriber::set_default(subscriber);
        let left = loaded(&checkpoint, true).await.unwrap();
        drop(logging);
        assert!(left.base == Master::default());
        assert_eq!(left.calls, [set("/a", 1)]);
        let said = std::fs::read_to_string(log.path()).unwrap();
        let parts = [
            "ERROR",
            "cut off are damaged: the snapshot of",
            ".alone.broken-1",
        ];
        for part in parts {
            assert!(said.contains(part), "{part}\n{said}");
        }
    }

    /// A disk may be full for a moment while the computer is cut off for hours.
    #[tokio::test]
    async fn the_file_is_written_again_after_a_failure() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoint = folder.path().join("chkpt.yaml");
        std::fs::create_dir(file_path(&checkpoint)).unwrap();
        let mut kept = begun(&checkpoint).await;
        std::fs::remove_dir(file_path(&checkpoint)).unwrap();
        kept.add(vec![set("/a", 1)]).await;
        assert!(!kept.must_be_replaced(), "not at once");
        kept.tried_at = None;
        assert!(kept.must_be_replaced());
        kept.replace(&checkpoint, writes(vec![set("/a", 1)])).await;
        kept.tried_at = None;
        assert!(!kept.must_be_replaced());
        // The disk loses what it has.
        std::fs::write(file_path(&checkpoint), "").unwrap();
        let all = vec![set("/a", 1), set("/b", 2)];
        kept.add(vec![set("/b", 2)]).await;
        kept.tried_at = None;
        assert!(kept.must_be_replaced());
        kept.replace(&checkpoint, writes(all.clone())).await;
        kept.add(vec![set("/c", 3)]).await;
        drop(kept);
        let left = loaded(&checkpoint, true).await.unwrap();
        assert_eq!(left.calls, [all, vec![set("/c", 3)]].concat());
    }

    #[tokio::test]
    async fn parameters_that_are_set_again_and_again_take_no_larger_file() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoint = folder.path().join("chkpt.yaml");
        let mut kept = begun(&checkpoint).await;
        let mut largest = 0;
        let values = |round| -> Vec<_> {
            let set = |key| set(&format!("/k{key}"), round);
            (0..10).map(set).collect()
        };
        for round in 0..300 {
            kept.add(values(round)).await;
            if kept.must_be_replaced() {
                kept.replace(&checkpoint, writes(values(round))).await;
            }
            let bytes = std::fs::metadata(file_path(&checkpoint)).unwrap().len();
            largest = largest.max(bytes);
        }
        assert!(largest < 3 * FILE_BYTES, "{largest}");
        drop(kept);
        let left = loaded(&checkpoint, true).await.unwrap();
        assert_eq!(left.calls, values(299));
    }
}
