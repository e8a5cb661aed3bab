//! The file system of the checkpoint.

use std::{
    fs, io,
    path::{Path, PathBuf},
};

use checkpoint_store::LockHolder;
use rustix::fs::{Access, StatVfsMountFlags};

/// The file system of the checkpoint.
#[derive(Clone, Debug)]
pub(crate) struct CheckpointDisk {
    pub(crate) checkpoint: PathBuf,
    /// The checkpoint's folder, or its nearest parent that exists.
    pub(crate) folder: PathBuf,
    /// Whether `folder` is the checkpoint's own folder.
    pub(crate) is_folder_there: bool,
    /// Free bytes, and whether the file system is mounted read-only. An error says why both are unknown.
    pub(crate) space: Result<(u64, bool), String>,
    /// How many more files can be created. `None` if the file system has no limit.
    pub(crate) inodes: Option<u64>,
    /// The folder or the checkpoint, if rosrescue cannot write it, and why.
    pub(crate) refused: Option<(PathBuf, String)>,
    /// Type and source of the file system, such as `ext4` and `/dev/sda1`.
    pub(crate) mount: Option<(String, String)>,
    /// Another rosrescue that uses the checkpoint.
    pub(crate) holder: Option<LockHolder>,
    /// Whether the checkpoint's path is a folder.
    pub(crate) is_folder: bool,
}

impl CheckpointDisk {
    pub(super) fn inspect(checkpoint: PathBuf) -> Self {
        let whole = std::path::absolute(&checkpoint).unwrap_or_else(|_| checkpoint.clone());
        let mut above = whole.ancestors().skip(1);
        let folder = above.find(|folder| folder.is_dir());
        let folder = folder.unwrap_or_else(|| Path::new("/")).to_owned();
        let folder = folder.canonicalize().unwrap_or(folder);
        let space = rustix::fs::statvfs(&folder).map_err(|error| error.to_string());
        let inodes = space.as_ref().ok().filter(|space| space.f_files > 0);
        let inodes = inodes.map(|space| space.f_favail);
        let space = space.map(|space| {
            let is_read_only = space.f_flag.contains(StatVfsMountFlags::RDONLY);
            (space.f_bavail.saturating_mul(space.f_frsize), is_read_only)
        });
        let refused = |path: &Path, access| {
            let error = rustix::fs::access(path, access).err()?;
            let is_missing = error == rustix::io::Errno::NOENT;
            (!is_missing).then(|| (path.to_owned(), io::Error::from(error).to_string()))
        };
        let refused = refused(&folder, Access::WRITE_OK | Access::EXEC_OK)
            .or_else(|| refused(&whole, Access::WRITE_OK));
        Self {
            mount: mount_of(&folder),
            holder: checkpoint_store::holder_of(&whole),
            is_folder: whole.is_dir(),
            is_folder_there: whole.parent().is_some_and(Path::is_dir),
            checkpoint: whole,
            folder,
            space,
            inodes,
            refused,
        }
    }
}

/// Type and source of the file system that holds `folder`, read from the mount table.
fn mount_of(folder: &Path) -> Option<(String, String)> {
    let table = fs::read_to_string("/proc/self/mountinfo").ok()?;
    let mounts = table.lines().filter_map(|line| {
        let (before, after) = line.split_once(" - ")?;
        let point = before.split(' ').nth(4)?.replace("\\040", " ");
        let mut after = after.split(' ');
        let found = (after.next()?.to_owned(), after.next()?.to_owned());
        folder.starts_with(&point).then_some((point.len(), found))
    });
    // A later mount hides an earlier one at the same place.
    mounts
        .max_by_key(|(length, _)| *length)
        .map(|(_, found)| found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_disk_of_a_checkpoint_that_is_not_there_yet_is_known() {
        let folder = tempfile::tempdir().unwrap();
        let disk = CheckpointDisk::inspect(folder.path().join("a/b/checkpoint"));
        assert_eq!(disk.folder, folder.path().canonicalize().unwrap());
        assert!(!disk.is_folder_there);
        assert!(CheckpointDisk::inspect(folder.path().join("checkpoint")).is_folder_there);
        assert!(disk.space.unwrap().0 > 0);
        assert!(disk.mount.is_some() && disk.holder.is_none() && disk.refused.is_none());
        assert!(CheckpointDisk::inspect(folder.path().to_owned()).is_folder);
        let (of, source) = mount_of(Path::new("/proc/1")).unwrap();
        assert_eq!((&*of, &*source), ("proc", "proc"));
    }
}
