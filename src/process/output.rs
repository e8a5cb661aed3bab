//! The output of a child process, in a file next to the checkpoint. No call waits for the disk.

use std::{
    fs::File,
    io,
    os::unix::fs::FileExt,
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use checkpoint_store::{beside, regular_file};

use crate::{limit::rarely, wait};

/// How long the disk may delay a master. After that the master starts without the file.
pub(super) const LIMIT: Duration = Duration::from_millis(250);
/// Number of bytes of the output's end that messages show.
const TAIL: u64 = 400;

/// The file that receives the output of a child process.
#[derive(Clone, Debug)]
pub(super) struct Output {
    path: PathBuf,
    shared: Arc<Shared>,
}

#[derive(Debug, Default)]
struct Shared {
    /// The present file, readable and open for appending.
    file: Mutex<Option<File>>,
    /// Whether the disk is still busy with the last request. Until the disk has finished, it gets no other request.
    asked: AtomicBool,
}

impl Output {
    /// Uses the file next to `checkpoint` with this `suffix`. Opens nothing yet.
    pub(super) fn beside(checkpoint: &Path, suffix: &str) -> Self {
        Self {
            path: beside(checkpoint, suffix),
            shared: Arc::default(),
        }
    }

    /// Creates an empty file for the next process. Logs a failure.
    pub(super) async fn renew(&self) {
        self.set(None);
        let path = self.path.clone();
        let file = match self.run_on_disk(move || regular_file::create(&path)).await {
            Some(Ok(file)) => Some(file),
            Some(Err(error)) => {
                self.report(&error.to_string());
                None
            }
            None => {
                self.report("the disk does not answer");
                None
            }
        };
        self.set(file);
    }

    fn report(&self, error: &str) {
        rarely!(
            warn,
            file = %self.path.display(),
            error,
            "cannot create the output file of a child process; the process starts without it"
        );
    }

    fn set(&self, file: Option<File>) {
        *self
            .shared
            .file
            .lock()
            .unwrap_or_else(PoisonError::into_inner) = file;
    }

    /// The present file, for a process to write to. `None` if there is no file.
    pub(super) fn file(&self) -> Option<File> {
        let file = self
            .shared
            .file
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        file.as_ref()?.try_clone().ok()
    }

    /// The end of the output, for messages; empty if it cannot be read.
    pub(super) async fn tail(&self) -> String {
        let Some(file) = self.file() else {
            return String::new();
        };
        let tail = self.run_on_disk(move || tail_of(&file)).await;
        let tail = tail.and_then(Result::ok).unwrap_or_default();
        String::from_utf8_lossy(&tail).trim().to_owned()
    }

    /// Runs `work` on the disk in another thread. `None` if `work` takes too long, or if earlier work has not ended.
    async fn run_on_disk<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Option<T> {
        if self.shared.asked.swap(true, Ordering::AcqRel) {
            return None;
        }
        let shared = Arc::clone(&self.shared);
        let work = move || {
            let done = work();
            shared.asked.store(false, Ordering::Release);
            done
        };
        wait::within(LIMIT, work).await
    }
}

fn tail_of(file: &File) -> io::Result<Vec<u8>> {
    let length = file.metadata()?.len();
    let mut tail = vec![0; usize::try_from(length.min(TAIL)).unwrap_or_default()];
    file.read_exact_at(&mut tail, length.saturating_sub(TAIL))?;
    Ok(tail)
}
