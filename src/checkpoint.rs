//! The checkpoint: its format, its store on disk, and the decision whether its session continues.

pub use checkpoint_store as store;
pub use rescue_core::checkpoint::{compare, format, log, putback, session};
