//! Decodes any bytes as a call and as a reply.

#![no_main]

#[path = "../checks/xmlrpc.rs"]
mod xmlrpc;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| xmlrpc::check(bytes));
