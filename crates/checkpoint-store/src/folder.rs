//! Checks whether other users may change the files in a checkpoint's folder.

use std::{
    fs, io,
    os::unix::fs::MetadataExt,
    path::{Path, PathBuf},
};

/// Mode bit of a folder in which only the owner of a file can rename or remove it.
const STICKY: u32 = 0o1000;

/// Owner and mode of a folder.
#[derive(Clone, Copy, Debug)]
struct Access {
    mode: u32,
    user: u32,
    group: u32,
}

impl Access {
    fn at(folder: &Path) -> io::Result<Self> {
        let metadata = fs::metadata(folder)?;
        Ok(Self {
            mode: metadata.mode(),
            user: metadata.uid(),
            group: metadata.gid(),
        })
    }

    /// Why users other than `own` may create files in the folder. `None` if they may not.
    fn other_writers(self, own: u32) -> Option<&'static str> {
        // Many distributions give each user a group with the same number and no other members.
        let is_private = self.group == self.user || self.group == 0;
        if self.mode & 0o002 != 0 {
            Some("every user may write to it")
        } else if self.mode & 0o020 != 0 && !is_private {
            Some("its group may write to it")
        } else if self.user != own && self.user != 0 {
            Some("it belongs to another user")
        } else {
            None
        }
    }
}

/// The nearest folder above the checkpoint at `path` in which other users may create or replace files, with the reason.
/// `None` if all folders are safe or cannot be examined.
pub fn open_to_others(path: &Path) -> Option<(PathBuf, &'static str)> {
    let own = rustix::process::geteuid().as_raw();
    let path = std::path::absolute(path).ok()?;
    let existing = path
        .ancestors()
        .skip(1)
        .find_map(|it| fs::canonicalize(it).ok());
    let existing = existing?;
    let folders = existing
        .ancestors()
        .map(|it| Some((it, Access::at(it).ok()?)));
    folders
        .flatten()
        .enumerate()
        // A sticky folder matters only if it holds the checkpoint: other users may create files in it, but cannot
        // replace a folder in it.
        .filter(|(level, (_, access))| *level == 0 || access.mode & STICKY == 0)
        .find_map(|(_, (folder, access))| Some((folder.to_owned(), access.other_writers(own)?)))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    #[test]
    fn a_folder_is_open_to_others_if_anyone_but_its_user_and_root_may_write() {
        let writers = |mode, user, group| Access { mode, user, group }.other_writers(1000);
        assert_eq!(writers(0o755, 1000, 1000), None);
        assert_eq!(writers(0o755, 0, 0), None);
        assert_eq!(
            writers(0o775, 1000, 1000),
            None,
            "a group of the user's own"
        );
        assert!(writers(0o775, 1000, 100).is_some());
        assert!(writers(0o1777, 0, 0).is_some());
        assert!(writers(0o755, 1001, 1001).is_some());
    }

    #[test]
    fn a_folder_below_a_sticky_one_is_safe_and_one_below_an_open_one_is_not() {
        let folder = tempfile::tempdir().unwrap();
        let set = |path: &Path, mode| {
            fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
        };
        let above = fs::canonicalize(folder.path()).unwrap();
        let own = above.join("own");
        fs::create_dir(&own).unwrap();
        let found = |name| open_to_others(&own.join(name)).map(|(folder, _)| folder);
        assert_eq!(found("chkpt.yaml"), None);
        set(&above, 0o1777);
        assert_eq!(found("chkpt.yaml"), None);
        set(&above, 0o777);
        assert_eq!(found("chkpt.yaml"), Some(above.clone()));
        set(&own, 0o1777);
        assert_eq!(found("missing/chkpt.yaml"), Some(own.clone()));
    }
}
