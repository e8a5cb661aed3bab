//! The computation graph as a picture, as rqt_graph shows it: nodes are ellipses, topics boxes.

mod layout;
mod svg;

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use bytes::Bytes;
use tokio::sync::Mutex;

use self::layout::Size;
use super::robot::Robot;
use crate::health::Health;

/// Most boxes and lines of a picture. 400 boxes with 1,600 lines take 0.03 s, and nobody can read more.
const BOXES: usize = 400;
const LINES: usize = 1600;
/// Pictures that are kept.
const DRAWN: usize = 4;

/// What is to be drawn.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Selection {
    /// Boxes in whose names this occurs, whatever its case, and their neighbours.
    pub(super) filter: String,
    /// Also what every node has, and tools.
    pub(super) debug: bool,
    /// Also topics that are only published or only subscribed.
    pub(super) leaves: bool,
    /// For a screen that is higher than wide.
    pub(super) tall: bool,
}

/// A node or a topic.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Shape {
    Node { name: String, health: Health },
    Topic { name: String },
}

impl Shape {
    fn name(&self) -> &str {
        match self {
            Self::Node { name, .. } | Self::Topic { name } => name,
        }
    }
}

/// A line from one box to another one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Link {
    from: usize,
    to: usize,
    /// And back: a node that publishes a topic which it subscribes.
    both: bool,
}

/// Boxes and lines.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Graph {
    shapes: Vec<Shape>,
    links: Vec<Link>,
    tall: bool,
}

/// What tells little about a robot; rqt_graph leaves out the same.
fn is_debug(name: &str) -> bool {
    let exact = ["/rosout", "/rosout_agg", "/statistics", "/clock"];
    let begins = [
        "/rqt_",
        "/rviz",
        "/rosapi",
        "/rosbridge",
        "/record_",
        "/rostopic_",
    ];
    exact.contains(&name) || begins.iter().any(|begin| name.starts_with(begin))
}

impl Graph {
    pub(super) fn new(robot: &Robot, selection: &Selection) -> Self {
        let shown = |name: &&String| selection.debug || !is_debug(name);
        let mut links: BTreeMap<(&str, &str), [bool; 2]> = BTreeMap::new();
        for topic in robot.topics.iter().filter(|topic| shown(&&topic.name)) {
            let is_leaf = topic.publishers.is_empty() || topic.subscribers.is_empty();
            if is_leaf && !selection.leaves {
                continue;
            }
            for (way, nodes) in [&topic.publishers, &topic.subscribers]
                .into_iter()
                .enumerate()
            {
                for node in nodes.iter().filter(shown) {
                    let ways = links.entry((&topic.name, node)).or_default();
                    if let Some(way) = ways.get_mut(way) {
                        *way = true;
                    }
                }
            }
        }
        let filter = selection.filter.to_lowercase();
        let matches = |name: &str| name.to_lowercase().contains(&filter);
        links.retain(|(topic, node), _| matches(topic) || matches(node));
        let linked_nodes: BTreeSet<&str> = links.keys().map(|(_, node)| *node).collect();
        let topics: BTreeSet<&str> = links.keys().map(|(topic, _)| *topic).collect();
        let nodes = robot.nodes.iter().filter(|node| {
            linked_nodes.contains(node.name.as_str()) || shown(&&node.name) && matches(&node.name)
        });
        let nodes = nodes.map(|node| Shape::Node {
            name: node.name.clone(),
            health: node.health,
        });
        let topics = topics.into_iter().map(|name| Shape::Topic {
            name: name.to_owned(),
        });
        let shapes: Vec<Shape> = nodes.chain(topics).collect();
        let mut places = [BTreeMap::new(), BTreeMap::new()];
        for (index, shape) in shapes.iter().enumerate() {
            let [nodes, topics] = &mut places;
            match shape {
                Shape::Node { name, .. } => nodes.insert(name.as_str(), index),
                Shape::Topic { name } => topics.insert(name.as_str(), index),
            };
        }
        let [nodes, topics] = &places;
        let links = links.into_iter().filter_map(|((topic, node), ways)| {
            let (topic, node) = (*topics.get(topic)?, *nodes.get(node)?);
            let [published, subscribed] = ways;
            let (from, to) = if published {
                (node, topic)
            } else {
                (topic, node)
            };
            Some(Link {
                from,
                to,
                both: published && subscribed,
            })
        });
        let links = links.collect();
        Self {
            shapes,
            links,
            tall: selection.tall,
        }
    }

    /// Where it is to be shown.
    fn frame(&self) -> Size {
        let (width, height) = if self.tall {
            (400.0, 600.0)
        } else {
            (1240.0, 600.0)
        };
        Size { width, height }
    }

    /// The picture, or why there is none.
    fn draw(&self) -> String {
        match (self.shapes.len(), self.links.len()) {
            (0, _) => svg::message("nothing to show"),
            (boxes, lines) if boxes > BOXES || lines > LINES => svg::message(&format!(
                "{boxes} boxes and {lines} lines are more than one can read: filter by a part of a name"
            )),
            _ => svg::draw(self),
        }
    }
}

