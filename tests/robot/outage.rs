//! A robot without a master: nodes start, find each other, talk, are displaced and end as if there were one, and
//! are notified of what they must know; the next master is given what came of it.

mod calls;
mod durability;
mod long;
mod many_clients;
mod nodes;
mod same_name;
mod tools;

use crate::support::Library;

const LIBRARIES: [(Library, &str); 2] = [(Library::Rospy, "py"), (Library::Roscpp, "cpp")];
