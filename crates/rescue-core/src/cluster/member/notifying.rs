//! Which computers have stopped notifying nodes, so that the leader notifies all nodes of the present state again.

use std::collections::HashMap;

use super::Heard;

/// What the entries among the members say about notifications.
#[derive(Debug, Default)]
pub(super) struct Notifying {
    /// How often this process has stopped notifying nodes.
    stopped: u64,
    /// What the entries of the others said last.
    heard: HashMap<String, String>,
}

impl Notifying {
    /// Notes that this computer no longer notifies nodes.
    pub(super) fn stop(&mut self) {
        self.stopped += 1;
    }

    /// What this computer's entry says: see [`Said::notifies`](super::Said::notifies). `keeps` says whether the leader
    /// lacks partition writes of this computer.
    pub(super) fn marker(&self, process: &str, keeps: bool) -> String {
        match keeps {
            true => String::new(),
            false => format!("{process} {}", self.stopped),
        }
    }

    /// Notes the entry of another computer. Returns whether that computer has stopped notifying nodes since its last
    /// entry.
    pub(super) fn note_entry(&mut self, heard: &Heard) -> bool {
        let says = heard.said.as_ref().map(|said| &said.notifies);
        let Some(says) = says.filter(|says| !says.is_empty()) else {
            return false;
        };
        let before = self.heard.insert(heard.name.clone(), says.clone());
        before.is_some_and(|before| before != *says)
    }
}
