//! The checkpoint: its file format, its store on disk, and whether its session continues.

pub mod compare;
pub(crate) mod folder;
pub mod format;
pub mod putback;
pub mod session;
pub mod store;
