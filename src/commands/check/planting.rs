//! Checks whether other users can place files beside the checkpoint.

use std::path::Path;

use checkpoint_store::folder;

use super::{Finding, Severity};

/// The finding for the checkpoint at `path`. `None` if its folders are safe.
pub(super) fn find_unsafe_folder(path: &Path) -> Option<Finding> {
    let (folder, why) = folder::open_to_others(path)?;
    Some(Finding {
        severity: Severity::Warning,
        subject: "checkpoint",
        what: format!(
            "other users may change the robot's state in {}: {why}",
            folder.display()
        ),
        todo: "`rosrescue core --checkpoint ~/.ros/rosrescue/latest-chkpt.yaml`, or another folder that only its user \
               can write to"
            .to_owned(),
    })
}
