//! Recognises a request of this process that comes back to it: the master's address is rosrescue's own.
//!
//! The first request of each connection to a master has a number that nobody can guess, used once and only while the
//! request is open. A constant would be a weapon: a program that has seen it in a request could send it and end rosrescue.

use std::{
    collections::BTreeSet,
    hash::{BuildHasher, RandomState},
    sync::{
        LazyLock, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
};

use hyper::header::HeaderValue;

/// The numbers of the requests that are open.
static OPEN: Mutex<BTreeSet<u64>> = Mutex::new(BTreeSet::new());
/// The keys come from the operating system, so the hashes of consecutive numbers cannot be guessed.
static KEYS: LazyLock<RandomState> = LazyLock::new(RandomState::new);
static LAST: AtomicU64 = AtomicU64::new(0);

fn open() -> MutexGuard<'static, BTreeSet<u64>> {
    OPEN.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A request to a master. It counts as open until this value is dropped.
#[derive(Debug)]
pub(super) struct OpenRequest(u64);

impl OpenRequest {
    pub(super) fn begin() -> Self {
        let number = KEYS.hash_one(LAST.fetch_add(1, Ordering::Relaxed));
        open().insert(number);
        Self(number)
    }

    /// The value of the request's header.
    pub(super) fn value(&self) -> HeaderValue {
        HeaderValue::from(self.0)
    }
}

impl Drop for OpenRequest {
    fn drop(&mut self) {
        open().remove(&self.0);
    }
}

/// Whether a request with this header is an open one of this process. Each is recognised once.
pub(crate) fn is_own(value: &HeaderValue) -> bool {
    let number = value.to_str().ok().and_then(|text| text.parse().ok());
    number.is_some_and(|number: u64| open().remove(&number))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_is_recognised_once_and_only_while_it_is_open() {
        let request = OpenRequest::begin();
        let value = request.value();
        assert!(is_own(&value));
        assert!(!is_own(&value), "replayed");
        let request = OpenRequest::begin();
        let other = request.value();
        assert_ne!(value, other);
        drop(request);
        assert!(!is_own(&other), "its answer has come");
        for forged in ["0", "1", "", "x", "18446744073709551616"] {
            assert!(!is_own(&HeaderValue::from_static(forged)), "{forged}");
        }
    }
}
