//! The whole program, with real rosmasters and real rospy and roscpp nodes. `tests/timing` has the tests that
//! measure times.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

#[path = "../support/mod.rs"]
mod support;

/// The four cases of the ROS Rescue paper.
mod paper {
    mod case_2_not_yet_told;
    mod case_3_both_are_killed;
    mod cases_0_and_1;
}

/// While there is no master, nodes start, find each other, exchange messages, are displaced and end as with a master.
/// The next master gets the result.
mod outage {
    mod calls;
    mod durability;
    mod first_start;
    mod leaving;
    mod long;
    mod many_clients;
    mod nodes;
    mod notifications;
    mod same_name;
}

/// Notifications about a topic, a parameter or a name come in the order of the state's changes.
mod order {
    mod answers;
    mod links;
    mod values;
}

/// Masters that hang, are far away, crash in a loop, answer garbage, or differ from the mirror.
mod master {
    mod bypass;
    mod crash_loop;
    mod divergence;
    mod far;
    mod garbage;
    mod http_1_0;
    mod hung;
    mod late;
    mod old;
    mod python_2;
    mod returns;
    mod stranger;
    mod unreturnable_values;
    mod vendors_roscore;
    mod worded;
}

/// A new master gets the state, and the health check examines the nodes.
mod recovery {
    mod addresses;
    mod dhcp;
    mod elsewhere;
    mod health_check;
    mod host_names;
    mod injection;
    mod liveness;
    mod no_shutdown;
    mod reap;
    mod reconciliation;
    mod taken_port;
    mod two_robots;
    mod unreachable;
}

/// Nodes that run for a long time, and the tools of ROS.
mod nodes {
    mod example;
    mod streams;
    mod tools;
}

/// HTTP and XML-RPC in all forms that clients send.
mod clients {
    mod connections;
    mod forwarding;
    mod hostile;
    mod ipv6;
    mod networks;
    mod reads;
}

/// Limits of memory, connections, file descriptors and write queues.
mod limits {
    mod answers;
    mod connections;
    mod memory;
    mod visits;
    mod writes;
}

/// Options, start and stop.
mod cli {
    mod addresses;
    mod as_roscore;
    mod config_file;
    mod logging;
    mod options;
    mod secrets;
    mod start;
    mod stop;
}

/// The page in a browser, and the data that it shows.
mod page {
    mod answers;
    mod browser;
    mod computers;
    mod graph;
    mod past;
}

/// The commands other than `core` and `proxy`.
mod commands {
    mod check;
    mod checkpoints;
    mod drill;
    mod handover;
    mod history;
    mod live_links;
    mod log;
    mod params;
    mod restore;
    mod status;
    mod top;
    mod wait;
}

/// The checkpoint of the whole program.
mod checkpoint {
    mod at_the_start;
    mod by_port;
    mod full_disk;
    mod hung_disk;
    mod moved;
    mod planted;
    mod readable;
    mod unreadable;
}

/// rosrescue itself dies and is started again.
mod restart {
    mod guardian;
    mod older_checkpoint;
    mod sessions;
    mod story;
    mod systemd;
    mod worker;
}

/// Installation as a service of a real systemd, as a package and in a catkin workspace. A new checkout first makes a Debian
/// for that, so these tests begin early: tests begin in the order of their names.
mod installation {
    mod booted;
    mod catkin;
    mod containers;
    mod install;
    mod package;
}

/// What the tests themselves rely on.
mod tests;

/// Random deaths, on a disk that fails at random.
mod soak;

/// The wall clock jumps.
mod clock;

/// The commands in the documents.
mod documents;

/// The instructions in the document about several computers.
mod computers;
