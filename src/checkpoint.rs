//! The checkpoint: the file's format, the store on the disk, and whether its session goes on.

pub mod format;
pub mod session;
pub mod store;
