//! Tests of inspection and injection against the model of a master.

#[path = "../../../ros1-master/src/master/tests/calls.rs"]
#[allow(dead_code, reason = "the tests of the model take the rest")]
pub(super) mod calls;
mod inspect;
mod planning;

use crate::master::{Master, Method, Notice, Request};
use crate::xmlrpc::{Reply, Value};
use calls::*;
