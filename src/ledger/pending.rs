//! Writes that the mirror has answered and the present incarnation may not have run.

use crate::xmlrpc::{Call, Value};

/// Most of them that are kept,
const COUNT_MAX: usize = 10_000;
/// and most bytes of text and data in them.
const BYTES_MAX: usize = 16 << 20;

/// They are too many to tell what of a master's state is newer than the mirror's.
#[derive(Debug)]
pub(super) struct TooMany;

/// Pending writes, in the order in which they were answered. Bounded.
#[derive(Debug, Default)]
pub(super) struct PendingWrites {
    calls: Vec<Call>,
    bytes: usize,
}

impl PendingWrites {
    /// Adds `calls`.
    ///
    /// # Errors
    ///
    /// If they are too many: all are dropped then.
    pub(super) fn extend(&mut self, calls: impl IntoIterator<Item = Call>) -> Result<(), TooMany> {
        for call in calls {
            self.bytes += call.params.iter().map(size).sum::<usize>();
            self.calls.push(call);
        }
        if self.calls.len() > COUNT_MAX || self.bytes > BYTES_MAX {
            self.clear();
            return Err(TooMany);
        }
        Ok(())
    }

    pub(super) fn contains(&self, call: &Call) -> bool {
        self.calls.contains(call)
    }

    pub(super) fn calls(&self) -> &[Call] {
        &self.calls
    }

    pub(super) fn clear(&mut self) {
        *self = Self::default();
    }
}

/// Bytes that a value takes, about.
fn size(value: &Value) -> usize {
    size_of::<Value>()
        + match value {
            Value::String(text) | Value::DateTime(text) | Value::BigInt(text) => text.len(),
            Value::Base64(bytes) => bytes.len(),
            Value::Array(elements) => elements.iter().map(size).sum(),
            Value::Struct(members) => members.iter().map(|(k, v)| k.len() + size(v)).sum(),
            Value::Nil | Value::Bool(_) | Value::Int(_) | Value::Double(_) => 0,
        }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn too_many_or_too_large_writes_are_dropped() {
        let write =
            |text: String| Call::new("setParam", vec!["/n".into(), "/k".into(), text.into()]);
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
