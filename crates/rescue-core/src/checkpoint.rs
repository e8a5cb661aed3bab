//! The checkpoint: its text, whether its session continues, and how two states differ.

pub mod change_log;
pub mod compare;
pub mod format;
pub mod putback;
pub mod session;
