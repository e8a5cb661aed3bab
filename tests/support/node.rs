//! Real nodes of both client libraries, and the lines that they print (`tests/nodes/lines.py`).

use std::ops::{Deref, DerefMut};
use std::path::Path;
use std::process::Command;

use super::patience::eventually;
use super::process::Process;
use super::ros::{NODES, cpp_nodes, ros_command};
use super::scratch::Scratch;

/// A ROS client library.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Library {
    Rospy,
    Roscpp,
}

impl Library {
    /// A command that runs `node` of this library with the master at `port`. Debian's rospy works only with
    /// the system's Python, whatever the PATH says.
    pub(crate) fn command(self, scratch: &Scratch, port: u16, node: &str) -> Command {
        match self {
            Self::Rospy => {
                let mut command = ros_command(scratch, "/usr/bin/python3", port);
                command.arg(Path::new(NODES).join(format!("{node}.py")));
                command
            }
            Self::Roscpp => ros_command(scratch, cpp_nodes().join(node), port),
        }
    }
}

/// A running node.
#[derive(Debug)]
pub(crate) struct Node {
    process: Process,
}

impl Node {
    /// Starts `node` with `arguments` (including remappings) without waiting for it.
    #[track_caller]
    pub(crate) fn spawn(
        scratch: &Scratch,
        library: Library,
        port: u16,
        node: &str,
        arguments: &[&str],
    ) -> Self {
        let mut command = library.command(scratch, port, node);
        command.args(arguments);
        let name = format!("{library:?} {node} {arguments:?}");
        Self {
            process: Process::start(name, &mut command),
        }
    }

    /// Starts `node` and waits until it is ready.
    #[track_caller]
    pub(crate) fn start(
        scratch: &Scratch,
        library: Library,
        port: u16,
        node: &str,
        arguments: &[&str],
    ) -> Self {
        let mut node = Self::spawn(scratch, library, port, node, arguments);
        node.wait_ready();
        node
    }

    /// Runs a node by `command` and waits until it is ready.
    #[track_caller]
    pub(crate) fn run(command: &mut Command) -> Self {
        let process = Process::start(format!("{command:?}"), command);
        let mut node = Self { process };
        node.wait_ready();
        node
    }

    /// Waits until all of `nodes` are ready. This takes less time than to start one after the other.
    #[track_caller]
    pub(crate) fn all_ready<const COUNT: usize>(mut nodes: [Self; COUNT]) -> [Self; COUNT] {
        for node in &mut nodes {
            node.wait_ready();
        }
        nodes
    }

    #[track_caller]
    fn wait_ready(&mut self) {
        self.wait_line("`ready`", |line| line.starts_with("ready "));
        self.hold_ports();
    }

    /// The rest of each line that starts with `word`.
    pub(crate) fn said(&self, word: &str) -> Vec<String> {
        let start = format!("{word} ");
        let lines = self.process.stdout();
        lines
            .iter()
            .filter_map(|line| line.strip_prefix(&start))
            .map(str::to_owned)
            .collect()
    }

    /// The numbers of the messages that a listener received from `publisher`, in order.
    pub(crate) fn messages(&self, publisher: &str) -> Vec<u64> {
        let start = format!("{publisher} ");
        let got = self.said("got");
        got.iter()
            .filter_map(|line| line.strip_prefix(&start)?.parse().ok())
            .collect()
    }

    /// The number of live links, each time it changed.
    pub(crate) fn links(&self) -> Vec<usize> {
        self.said("links")
            .iter()
            .filter_map(|count| count.parse().ok())
            .collect()
    }

    /// The list of publishers in each publisherUpdate for `topic`, in order.
    pub(crate) fn updates(&self, topic: &str) -> Vec<Vec<String>> {
        let updates = self.said("update");
        updates
            .iter()
            .map(|line| line.split(' ').map(str::to_owned).collect::<Vec<_>>())
            .filter(|words| words[0] == topic)
            .map(|words| words[1..].to_vec())
            .collect()
    }

    /// Waits until `more` further messages of `publisher` have been received.
    #[track_caller]
    pub(crate) fn wait_messages(&self, publisher: &str, more: usize) {
        let before = self.messages(publisher).len();
        eventually(
            &format!("{more} more messages of {publisher} (after {before})"),
            || self.messages(publisher).len() >= before + more,
        );
    }

    /// Waits until each of `listeners` has received `more` further messages of each of `publishers`.
    #[track_caller]
    pub(crate) fn all_wait_messages(listeners: &[Self], publishers: &[String], more: usize) {
        let counts = || {
            let of = |listener: &Self| -> Vec<_> {
                let counts = publishers.iter().map(|name| listener.messages(name).len());
                counts.collect()
            };
            listeners.iter().flat_map(of).collect::<Vec<_>>()
        };
        let before = counts();
        let what = format!("{more} more messages of each of {publishers:?} (after {before:?})");
        eventually(&what, || {
            let pairs = counts().into_iter().zip(&before);
            pairs.into_iter().all(|(now, before)| now >= before + more)
        });
    }

    /// Panics unless all messages of `publisher` were received once and in order.
    #[track_caller]
    pub(crate) fn assert_no_message_lost(&self, publisher: &str) {
        let messages = self.messages(publisher);
        assert!(
            !messages.is_empty(),
            "no message of {publisher} was received"
        );
        for pair in messages.windows(2) {
            assert!(
                pair[1] == pair[0] + 1,
                "after message {} of {publisher}, message {} was received",
                pair[0],
                pair[1]
            );
        }
    }

    /// Panics unless a listener that prints only some messages has seen no gap between those of `publisher`.
    /// Returns how many were received at least.
    #[track_caller]
    pub(crate) fn assert_no_gap(&self, publisher: &str) -> u64 {
        let messages = self.messages(publisher);
        let [first, .., last] = messages.as_slice() else {
            panic!("too few messages of {publisher} were received: {messages:?}");
        };
        let gaps = self.said("gap");
        assert!(gaps.is_empty(), "{gaps:?}\n{}", self.process.log());
        last - first + 1
    }

    /// Panics if the number of links ever decreased.
    #[track_caller]
    pub(crate) fn assert_no_link_lost(&self) {
        let links = self.links();
        assert!(
            links.is_sorted(),
            "a link was lost: {links:?}\n{}",
            self.process.log()
        );
    }
}

impl Deref for Node {
    type Target = Process;

    fn deref(&self) -> &Process {
        &self.process
    }
}

impl DerefMut for Node {
    fn deref_mut(&mut self) -> &mut Process {
        &mut self.process
    }
}
