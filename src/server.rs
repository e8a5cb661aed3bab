//! What clients talk to: listener, admission, calls and pages.

pub mod admission;
pub mod body;
pub mod clients;
pub mod deadlines;
pub mod idle;
pub mod listener;
pub mod pages;
pub mod service;
