//! The base of all integration tests: real rosmasters and nodes, rosrescue itself, fakes of both sides, the
//! state of a master, and waiting for conditions.
//!
//! Every process that a test starts carries the token of its [`Scratch`] in its environment. When the scratch
//! folder is dropped, even after a panic, all of them are ended by their process ids. Each test has a network namespace
//! of its own, where the system allows it; what is still in it when the test ends is killed.

#![allow(
    dead_code,
    unused_imports,
    reason = "every test file takes its own part"
)]
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

mod blocks;
mod browser;
mod disk;
mod failing;
mod fake;
mod feed;
mod kinds;
pub(crate) mod links;
mod name_server;
mod namespace;
mod netns;
mod node;
mod patience;
mod process;
mod relay;
mod report;
mod rescue;
mod robot;
mod ros;
mod rpc;
mod scratch;
mod servers;
mod state;
mod status;
mod streams;
mod turn;
mod twins;
pub(crate) mod writers;

pub(crate) use blocks::{blocks, documents};
pub(crate) use browser::Browser;
pub(crate) use disk::{FailingDisk, SmallDisk, Trouble};
pub(crate) use failing::{Failing, Failures, Forkserver, page};
pub(crate) use fake::{FakeMaster, FakeNode, ReceivedCall, is_from_rosrescue, read_request};
pub(crate) use feed::{feed, gzip};
pub(crate) use kinds::{kinds, sorted, unordered};
pub(crate) use name_server::NameServer;
pub(crate) use namespace::{is_isolated, isolate};
pub(crate) use netns::{Netns, ip};
pub(crate) use node::{Library, Node};
pub(crate) use patience::{
    Control, Finish, PATIENCE, comes_true, eventually, eventually_some, holds, within,
};
pub(crate) use process::{Process, alive, behind, signal, stop};
pub(crate) use relay::Relay;
pub(crate) use report::report;
pub(crate) use rescue::{PROGRAM, Rescue, Setup};
pub(crate) use robot::{Mode, Robot};
pub(crate) use ros::{
    NODES, Rosmaster, Tool, command, cpp_nodes, find_program, path_with_quick_rosversion,
    ros_command,
};
pub(crate) use rpc::{Client, Response, Wire, encode_call, http_request, request, unreadable};
pub(crate) use scratch::{Scratch, free_port};
pub(crate) use servers::{LIMIT, Servers};
pub(crate) use state::State;
pub(crate) use status::{names, open_to, status, try_status};
pub(crate) use streams::{LIBRARIES, Streams, port_of};
pub(crate) use turn::{Turn, turn};
pub(crate) use twins::{Twins, assert_form};

/// `value` as text for a message, shortened if it is long.
pub(crate) fn short(value: impl std::fmt::Debug) -> String {
    format!("{value:?}").chars().take(200).collect()
}

/// The parameters of a call, from anything that converts to [`ros1_master::xmlrpc::Value`].
#[allow(unused_macros)]
macro_rules! params {
    ($($param:expr),* $(,)?) => {
        vec![$(ros1_master::xmlrpc::Value::from($param)),*]
    };
}
pub(crate) use params;

/// A struct value.
#[allow(unused_macros)]
macro_rules! tree {
    ($($key:literal => $value:expr),* $(,)?) => {
        ros1_master::xmlrpc::Value::Struct(ros1_master::xmlrpc::Struct::from_iter([
            $(($key.to_owned(), ros1_master::xmlrpc::Value::from($value))),*
        ]))
    };
}
pub(crate) use tree;

/// Makes a test for each way to run rosrescue, `name::core` and `name::proxy`, which call `name` with the
/// mode.
#[allow(unused_macros)]
macro_rules! in_both_modes {
    ($($test:ident),* $(,)?) => {$(
        mod $test {
            use crate::support::Mode;

            #[test]
            fn core() {
                super::$test(Mode::Core);
            }

            #[test]
            fn proxy() {
                super::$test(Mode::Proxy);
            }
        }
    )*};
}
pub(crate) use in_both_modes;
