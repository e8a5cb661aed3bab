//! The ROS Master API and Parameter API as a pure state machine.
//!
//! * [`Master`]: a complete master without IO. [`Master::apply`] answers a call as rosmaster does.
//! * [`Request`]: a call, parsed once, with its [`Method`] and its [`Kind`].
//! * [`Write`]: a call that changes the state, with its arguments by name.
//!
//! Everything follows rosmaster 1.15.15 on Python 3.11, function by function, including the quirks that clients can
//! see. [`Master::set_old`] and [`Master::set_python`] make it follow other versions. Only errors that come from an
//! exception in rosmaster, such as a `deleteParam` below a number, have other texts.

mod api;
mod checks;
mod forget;
mod kind;
mod methods;
mod multicall;
pub mod names;
mod notice;
mod ordered_map;
mod params;
mod registry;
mod request;
pub mod returnable;
mod snapshot;
mod state;
mod tell;
mod updates;
mod would_change;
mod write;

pub use api::{Applied, Method, is_success};
pub use kind::Kind;
pub use multicall::{entry_reply, reply_entry};
pub use names::CALLER_ID;
pub use names::{is_plain_topic, name_for, param_name_for};
pub use notice::{Notice, NoticeSink};
pub use ordered_map::{Iter, OrderedMap};
pub use registry::{Node, Registrations, Registry, port_of};
pub use request::{Entry, Malformed, Request};
pub use returnable::is_readable;
pub use snapshot::{ServiceEntry, Snapshot, SnapshotNode};
pub use state::{Counts, InvalidSnapshot, Master};
pub use tell::{
    Displaced, MASTER, PARAM_UPDATE, PUBLISHER_UPDATE, get_pid, param_update, publisher_update,
    question, shutdown,
};
pub use write::{Effect, Write, WriteTarget};
