//! Starts tasks.
//!
//! The work is boxed: otherwise the compiler generates the runtime's code again for each piece of work, a tenth of the
//! program.

use std::pin::Pin;

use tokio::task::JoinHandle;

/// Work for a task, which results in a `T`.
pub(crate) type BoxedWork<T> = Pin<Box<dyn Future<Output = T> + Send>>;

/// Boxes the `work` of a task.
pub(crate) fn boxed<T>(work: impl Future<Output = T> + Send + 'static) -> BoxedWork<T> {
    Box::pin(work)
}

/// Starts `work` as a task, like [`tokio::spawn`].
pub(crate) fn spawn<T: Send + 'static>(
    work: impl Future<Output = T> + Send + 'static,
) -> JoinHandle<T> {
    tokio::spawn(boxed(work))
}

/// Runs `work` in a thread that may block, like [`tokio::task::spawn_blocking`].
pub(crate) fn spawn_blocking<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> JoinHandle<T> {
    let work: Box<dyn FnOnce() -> T + Send> = Box::new(work);
    tokio::task::spawn_blocking(work)
}
