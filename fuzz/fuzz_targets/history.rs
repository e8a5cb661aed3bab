//! Reads any bytes as parts of a checkpoint's history, and again with corrected check sums.

#![no_main]

#[path = "../checks/history.rs"]
mod history;
#[path = "../checks/seal.rs"]
mod seal;
#[path = "../checks/seal_records.rs"]
mod seal_records;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| history::check(bytes));
