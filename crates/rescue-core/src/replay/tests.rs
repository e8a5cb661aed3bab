//! Tests of inspection and injection against the model of a master.

mod inspect;
mod planning;

use crate::master::{Master, Method, Notice, Request};
use crate::xmlrpc::{Reply, Value};
use test_support::calls::*;
