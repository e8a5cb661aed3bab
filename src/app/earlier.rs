//! Takes over the checkpoint of an earlier version, which used one default file for all ports.

use std::{
    fs::{self, File},
    io,
    path::Path,
};

use crate::{
    checkpoint::{session, store},
    config::{CHECKPOINT_NAME, Config},
    process::{PID_FILES, beside},
    regular_file,
};

/// Copies the old default checkpoint to this port's default path. Does so only if `config` uses that path, nothing
/// exists there, and the old checkpoint may belong to this port. The old file stays.
pub(super) fn take_over(config: &Config) {
    let own = &config.checkpoint;
    if config.checkpoint_is_given || own.exists() || store::previous_of(own).exists() {
        return;
    }
    let old = own.with_file_name(CHECKPOINT_NAME);
    if old == *own || !may_be_of(&old, config.advertised.port) {
        return;
    }
    match copy_all(&old, own) {
        Ok(()) => tracing::warn!(
            from = %old.display(), to = %own.display(),
            "copied the checkpoint of an earlier version, because each port now has its own checkpoint. Remove the old one \
             if no rosrescue serves port 11311"
        ),
        Err(error) => tracing::error!(
            %error, from = %old.display(), to = %own.display(),
            "could not copy the checkpoint of an earlier version. If it belongs to this port, stop rosrescue, copy it, and \
             start rosrescue again"
        ),
    }
}

/// Whether the checkpoint at `old` may be copied: no running rosrescue uses it, and either an earlier version or a
/// rosrescue at `port` wrote it.
fn may_be_of(old: &Path, port: u16) -> bool {
    if store::holder_of(old).is_some() {
        return false;
    }
    let Ok(Some(loaded)) = store::read(old) else {
        return false;
    };
    let session = session::rebuild(loaded.checkpoint, loaded.records).session;
    session.is_some_and(|session| [0, port].contains(&session.port))
}

/// Copies the checkpoint and its companion files. The checkpoint is copied last, because the next
/// start begins a new session without it.
fn copy_all(old: &Path, own: &Path) -> io::Result<()> {
    let previous = (store::previous_of(old), store::previous_of(own));
    let pid_files = PID_FILES.map(|suffix| (beside(old, suffix), beside(own, suffix)));
    for (from, to) in pid_files.into_iter().chain([previous]) {
        match regular_file::open_ours(&from) {
            Ok(from) => copy(from, &to)?,
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => tracing::warn!(%error, from = %from.display(), "not copied"),
        }
    }
    copy(regular_file::open(old)?, own)
}

fn copy(mut from: File, to: &Path) -> io::Result<()> {
    // The next start removes this file if a crash leaves it behind.
    let fresh = beside(to, ".new");
    let mut file = regular_file::create(&fresh)?;
    io::copy(&mut from, &mut file)?;
    file.sync_all()?;
    fs::rename(&fresh, to)
}
