//! Live streams of messages: talkers of one topic and listeners to it, of both libraries.

use rosrescue::xmlrpc::Value;

use super::node::{Library, Node};
use super::params;
use super::robot::Robot;
use super::rpc::Client;

/// The client libraries, each with the end of its nodes' names.
pub(crate) const LIBRARIES: [(Library, &str); 2] =
    [(Library::Rospy, "py"), (Library::Roscpp, "cpp")];

/// The port of a registered node.
#[track_caller]
pub(crate) fn port_of(client: &Client, node: &str) -> u16 {
    let api = client.ok("lookupNode", params!["/test", node]);
    let port = api.as_str().unwrap().trim_end_matches('/').rsplit(':');
    port.map(|port| port.parse().unwrap()).next().unwrap()
}

/// Two talkers on one topic and two listeners, one of each library.
#[derive(Debug)]
pub(crate) struct Streams {
    talkers: [Node; 2],
    listeners: [Node; 2],
    topic: String,
    /// What the nodes say of their links when all are there.
    links: Vec<Value>,
}

impl Streams {
    /// Starts all four, whose names end in that of the topic. The talkers talk at `hz`; the listeners say each
    /// `every`th message, and every gap.
    #[track_caller]
    pub(crate) fn start(robot: &Robot, topic: &str, hz: &str, every: &str) -> Self {
        let remap = format!("chatter:=/{topic}");
        let start = |node: &str, arguments: &[&str]| {
            LIBRARIES.map(|(library, suffix)| {
                let name = format!("__name:={node}_{suffix}_{topic}");
                robot.node(library, node, &[arguments, &[&name, &remap]].concat())
            })
        };
        let mut streams = Self {
            talkers: start("talker", &[hz, "quiet"]),
            listeners: start("listener", &[every]),
            topic: topic.to_owned(),
            links: Vec::new(),
        };
        streams.flow();
        streams.links = streams.links(robot);
        for links in &streams.links {
            assert_eq!(links.as_array().unwrap().len(), 2, "{links:?}");
        }
        streams
    }

    fn names(&self, node: &str) -> [String; 2] {
        LIBRARIES.map(|(_, suffix)| format!("/{node}_{suffix}_{}", self.topic))
    }

    /// Waits until messages have come from everybody to everybody.
    #[track_caller]
    fn flow(&self) {
        for listener in &self.listeners {
            for talker in self.names("talker") {
                listener.wait_messages(&talker, 2);
            }
        }
    }

    /// What each node says of its links of the topic: they have numbers, and ports.
    fn links(&self, robot: &Robot) -> Vec<Value> {
        let topic = Value::String(format!("/{}", self.topic));
        let of = |name: &String| {
            let node = Client::new(port_of(&robot.client(), name));
            let links = node.ok("getBusInfo", params!["/test"]);
            let links = links.as_array().unwrap().iter();
            let of_topic = |link: &&Value| link.as_array().unwrap()[4] == topic;
            Value::Array(links.filter(of_topic).cloned().collect())
        };
        let names = ["talker", "listener"].map(|node| self.names(node));
        names.iter().flatten().map(of).collect()
    }

    /// Panics if a message was lost or a link was made anew, or nothing comes any more.
    #[track_caller]
    pub(crate) fn assert_whole(&self, robot: &Robot) {
        self.flow();
        for listener in &self.listeners {
            for talker in self.names("talker") {
                let count = listener.assert_no_gap(&talker);
                println!("{count} messages of {talker}");
            }
        }
        for node in self.listeners.iter().chain(&self.talkers) {
            node.assert_no_link_lost();
            assert_eq!(node.links().last(), Some(&2), "{:?}", node.links());
        }
        assert_eq!(self.links, self.links(robot));
    }
}
