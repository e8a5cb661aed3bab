//! What the benches share.

pub(crate) mod machine;
pub(crate) mod second;

#[path = "../../tests/support/mod.rs"]
pub(crate) mod support;
