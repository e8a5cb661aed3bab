//! Which computers have stopped notifying nodes, so that the leader notifies all nodes of the present state again.

use std::collections::HashMap;

use super::MemberEntryChange;

/// The markers in member entries that tell who has stopped notifying nodes.
#[derive(Debug, Default)]
pub(super) struct Notifying {
    /// How often this process has stopped notifying nodes.
    stopped: u64,
    /// The markers in the last entries of the others.
    markers: HashMap<String, String>,
}

impl Notifying {
    /// Notes that this computer no longer notifies nodes.
    pub(super) fn stop(&mut self) {
        self.stopped += 1;
    }

    /// The marker in this computer's entry: see [`MemberEntry::notifies`](super::MemberEntry::notifies). `keeps` says whether the leader
    /// lacks partition writes of this computer.
    pub(super) fn marker(&self, process: &str, keeps: bool) -> String {
        match keeps {
            true => String::new(),
            false => format!("{process} {}", self.stopped),
        }
    }

    /// Notes the entry of another computer. Returns whether that computer has stopped notifying nodes since its last
    /// entry.
    pub(super) fn note_entry(&mut self, change: &MemberEntryChange) -> bool {
        let Some(entry) = &change.entry else {
            return false;
        };
        let marker = &entry.notifies;
        // A first marker counts, too, if the entry had none while the leader lacked writes of that computer, or if this is
        // its first entry since etcd lost the others, and it has stopped before.
        let before = self.markers.insert(change.name.clone(), marker.clone());
        let is_new = match before {
            Some(before) => before != *marker,
            None => !marker.ends_with(" 0"),
        };
        !marker.is_empty() && is_new
    }
}
