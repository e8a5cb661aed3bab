//! The checkpoint: its file format, its store on disk, and whether its session continues.

pub mod compare;
pub mod format;
pub mod putback;
pub mod session;
pub mod store;
