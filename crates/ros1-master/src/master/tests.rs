//! Tests of the model alone. `tests/differential` checks that it equals a real rosmaster.

mod calls;
mod costs;
mod exact;
mod params;
mod quirks;

use super::{Master, Method, Notice, Request};
use crate::xmlrpc::{Call, Reply, Struct, Value};
use calls::*;
