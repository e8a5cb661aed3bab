//! How far into the journal the answers of this computer have shown.

use std::sync::{Mutex, PoisonError};

use rescue_core::cluster::standing::JournalPosition;

/// The furthest position in the journal that an answer on this computer has shown. The mirror must not answer before it has
/// reached that position.
#[derive(Debug)]
pub(crate) struct Shown(Mutex<JournalPosition>);

impl Shown {
    pub(crate) fn new() -> Self {
        Self(Mutex::new(JournalPosition::at_start()))
    }

    pub(super) fn get(&self) -> JournalPosition {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn raise(&self, position: JournalPosition) {
        let mut shown = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        *shown = shown.max(position);
    }
}
