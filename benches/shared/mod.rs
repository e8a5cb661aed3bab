//! Code that the benches share.

#[allow(dead_code, reason = "not every bench calls all the time")]
pub(crate) mod caller;
#[allow(dead_code, reason = "not every bench looks at processes")]
pub(crate) mod cpu;
#[allow(dead_code, reason = "not every bench compares with it")]
pub(crate) mod injection;
#[allow(dead_code, reason = "not every bench has load")]
pub(crate) mod load;
pub(crate) mod machine;
#[allow(dead_code, reason = "not every bench has nodes")]
pub(crate) mod nodes;
#[allow(dead_code, reason = "not every bench prints all of it")]
pub(crate) mod numbers;
#[allow(dead_code, reason = "not every bench compares with it")]
pub(crate) mod second;

#[path = "../../tests/support/mod.rs"]
pub(crate) mod support;

use clap::{Args, Parser};

/// The options of a bench, and the one that Cargo adds.
#[derive(Debug, Parser)]
struct Arguments<T: Args> {
    #[command(flatten)]
    options: T,
    /// Passed by `cargo bench`
    #[arg(long, hide = true)]
    bench: bool,
}

/// Parses the options of `bench`. `None` if it runs as a test, in which nothing is measured.
pub(crate) fn options<T: Args>(bench: &str) -> Option<T> {
    let arguments = Arguments::<T>::parse();
    if !arguments.bench {
        println!("nothing is measured in a test; run `cargo bench --bench {bench}`");
        return None;
    }
    Some(arguments.options)
}
