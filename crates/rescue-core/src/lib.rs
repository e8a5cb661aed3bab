//! What rosrescue decides, without a runtime, sockets, files or a clock: time is an argument, and work is
//! returned as values.
//!
//! * [`admission`]: which requests are refused by their headers.
//! * [`hide`]: which values of parameters are not shown.
//! * [`replay`]: recognising a master, reading its state, and the one call that restores a state in it.
//! * [`lifecycle`]: when a master is started, examined, probed and killed, and when calls pass to it.
//! * [`health`]: which nodes are alive, dead or unreachable, by their answers and by the kernel; names that move or are
//!   fought for.
//! * [`order`]: in which order a node gets the news about a topic, a parameter or its own name.
//! * [`checkpoint`]: the checkpoint's text, whether its session continues, and how two states differ.
//! * [`cluster`]: with several computers, which one leads, and whose writes count.

#![cfg_attr(
    test,
    allow(
        clippy::disallowed_macros,
        clippy::disallowed_methods,
        reason = "tests start at some time, and print what they counted"
    )
)]

pub mod admission;
pub mod checkpoint;
pub mod cluster;
pub mod health;
pub mod hide;
pub mod lifecycle;
pub mod order;
pub mod replay;
