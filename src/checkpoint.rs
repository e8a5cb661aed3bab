//! The checkpoint: its file format, its store on disk, and whether its session continues.

pub mod format;
pub mod session;
pub mod store;
