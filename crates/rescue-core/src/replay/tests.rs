//! Tests of inspection and injection against the model of a master.

mod inspect;
mod planning;

use ros1_master::master::{Master, Method, Notice, Request};
use ros1_master::xmlrpc::{Reply, Value};
use test_support::calls::*;
