//! The model on its own. That it is rosmaster's equal is for `tests/differential`.

mod calls;
mod costs;
mod exact;
mod params;
mod quirks;

use super::{Master, Method, Notice, Request};
use crate::xmlrpc::{Call, Reply, Struct, Value};
use calls::*;
