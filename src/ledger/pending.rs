//! Writes that the mirror has answered and that the present master may not have run.

use rescue_core::checkpoint::format::PendingWrite;
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
    /// The number of each write's record in the journal.
    seqs: Vec<u64>,
    bytes: usize,
    /// Number of pending writes that come from a checkpoint.
    restored: usize,
}

impl PendingWrites {
    /// Adds `calls`, whose records in the journal end with number `last`.
    ///
    /// # Errors
    ///
    /// If there are too many pending writes. Then all of them are dropped.
    pub(super) fn extend(
        &mut self,
        calls: impl IntoIterator<Item = Request>,
        last: u64,
    ) -> Result<(), TooMany> {
        let before = self.calls.len();
        for call in calls {
            self.bytes += size(&call);
            self.calls.push(call);
        }
        let added = self.calls.len() - before;
        let first = (last + 1).saturating_sub(added as u64);
        self.seqs.extend((first..).take(added));
        if !self.is_bounded() {
            self.clear();
            return Err(TooMany);
        }
        Ok(())
    }

    /// The pending writes of a checkpoint.
    ///
    /// # Errors
    ///
    /// If there are too many of them.
    pub(super) fn restored(writes: Vec<PendingWrite>) -> Result<Self, TooMany> {
        let mut pending = Self {
            restored: writes.len(),
            ..Self::default()
        };
        for PendingWrite { seq, call } in writes {
            pending.bytes += size(&call);
            pending.calls.push(call);
            pending.seqs.push(seq);
        }
        pending.is_bounded().then_some(pending).ok_or(TooMany)
    }

    fn is_bounded(&self) -> bool {
        self.calls.len() <= COUNT_MAX && self.bytes <= BYTES_MAX
    }

    /// The number of the last write's record, or 0.
    pub(super) fn last(&self) -> u64 {
        self.seqs.last().copied().unwrap_or_default()
    }

    /// Drops the pending writes that come from a checkpoint. Returns the number of the last one's record, or 0.
    pub(super) fn forget_restored(&mut self) -> u64 {
        let last = self.seqs.get(..self.restored).and_then(<[u64]>::last);
        let last = last.copied().unwrap_or_default();
        self.drop_first(self.restored);
        last
    }

    /// Drops the writes up to record `seq`, which the master has run.
    pub(super) fn acknowledge(&mut self, seq: u64) {
        self.drop_first(self.seqs.partition_point(|of| *of <= seq));
    }

    fn drop_first(&mut self, count: usize) {
        self.seqs.drain(..count);
        let gone = self.calls.drain(..count);
        self.bytes -= gone.map(|call| size(&call)).sum::<usize>();
        self.restored = self.restored.saturating_sub(count);
    }

    /// Whether `call` can be added, and there are fewer than `most` pending writes.
    pub(super) fn has_room_for(&self, call: &Request, most: usize) -> bool {
        self.calls.len() < most && self.bytes + size(call) <= BYTES_MAX
    }

    /// Whether this process has added `call`. Calls from a checkpoint do not count.
    pub(super) fn contains(&self, call: &Request) -> bool {
        let added = self.calls.get(self.restored..).unwrap_or_default();
        added.contains(call)
    }

    /// The pending writes with the numbers of their records, for a checkpoint.
    pub(super) fn numbered(&self) -> Vec<PendingWrite> {
        let numbered = self.seqs.iter().zip(&self.calls);
        let numbered = numbered.map(|(seq, call)| PendingWrite {
            seq: *seq,
            call: call.clone(),
        });
        numbered.collect()
    }

    pub(super) fn calls(&self) -> &[Request] {
        &self.calls
    }

    pub(super) fn clear(&mut self) {
        *self = Self::default();
    }
}

/// The size of a call's parameters in bytes, approximately.
fn size(call: &Request) -> usize {
    call.params().iter().map(Value::size).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros1_master::master::Method;

    #[test]
    fn a_write_that_a_checkpoint_has_too_outlives_it() {
        let write = || Request::new(Method::SetParam, ["/n", "/k", "v"]);
        let (seq, call) = (3, write());
        let mut pending = PendingWrites::restored(vec![PendingWrite { seq, call }]).unwrap();
        assert!(!pending.contains(&write()));
        pending.extend([write()], 5).unwrap();
        assert!(pending.contains(&write()));
        assert_eq!(pending.forget_restored(), 3);
        assert_eq!(pending.calls(), [write()]);
    }

    #[test]
    fn too_many_or_too_large_writes_are_dropped() {
        let write = |text: String| Request::new(Method::SetParam, ["/n", "/k", text.as_str()]);
        let mut pending = PendingWrites::default();
        for _ in 0..COUNT_MAX {
            pending.extend([write(String::new())], 0).unwrap();
        }
        assert!(pending.extend([write(String::new())], 0).is_err());
        assert_eq!(pending.calls(), []);
        pending
            .extend([write("x".repeat(BYTES_MAX / 2))], 0)
            .unwrap();
        assert!(
            pending
                .extend([write("x".repeat(BYTES_MAX / 2))], 0)
                .is_err()
        );
        pending.extend([write(String::new())], 0).unwrap();
        assert_eq!(pending.calls().len(), 1);
    }
}
