//! The logging configuration that rosmaster starts with. Python evaluates a part of it, so it is no file in a folder:
//! another user could change it there.

use std::{
    fs::File,
    io::{self, Write},
    os::fd::AsRawFd,
    sync::Arc,
};

use rustix::fs::{MemfdFlags, SealFlags, fcntl_add_seals, memfd_create};

/// The environment variable that names the file.
pub(super) const VARIABLE: &str = "ROS_PYTHON_LOG_CONFIG_FILE";
/// rosmaster's default logging also has a handler for the screen, which imports half of rospy: a
/// file-only configuration halves its start (132 against 72 ms) and leaves master.log as it is.
const TEXT: &str = "\
# Written by rosrescue for the rosmaster that it supervises: as ROS's own, without the screen.
[loggers]
keys=root
[handlers]
keys=file
[formatters]
keys=default
[logger_root]
level=INFO
handlers=file
[handler_file]
class=handlers.RotatingFileHandler
level=DEBUG
formatter=default
args=(os.environ['ROS_LOG_FILENAME'],'a', 50000000, 4)
[formatter_default]
format=[%(name)s][%(levelname)s] %(asctime)s: %(message)s
";

/// A sealed file in memory, which every child process inherits.
#[derive(Clone, Debug)]
pub(super) struct LogConfig(Arc<File>);

impl LogConfig {
    /// None if the user has a configuration, or the kernel lacks such files: rosmaster only starts slower then.
    pub(super) fn unless_given() -> Option<Self> {
        match std::env::var_os(VARIABLE) {
            Some(given) if !given.is_empty() => None,
            _ => Self::new().ok(),
        }
    }

    fn new() -> io::Result<Self> {
        // Not closed by `exec`: a child opens it by the number that it has here.
        let file = memfd_create("rosmaster-logging.conf", MemfdFlags::ALLOW_SEALING)?;
        let mut file = File::from(file);
        file.write_all(TEXT.as_bytes())?;
        let seals = SealFlags::WRITE | SealFlags::GROW | SealFlags::SHRINK | SealFlags::SEAL;
        fcntl_add_seals(&file, seals)?;
        Ok(Self(Arc::new(file)))
    }

    /// Its path in a child process.
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
