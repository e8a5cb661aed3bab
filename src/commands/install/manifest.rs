//! What `rosrescue install` has done, for the next `install` and for `uninstall`.

use std::{collections::BTreeMap, path::PathBuf};

use serde::{Deserialize, Serialize};

#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(in crate::commands) struct Manifest {
    /// Of the program that wrote it.
    pub(super) version: String,
    /// Each file that was written, with the check sum (CRC-32C) of its content.
    pub(super) files: BTreeMap<PathBuf, u32>,
    /// Units of others that were switched off.
    pub(super) disabled: Vec<Disabled>,
    pub(super) run_as: Option<String>,
    pub(super) service: Vec<String>,
    pub(super) settings: BTreeMap<String, String>,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Disabled {
    pub(super) unit: String,
    pub(super) was_enabled: bool,
    pub(super) was_active: bool,
}

/// What is known of a file before anything is changed.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(in crate::commands) struct Present {
    pub(super) crc: u32,
    /// If it is text.
    pub(super) text: Option<String>,
}

impl Manifest {
    pub(in crate::commands) fn files(&self) -> impl Iterator<Item = &PathBuf> {
        self.files.keys()
    }
}
