//! Tests of the model alone. `tests/differential` checks that it equals a real rosmaster.

mod costs;
mod exact;
mod params;
mod ports;
mod quirks;

use ros1_master::{
    master::{Master, Method, Notice, Request},
    xmlrpc::{Call, Reply, Struct, Value},
};
use test_support::calls::*;
