//! XML-RPC values, and their encoding and decoding as CPython does it. Knows nothing of ROS.

mod decode;
mod encode;
mod error;
mod number;
mod prolog;
mod python;
mod scan;
#[cfg(test)]
mod tests;
mod value;

pub use decode::{MAX_DEPTH, decode_call, decode_call_for, decode_reply};
pub use encode::{ListWriter, encode_call, encode_node_call, encode_reply, encode_result};
pub(crate) use encode::{MAX_REPLY_DEPTH, encode_call_of, refusal};
pub use error::DecodeError;
pub use prolog::without_doctype;
pub use python::Python;
pub use value::{Call, Reply, Struct, Value};
