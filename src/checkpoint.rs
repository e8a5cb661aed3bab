//! The checkpoint: its text and its session are in [`rescue_core::checkpoint`], its file in [`checkpoint_store`].

pub use checkpoint_store as store;
pub(crate) use checkpoint_store::folder;
pub use rescue_core::checkpoint::{compare, format, putback, session};