/// The pictures that were drawn last. One is drawn at a time.
#[derive(Debug, Default)]
pub(crate) struct Drawn(Mutex<VecDeque<(Graph, Bytes)>>);

impl Drawn {
    /// The picture of `graph`, which is drawn where it holds up no call.
    pub(super) async fn picture(&self, graph: Graph) -> Bytes {
        let mut drawn = self.0.lock().await;
        if let Some((_, picture)) = drawn.iter().find(|(of, _)| *of == graph) {
            return picture.clone();
        }
        let work = move || {
            let picture = Bytes::from(graph.draw());
            (graph, picture)
        };
        let Ok((graph, picture)) = tokio::task::spawn_blocking(work).await else {
            return svg::message("this graph could not be drawn").into();
        };
        if drawn.len() == DRAWN {
            drawn.pop_front();
        }
        drawn.push_back((graph, picture.clone()));
        picture
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::master::{Master, Method, Request};

    fn robot(registrations: &[(Method, &str, &str)]) -> Robot {
        let mut master = Master::default();
        for (method, node, topic) in registrations {
            let call = Request::new(method.clone(), [*node, *topic, "a/b", "http://robot:1/"]);
            master.apply(&call);
        }
        Robot::of(master.snapshot())
    }

    fn names(robot: &Robot, selection: &Selection) -> Vec<String> {
        let graph = Graph::new(robot, selection);
        let names = graph.shapes.iter().map(|shape| shape.name().to_owned());
        names.collect()
    }

    const PUBLISHES: Method = Method::RegisterPublisher;
    const SUBSCRIBES: Method = Method::RegisterSubscriber;

    #[test]
    fn the_selection_says_what_is_drawn() {
        let robot = robot(&[
            (PUBLISHES, "/camera", "/image"),
            (PUBLISHES, "/camera", "/rosout"),
            (SUBSCRIBES, "/rosout", "/rosout"),
            (SUBSCRIBES, "/viewer", "/image"),
            (PUBLISHES, "/viewer", "/spare"),
            (PUBLISHES, "/lonely", "/rosout"),
        ]);
        let default = Selection::default();
        assert_eq!(
            names(&robot, &default),
            ["/camera", "/lonely", "/viewer", "/image"]
        );
        let leaves = Selection {
            leaves: true,
            ..default.clone()
        };
        assert!(names(&robot, &leaves).contains(&"/spare".to_owned()));
        let debug = Selection {
            debug: true,
            ..default.clone()
        };
        assert_eq!(
            names(&robot, &debug)
                .iter()
                .filter(|name| *name == "/rosout")
                .count(),
            2
        );
        for (filter, expected) in [
            ("IMAGE", &["/camera", "/viewer", "/image"][..]),
            ("camera", &["/camera", "/image"]),
            ("nothing", &[]),
        ] {
            let filter = filter.to_owned();
            assert_eq!(
                names(
                    &robot,
                    &Selection {
                        filter,
                        ..default.clone()
                    }
                ),
                expected
            );
        }
    }

    #[test]
    fn lines_lead_from_publishers_to_subscribers() {
        let robot = robot(&[
            (PUBLISHES, "/a", "/t"),
            (SUBSCRIBES, "/a", "/t"),
            (SUBSCRIBES, "/b", "/t"),
        ]);
        let graph = Graph::new(&robot, &Selection::default());
        let link = |from, to, both| Link { from, to, both };
        assert_eq!(graph.links, [link(0, 2, true), link(2, 1, false)]);
    }

    #[test]
    fn names_are_text_and_nothing_else() {
        let hostile = "/<script>alert(1)</script>\"'&\u{1}\u{ffff}";
        let robot = robot(&[(PUBLISHES, hostile, "/t"), (SUBSCRIBES, "/b", "/t")]);
        let picture = Graph::new(&robot, &Selection::default()).draw();
        assert!(!picture.contains("<script") && !picture.contains('\u{1}'));
        assert!(picture.contains("&lt;script&gt;"), "{picture}");
    }

    #[test]
    fn what_nobody_could_read_is_not_drawn() {
        let names: Vec<String> = (0..=BOXES).map(|index| format!("/n{index}")).collect();
        let registrations = names.iter().map(|name| (PUBLISHES, name.as_str(), "/t"));
        let robot = robot(&registrations.collect::<Vec<_>>());
        let picture = Graph::new(&robot, &Selection::default()).draw();
        assert!(picture.contains("filter by a part of a name"), "{picture}");
        let filter = "/n40".to_owned();
        let picture = Graph::new(
            &robot,
            &Selection {
                filter,
                ..Selection::default()
            },
        )
        .draw();
        assert!(picture.contains(">/n400<"), "{picture}");
    }

    #[tokio::test]
    async fn the_same_picture_is_drawn_once() {
        let drawn = Drawn::default();
        let graph = Graph::new(&robot(&[(PUBLISHES, "/a", "/t")]), &Selection::default());
        let first = drawn.picture(graph.clone()).await;
        assert_eq!(first.as_ptr(), drawn.picture(graph).await.as_ptr());
    }
}
