//! Keeps whether etcd answers, for the status and the log.

use std::{
    sync::{Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use crate::{
    cluster::replica::ReplicaError,
    limit::{AlarmLimit, alarm, all_clear},
};

/// The last failure of etcd, and when it last answered.
#[derive(Debug)]
pub(super) struct Trouble(Mutex<(Option<(Instant, String)>, Instant)>);

/// Limits the log lines that etcd does not answer, and that it answers again.
static TROUBLE: AlarmLimit = AlarmLimit::new();

impl Default for Trouble {
    fn default() -> Self {
        Self(Mutex::new((None, Instant::now())))
    }
}

impl Trouble {
    fn lock(&self) -> MutexGuard<'_, (Option<(Instant, String)>, Instant)> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn set(&self, error: &ReplicaError) {
        self.report(error.to_string());
    }

    fn report(&self, text: String) {
        let (trouble, _) = &mut *self.lock();
        match trouble {
            Some((_, said)) => *said = text,
            None => {
                alarm!(warn, TROUBLE, error = text, "etcd request failed; retrying");
                *trouble = Some((Instant::now(), text));
            }
        }
    }

    /// Reports it if etcd has not answered for longer than `limit`, without waiting for the request under way to fail.
    /// Returns whether it is silent for so long.
    pub(super) fn report_silence(&self, limit: Duration) -> bool {
        let (known, heard) = self.lock().clone();
        let silent = heard.elapsed();
        if silent > limit && known.is_none() {
            self.report(format!("no answer for {:.1} s", silent.as_secs_f64()));
        }
        silent > limit
    }

    pub(super) fn clear(&self) {
        let (trouble, heard) = &mut *self.lock();
        *heard = Instant::now();
        if let Some((since, _)) = trouble.take() {
            all_clear!(info, TROUBLE, after = ?since.elapsed(), "etcd answers again");
        }
    }

    /// Notes the result of a request. Returns what etcd answered, if it did.
    pub(super) fn note_result<T>(&self, result: Result<T, ReplicaError>) -> Option<T> {
        match result {
            Ok(given) => {
                self.clear();
                Some(given)
            }
            Err(error) => {
                self.set(&error);
                None
            }
        }
    }

    pub(super) fn get(&self) -> Option<(Instant, String)> {
        self.lock().0.clone()
    }
}
