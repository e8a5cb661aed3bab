//! Writes that the mirror has answered and that the present master may not have run.

use ros1_master::{master::Request, xmlrpc::Value};

/// Maximum number of pending writes.
const COUNT_MAX: usize = 10_000;
/// Maximum memory of the pending writes in bytes, approximately.
const BYTES_MAX: usize = 16 << 20;

/// There were more pending writes than [`COUNT_MAX`] or [`BYTES_MAX`] allow, so all were dropped.
#[derive(Debug)]
pub(super) struct TooMany;

/// Writes that the mirror has answered and the present master may not have run, in the order in which they were
/// answered. Bounded.
#[derive(Debug, Default)]
pub(super) struct PendingWrites {
    calls: Vec<Request>,
    bytes: usize,
    /// Number of pending writes that come from a checkpoint.
    restored: usize,
}

impl PendingWrites {
    /// Adds `calls`.
    ///
    /// # Errors
    ///
    /// If there are too many pending writes. Then all of them are dropped.
    pub(super) fn extend(
        &mut self,
        calls: impl IntoIterator<Item = Request>,
    ) -> Result<(), TooMany> {
        for call in calls {
            self.bytes += call.params().iter().map(Value::size).sum::<usize>();
            self.calls.push(call);
        }
        if self.calls.len() > COUNT_MAX || self.bytes > BYTES_MAX {
            self.clear();
            return Err(TooMany);
        }
        Ok(())
    }

    /// Marks the present pending writes as coming from a checkpoint.
    pub(super) fn are_restored(&mut self) {
        self.restored = self.calls.len();
    }

    /// Drops the pending writes that come from a checkpoint.
    pub(super) fn forget_restored(&mut self) {
        let calls = self.calls.split_off(self.restored);
        self.clear();
        // This cannot fail, because there are fewer writes than before.
        let _ = self.extend(calls);
    }

    /// Whether this process has added `call`. Calls from a checkpoint do not count.
    pub(super) fn contains(&self, call: &Request) -> bool {
        let added = self.calls.get(self.restored..).unwrap_or_default();
        added.contains(call)
    }

    pub(super) fn calls(&self) -> &[Request] {
        &self.calls
    }

    pub(super) fn clear(&mut self) {
        *self = Self::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros1_master::master::Method;

    #[test]
    fn a_write_that_a_checkpoint_has_too_outlives_it() {
        let write = || Request::new(Method::SetParam, ["/n", "/k", "v"]);
        let mut pending = PendingWrites::default();
        pending.extend([write()]).unwrap();
        pending.are_restored();
        assert!(!pending.contains(&write()));
        pending.extend([write()]).unwrap();
        assert!(pending.contains(&write()));
        pending.forget_restored();
        assert_eq!(pending.calls(), [write()]);
    }

    #[test]
    fn too_many_or_too_large_writes_are_dropped() {
        let write = |text: String| Request::new(Method::SetParam, ["/n", "/k", text.as_str()]);
        let mut pending = PendingWrites::default();
        for _ in 0..COUNT_MAX {
            pending.extend([write(String::new())]).unwrap();
        }
        assert!(pending.extend([write(String::new())]).is_err());
        assert_eq!(pending.calls(), []);
        pending.extend([write("x".repeat(BYTES_MAX / 2))]).unwrap();
        assert!(pending.extend([write("x".repeat(BYTES_MAX / 2))]).is_err());
        pending.extend([write(String::new())]).unwrap();
        assert_eq!(pending.calls().len(), 1);
    }
}
