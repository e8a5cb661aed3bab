//! Waiting for optional events, and for disks.

use std::time::Duration;

use tokio::time::Instant;

/// Sleeps until `deadline`; for ever if there is none.
pub(crate) async fn until(deadline: Option<Instant>) {
    match deadline {
        Some(deadline) => tokio::time::sleep_until(deadline).await,
        None => std::future::pending().await,
    }
}

/// The result of `future`; never if there is none. Cancel safe: the future stays with the caller.
pub(crate) async fn for_some<F: Future + Unpin>(future: Option<&mut F>) -> F::Output {
    match future {
        Some(future) => future.await,
        None => std::future::pending().await,
    }
}

/// The next tick of an interval; never if there is none. Cancel safe.
pub(crate) async fn tick(interval: &mut Option<tokio::time::Interval>) {
    match interval {
        Some(interval) => {
            interval.tick().await;
        }
        None => std::future::pending().await,
    }
}

/// The result of `work`, which may wait for a disk, in another thread; none after `limit`. Late work is not ended.
pub(crate) async fn within<T: Send + 'static>(
    limit: Duration,
    work: impl FnOnce() -> T + Send + 'static,
) -> Option<T> {
    let work = tokio::task::spawn_blocking(work);
    tokio::time::timeout(limit, work).await.ok()?.ok()
}
