//! The command line of rosrescue.

fn main() {}
