//! XML-RPC: values, and their way from text and to text. Nothing here knows of ROS.

mod value;

pub use value::{Call, Reply, Struct, Value};
