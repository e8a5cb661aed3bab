//! Nodes that do nothing but answer.

use super::support::{Client, FakeNode};

/// The topics of node `number` of `count`: two that it publishes, and two of its neighbour.
pub(crate) fn topics(number: usize, count: usize) -> [[String; 2]; 2] {
    let of = |number: usize| [1, 2].map(|topic| format!("/node_{number:03}/topic_{topic}"));
    [of(number), of((number + 1) % count)]
}

/// Starts `count` nodes, with seven registrations each, that answer the questions of the health check.
pub(crate) fn synthetic(client: &Client, count: usize) -> Vec<FakeNode> {
    let start = |number| {
        let name = format!("/node_{number:03}");
        let node = FakeNode::start(&name);
        let [published, subscribed] = topics(number, count);
        node.publish(client, "/rosout", "rosgraph_msgs/Log");
        for service in ["get_loggers", "set_logger_level"] {
            node.offer(client, &format!("{name}/{service}"));
        }
        for topic in published {
            node.publish(client, &topic, "std_msgs/String");
        }
        for topic in subscribed {
            node.subscribe(client, &topic, "std_msgs/String");
        }
        node
    };
    (0..count).map(start).collect()
}
