//! Waits for optional events, and for disks.

use std::{sync::mpsc, thread, time::Duration};

use tokio::time::Instant;

/// Sleeps until `deadline`, or forever if there is none.
pub(crate) async fn sleep_until(deadline: Option<Instant>) {
    match deadline {
        Some(deadline) => tokio::time::sleep_until(deadline).await,
        None => std::future::pending().await,
    }
}

/// Waits for `future`, or forever if there is none. Cancel safe: the caller keeps the future.
pub(crate) async fn for_some<F: Future + Unpin>(future: Option<&mut F>) -> F::Output {
    match future {
        Some(future) => future.await,
        None => std::future::pending().await,
    }
}

/// Waits for the next tick of `interval`, or forever if there is none. Cancel safe.
pub(crate) async fn tick(interval: &mut Option<tokio::time::Interval>) {
    match interval {
        Some(interval) => {
            interval.tick().await;
        }
        None => std::future::pending().await,
    }
}

/// Runs `work`, which may wait for a disk, in another thread. `None` if it takes longer than `limit`; it then still
/// continues.
pub(crate) async fn within<T: Send + 'static>(
    limit: Duration,
    work: impl FnOnce() -> T + Send + 'static,
) -> Option<T> {
    let work = crate::task::spawn_blocking(work);
    tokio::time::timeout(limit, work).await.ok()?.ok()
}

/// Like [`within`], but blocks this thread.
pub(crate) fn blocking_within<T: Send + 'static>(
    limit: Duration,
    work: impl FnOnce() -> T + Send + 'static,
) -> Option<T> {
    let (sender, receiver) = mpsc::sync_channel(1);
    thread::spawn(move || sender.send(work()));
    receiver.recv_timeout(limit).ok()
}
