//! Starts tasks.
//!
//! The work is boxed: otherwise the compiler generates the runtime's code again for each piece of work, a tenth of the
//! program.

use std::{ops::Deref, pin::Pin};

use tokio::{runtime::Handle, task::JoinHandle};

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

/// A large value. To free its memory takes long, so a thread that may block does that, while the dropping thread goes on
/// answering calls.
#[derive(Debug)]
pub(crate) struct DeferredDrop<T: Send + 'static>(Option<T>);

impl<T: Send + 'static> From<T> for DeferredDrop<T> {
    fn from(value: T) -> Self {
        Self(Some(value))
    }
}

impl<T: Send + 'static> Deref for DeferredDrop<T> {
    type Target = T;

    fn deref(&self) -> &T {
        match &self.0 {
            Some(value) => value,
            None => unreachable!("only `drop` takes the value"),
        }
    }
}

impl<T: Send + 'static> Drop for DeferredDrop<T> {
    fn drop(&mut self) {
        let value = self.0.take();
        // A simulation has no runtime.
        if Handle::try_current().is_ok() {
            spawn_blocking(move || drop(value));
        }
    }
}

#[cfg(test)]
mod tests {
    use std::{sync::mpsc, thread};

    use super::*;

    /// Tells in which thread it was dropped.
    struct Told(mpsc::SyncSender<thread::ThreadId>);

    impl Drop for Told {
        fn drop(&mut self) {
            self.0.send(thread::current().id()).unwrap();
        }
    }

    #[test]
    fn another_thread_frees_a_large_value_if_there_is_a_runtime() {
        let (sender, dropped) = mpsc::sync_channel(1);
        let large = || DeferredDrop::from(Told(sender.clone()));
        let here = thread::current().id();
        drop(large());
        assert_eq!(dropped.recv().unwrap(), here);
        let runtime = tokio::runtime::Builder::new_current_thread()
            .build()
            .unwrap();
        runtime.block_on(async { drop(large()) });
        assert_ne!(dropped.recv().unwrap(), here);
    }
}
