//! The logging configuration that rosmaster starts with. Python evaluates part of it, so it must not be in a file that
//! another user could change.

use std::{
    fs::File,
    io::{self, Write},
    os::fd::AsRawFd,
    sync::Arc,
};

use rustix::fs::{MemfdFlags, SealFlags, fcntl_add_seals, memfd_create};

/// Environment variable that names the configuration file.
pub(super) const VARIABLE: &str = "ROS_PYTHON_LOG_CONFIG_FILE";
/// Logs to the file only. rosmaster's default configuration also has a handler for the screen,
/// which imports half of rospy. Without that handler rosmaster starts in 72 ms instead of 132 ms,
/// and master.log stays the same.
const TEXT: &str = include_str!("rosmaster_logging.conf");

/// A sealed file in memory, which every child process inherits.
#[derive(Clone, Debug)]
pub(super) struct LogConfig(Arc<File>);

impl LogConfig {
    /// Creates the file. `None` if the user has a configuration, or if the kernel does not support sealed files in
    /// memory. Without the file rosmaster only starts more slowly.
    pub(super) fn unless_given() -> Option<Self> {
        match std::env::var_os(VARIABLE) {
            Some(given) if !given.is_empty() => None,
            _ => Self::new().ok(),
        }
    }

    fn new() -> io::Result<Self> {
        // `exec` must not close the file, because a child opens it by its descriptor number in this process.
        let file = memfd_create("rosmaster-logging.conf", MemfdFlags::ALLOW_SEALING)?;
        let mut file = File::from(file);
        file.write_all(TEXT.as_bytes())?;
        let seals = SealFlags::WRITE | SealFlags::GROW | SealFlags::SHRINK | SealFlags::SEAL;
        fcntl_add_seals(&file, seals)?;
        Ok(Self(Arc::new(file)))
    }

    /// Path of the file in a child process.
    pub(super) fn path(&self) -> String {
        format!("/proc/self/fd/{}", self.0.as_raw_fd())
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn the_configuration_can_be_read_and_not_changed() {
        let config = LogConfig::new().unwrap();
        assert_eq!(fs::read_to_string(config.path()).unwrap(), TEXT);
        assert!(fs::write(config.path(), "other").is_err());
        assert_eq!(fs::read_to_string(config.path()).unwrap(), TEXT);
    }
}
