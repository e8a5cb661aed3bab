//! The checkpoint: its text, whether its session continues, and how two states differ.

pub mod compare;
pub mod format;
pub mod log;
pub mod putback;
pub mod session;
