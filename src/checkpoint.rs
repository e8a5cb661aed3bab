//! The checkpoint: its format, its store on disk, and the decision whether its session continues.

pub mod compare;
pub(crate) mod folder;
pub mod format;
pub mod putback;
pub mod session;
pub mod store;
