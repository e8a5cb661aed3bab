//! Loads any bytes as a checkpoint, and again with corrected check sums.

#![no_main]

#[path = "../checks/checkpoint.rs"]
mod checkpoint;
#[path = "../checks/seal.rs"]
mod seal;
#[path = "../checks/seal_records.rs"]
mod seal_records;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| checkpoint::check(bytes));
