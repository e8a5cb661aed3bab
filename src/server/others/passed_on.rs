//! Answers that a follower passes on: the leader holds a value until the follower confirms that the caller has the answer.

use std::{
    collections::VecDeque,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use bytes::Bytes;
use tokio::{runtime::Handle, time::Instant};

use super::{super::replies::UntilWritten, control::Control};
use crate::upstream::{Head, peer::Peer};

/// How long a value is kept whose follower says nothing: it may have died. Nothing waits for an answer that is older than
/// [`ANSWER_LIMIT`](rescue_core::order::ANSWER_LIMIT), but its node is told the state when it has been passed on.
const KEPT: Duration = Duration::from_secs(60);

/// Answers on their way through followers to callers. With each answer, the leader keeps a value until the caller has
/// the answer, because some notifications must wait for that.
#[derive(Default)]
pub(crate) struct ForwardedAnswers(Mutex<Inner>);

#[derive(Default)]
struct Inner {
    last: u64,
    /// The answers by number, oldest first.
    held: VecDeque<(Instant, u64, UntilWritten)>,
}

impl std::fmt::Debug for ForwardedAnswers {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("ForwardedAnswers")
    }
}

impl ForwardedAnswers {
    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Keeps `held`, which must not be dropped before the caller has the answer. Returns the answer's number, for
    /// [`Self::release`]. Drops values that are older than [`KEPT`].
    pub(super) fn add(&self, now: Instant, held: UntilWritten) -> u64 {
        let mut old = Vec::new();
        let mut passing = self.lock();
        let Inner { last, held: kept } = &mut *passing;
        while let Some((since, ..)) = kept.front()
            && now.duration_since(*since) > KEPT
        {
            old.extend(kept.pop_front());
        }
        *last += 1;
        kept.push_back((now, *last, held));
        *last
    }

    /// Notes that the answer with this number has been written to its caller, or never will be.
    pub(super) fn release(&self, number: u64) {
        let mut passing = self.lock();
        let at = passing.held.iter().position(|(_, of, _)| *of == number);
        let held = at.and_then(|at| passing.held.remove(at));
        drop(passing);
        drop(held);
    }
}

/// On drop, tells the leader that its answer has been passed on.
pub(super) struct ConfirmOnDrop {
    pub(super) leader: Arc<Peer>,
    pub(super) term: u64,
    pub(super) number: String,
}

impl Drop for ConfirmOnDrop {
    fn drop(&mut self) {
        // Without a runtime, rosrescue is stopping.
        let Ok(runtime) = Handle::try_current() else {
            return;
        };
        let (leader, term) = (self.leader.clone(), self.term);
        let call = Control::answer_passed_on(&self.number);
        let body = Bytes::from(call.encode());
        runtime.spawn(async move {
            if let Err(error) = leader.forward(term, &Head::default(), &body).await {
                tracing::debug!(%error, "could not tell the leader that an answer was passed on");
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use tokio::sync::mpsc;

    use super::*;

    /// Sends a report when it is dropped.
    struct SendOnDrop(mpsc::Sender<u64>, u64);

    impl Drop for SendOnDrop {
        fn drop(&mut self) {
            let _ = self.0.try_send(self.1);
        }
    }

    #[test]
    fn an_answer_is_held_until_its_follower_has_passed_it_on_or_says_nothing() {
        let (tell, mut told) = mpsc::channel(8);
        let passing = ForwardedAnswers::default();
        let now = Instant::now();
        let keep =
            |at, number| passing.add(at, UntilWritten::new(SendOnDrop(tell.clone(), number)));
        let first = keep(now, 1);
        let second = keep(now, 2);
        assert!(told.try_recv().is_err());
        passing.release(second);
        passing.release(second);
        assert_eq!(told.try_recv(), Ok(2));
        assert_ne!(first, second);
        keep(now + 2 * KEPT, 3);
        assert_eq!(told.try_recv(), Ok(1));
        assert!(told.try_recv().is_err());
    }
}
