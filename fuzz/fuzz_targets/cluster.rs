//! Reads any bytes as what other computers have written to etcd or sent.

#![no_main]

#[path = "../checks/cluster.rs"]
mod cluster;
#[path = "../checks/seal_records.rs"]
mod seal_records;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| cluster::check(bytes));
