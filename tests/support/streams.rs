//! Live streams of messages: talkers and listeners on one topic, from both client libraries.

use ros1_master::xmlrpc::Value;

use super::node::{Library, Node};
use super::params;
use super::robot::Robot;
use super::rpc::Client;

/// The client libraries, each with the suffix of its nodes' names.
pub(crate) const LIBRARIES: [(Library, &str); 2] =
    [(Library::Rospy, "py"), (Library::Roscpp, "cpp")];

/// The port of a registered node.
#[track_caller]
pub(crate) fn port_of(client: &Client, node: &str) -> u16 {
    let api = client.ok("lookupNode", params!["/test", node]);
    let port = api.as_str().unwrap().trim_end_matches('/').rsplit(':');
    port.map(|port| port.parse().unwrap()).next().unwrap()
}

/// Two talkers and two listeners on one topic, one from each client library.
#[derive(Debug)]
pub(crate) struct Streams {
    talkers: [Node; 2],
    listeners: [Node; 2],
    topic: String,
    /// The links that the nodes report when all are connected.
    links: Vec<Value>,
}

impl Streams {
    /// Starts all four nodes, whose names end in the name of the topic. Talkers publish at `hz`; listeners
    /// print each `every`th message and every gap.
    #[track_caller]
    pub(crate) fn start(robot: &Robot, topic: &str, hz: &str, every: &str) -> Self {
        let remap = format!("chatter:=/{topic}");
        // Talkers and listeners do not start together: rospy may then make a link twice.
        let start = |node: &str, arguments: &[&str]| {
            Node::all_ready(LIBRARIES.map(|(library, suffix)| {
                let name = format!("__name:={node}_{suffix}_{topic}");
                robot.spawn_node(library, node, &[arguments, &[&name, &remap]].concat())
            }))
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

    /// Waits until every listener has received messages from every talker.
    #[track_caller]
    fn flow(&self) {
        Node::all_wait_messages(&self.listeners, &self.names("talker"), 2);
    }

    /// The links that each node reports for the topic, including their numbers and ports.
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

    /// Panics if a message was lost, a link was replaced, or no more messages arrive.
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
