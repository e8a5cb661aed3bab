//! Watches topics as a subscriber.

use std::{
    cmp::Reverse,
    collections::BTreeSet,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use ros1_master::xmlrpc::Value;
use serde::Serialize;
use tokio::{task::JoinHandle, time::timeout};

use super::{calls::Api, node::DrillNode, tcpros::Link};

/// Longest time for a publisher to accept a subscriber.
const CONNECT_LIMIT: Duration = Duration::from_secs(5);
/// Minimum number of messages before the first kill to tell a topic's normal pauses.
const FEWEST: u64 = 10;
/// Shorter pauses never count as failures: any computer may be busy for that long.
const SHORTEST_GAP: Duration = Duration::from_secs(1);
/// A pause counts as a failure if it is more than this many times as long as the longest normal one.
const LONGER: u32 = 10;
/// Maximum number of topics that are tried when none is named.
const CANDIDATES: usize = 24;

/// What arrived over one connection.
#[derive(Debug, Default)]
struct Seen {
    messages: u64,
    /// Whether sequence numbers reveal lost messages. They do not for a throttled topic, which always skips some.
    is_numbered: bool,
    number: Option<u32>,
    lost: u64,
    last: Option<Instant>,
    longest: Duration,
    /// The longest pause before the first kill. `None` if too few messages came.
    normal: Option<Duration>,
    ended: Option<String>,
}

impl Seen {
    fn message(&mut self, now: Instant, number: Option<u32>) {
        self.pause(now);
        self.messages += 1;
        self.last = Some(now);
        self.is_numbered |= number.is_some() && self.number.is_none();
        if let (Some(before), Some(number)) = (self.number, number) {
            // A publisher that restarts starts its numbers again. The lost connection is reported separately.
            let missing = number.wrapping_sub(before).wrapping_sub(1);
            self.lost += u64::from(missing).min(1 << 20) * u64::from(missing < 1 << 31);
        }
        self.number = number.or(self.number);
    }

    fn pause(&mut self, now: Instant) {
        if let Some(last) = self.last {
            self.longest = self.longest.max(now.saturating_duration_since(last));
        }
    }

    /// Keeps the longest pause so far as the normal one. From now on pauses are compared with it.
    fn begin(&mut self) {
        self.normal = (self.messages >= FEWEST).then_some(self.longest);
        self.longest = Duration::ZERO;
        self.is_numbered &= self.lost == 0;
    }

    fn failures(&self, publisher: &str) -> Vec<String> {
        let mut failures = Vec::new();
        if let Some(why) = &self.ended {
            failures.push(format!("the link to {publisher} was lost ({why})"));
        } else if let Some(normal) = self.normal
            && self.longest > SHORTEST_GAP.max(normal * LONGER)
        {
            failures.push(format!(
                "no message of {publisher} came for {} ms; before the kill the longest pause was {} ms",
                self.longest.as_millis(),
                normal.as_millis()
            ));
        }
        if self.is_numbered && self.lost > 0 {
            failures.push(format!("{} messages of {publisher} were lost", self.lost));
        }
        failures
    }
}

fn lock(seen: &Mutex<Seen>) -> MutexGuard<'_, Seen> {
    seen.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A connection that is read until it is dropped.
#[derive(Debug)]
struct Watched {
    publisher: String,
    seen: Arc<Mutex<Seen>>,
    task: JoinHandle<()>,
}

impl Drop for Watched {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// A subscription, with a connection to each publisher.
#[derive(Debug)]
pub(super) struct Topic {
    pub(super) name: String,
    usefulness: Usefulness,
    links: Vec<Watched>,
}

/// The results for one topic.
#[derive(Clone, Debug, Serialize)]
pub(super) struct TopicReport {
    pub(super) topic: String,
    pub(super) publishers: usize,
    pub(super) messages: u64,
    /// Number of lost messages. `None` if the messages have no sequence number.
    pub(super) lost: Option<u64>,
    pub(super) longest_gap_ms: f64,
    /// The longest pause before the first kill. `None` if too few messages came.
    pub(super) normal_gap_ms: Option<f64>,
    pub(super) failures: Vec<String>,
    /// Each failure, with the address of the publisher that it concerns.
    #[serde(skip)]
    found: Vec<(String, String)>,
}

impl TopicReport {
    /// Counts the failures, except those of publishers in `ended`, which ended by themselves.
    pub(super) fn count_failures(&mut self, ended: &BTreeSet<String>) {
        let found = self.found.iter();
        let failures = found.filter(|(publisher, _)| !ended.contains(publisher));
        self.failures = failures.map(|(_, failure)| failure.clone()).collect();
    }
}

impl Topic {
    /// Subscribes to `topic` as a node does, and connects to all of its publishers.
    pub(super) async fn subscribe(
        api: &Api,
        node: &DrillNode,
        topic: &str,
        usefulness: Usefulness,
    ) -> Result<Self, String> {
        let register = [topic.into(), "*".into(), node.api.as_str().into()];
        let publishers = api.call("registerSubscriber", &register).await?;
        node.log.subscribes(topic, true);
        let publishers = publishers.as_array().unwrap_or_default();
        let mut links = Vec::new();
        for publisher in publishers.iter().filter_map(Value::as_str) {
            let link = timeout(CONNECT_LIMIT, connect(api, publisher, topic)).await;
            let link = link.map_err(|_| "no answer".to_owned()).flatten();
            let seen = Arc::<Mutex<Seen>>::default();
            let task = match link {
                Ok(link) => crate::task::spawn(read(link, seen.clone())),
                Err(why) => {
                    return Err(format!("{topic}: cannot connect to {publisher}: {why}"));
                }
            };
            links.push(Watched {
                publisher: publisher.to_owned(),
                seen,
                task,
            });
        }
        Ok(Self {
            name: topic.to_owned(),
            usefulness,
            links,
        })
    }

    pub(super) async fn unsubscribe(&self, api: &Api, node: &DrillNode) -> Result<(), String> {
        unregister(api, node, &self.name).await
    }

    pub(super) fn has_publishers(&self) -> bool {
        !self.links.is_empty()
    }

    fn messages(&self) -> u64 {
        self.links
            .iter()
            .map(|link| lock(&link.seen).messages)
            .sum()
    }

    /// Notes that the kills begin: pauses from now on are compared with those before.
    pub(super) fn begin(&self) {
        for link in &self.links {
            lock(&link.seen).begin();
        }
    }

    /// The results until `now`. `updates` are the `publisherUpdate`s that the node got.
    pub(super) fn report(&self, now: Instant, updates: &[(String, Vec<String>)]) -> TopicReport {
        let mut report = TopicReport {
            topic: self.name.clone(),
            publishers: self.links.len(),
            messages: self.messages(),
            lost: None,
            longest_gap_ms: 0.0,
            normal_gap_ms: None,
            failures: Vec::new(),
            found: Vec::new(),
        };
        let ms = |time: Duration| time.as_secs_f64() * 1e3;
        for link in &self.links {
            let mut seen = lock(&link.seen);
            seen.pause(now);
            report.longest_gap_ms = report.longest_gap_ms.max(ms(seen.longest));
            let normal = report.normal_gap_ms.into_iter().chain(seen.normal.map(ms));
            report.normal_gap_ms = normal.reduce(f64::max);
            if seen.is_numbered {
                report.lost = Some(report.lost.unwrap_or_default() + seen.lost);
            }
            let publisher = &link.publisher;
            let mut failures = seen.failures(publisher);
            let left_out = updates
                .iter()
                .any(|(topic, list)| *topic == self.name && !list.contains(publisher));
            if left_out {
                failures.push(format!(
                    "subscribers were told that {publisher} no longer publishes"
                ));
            }
            let failures = failures.into_iter();
            report
                .found
                .extend(failures.map(|failure| (publisher.clone(), failure)));
        }
        report
    }
}

/// Unregisters the subscriber of `topic`.
pub(super) async fn unregister(api: &Api, node: &DrillNode, topic: &str) -> Result<(), String> {
    node.log.subscribes(topic, false);
    let params = [topic.into(), node.api.as_str().into()];
    api.call("unregisterSubscriber", &params).await.map(drop)
}

async fn connect(api: &Api, publisher: &str, topic: &str) -> Result<Link, String> {
    let node = Api {
        uri: publisher.to_owned(),
        caller: api.caller.clone(),
    };
    let protocols = Value::Array(vec![vec!["TCPROS"].into()]);
    let answer = node
        .call("requestTopic", &[topic.into(), protocols])
        .await?;
    let Some([_, Value::String(host), Value::Int(port)]) = answer.as_array() else {
        return Err("it does not offer TCPROS".to_owned());
    };
    let port = u16::try_from(*port).map_err(|error| error.to_string())?;
    Link::connect((host, port), &api.caller, topic).await
}

async fn read(mut link: Link, seen: Arc<Mutex<Seen>>) {
    loop {
        match link.next_message().await {
            Ok(number) => lock(&seen).message(Instant::now(), number),
            Err(error) => {
                lock(&seen).ended = Some(error.to_string());
                return;
            }
        }
    }
}

/// Published topics that are cheap to watch, the most useful ones first.
pub(super) async fn candidates(api: &Api) -> Result<Vec<(String, Usefulness)>, String> {
    let published = api.call("getPublishedTopics", &["".into()]).await?;
    let pairs = published.as_array().unwrap_or_default().iter();
    let pairs = pairs.filter_map(|pair| match pair.as_array() {
        Some([Value::String(topic), Value::String(of)]) => Some((topic.clone(), of.clone())),
        _ => None,
    });
    Ok(choose(pairs.collect()))
}

/// Chooses topics to try from all published ones, given with their message types.
fn choose(published: Vec<(String, String)>) -> Vec<(String, Usefulness)> {
    let cheap = published
        .into_iter()
        .filter(|(topic, of)| !topic.starts_with("/rosout") && !is_heavy(of));
    let mut topics: Vec<_> = cheap
        .map(|(topic, of)| (topic, Usefulness::for_type(&of)))
        .collect();
    topics.sort_by(|(a, a_is), (b, b_is)| (a_is, a).cmp(&(b_is, b)));
    topics.truncate(CANDIDATES);
    topics
}

/// How much a robot depends on a topic of a message type, the most useful first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Usefulness {
    /// Robots stop without these messages.
    Drives,
    Other,
    /// States of programs, which change little.
    Housekeeping,
}

impl Usefulness {
    /// Judges a message type, such as `nav_msgs/Odometry`.
    pub(super) fn for_type(message_type: &str) -> Self {
        const DRIVES: [&str; 8] = [
            "nav_msgs/Odometry",
            "sensor_msgs/LaserScan",
            "sensor_msgs/Imu",
            "sensor_msgs/JointState",
            "sensor_msgs/Range",
            "tf/tfMessage",
            "tf2_msgs/TFMessage",
            "geometry_msgs/Twist",
        ];
        const HOUSEKEEPING: [&str; 7] = [
            "bond/",
            "diagnostic_msgs/",
            "dynamic_reconfigure/",
            "rosgraph_msgs/",
            "sensor_msgs/CameraInfo",
            "actionlib_msgs/",
            "visualization_msgs/",
        ];
        if DRIVES.iter().any(|of| message_type.starts_with(of)) {
            Self::Drives
        } else if HOUSEKEEPING.iter().any(|of| message_type.starts_with(of)) {
            Self::Housekeeping
        } else {
            Self::Other
        }
    }
}

/// Whether messages of this type are usually so large that another subscriber would load the robot.
fn is_heavy(message_type: &str) -> bool {
    [
        "Image",
        "PointCloud",
        "Disparity",
        "OccupancyGrid",
        "Octomap",
    ]
    .iter()
    .any(|word| message_type.contains(word))
}

/// Sorts the topics to watch first: the most useful ones, and among those the ones with most messages. Removes topics
/// without messages.
pub(super) fn sort(topics: &mut Vec<Topic>) {
    topics.retain(|topic| topic.messages() > 0);
    topics.sort_by_key(|topic| (topic.usefulness, Reverse(topic.messages())));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stream_is_judged_by_its_links_its_numbers_and_its_own_rhythm() {
        let start = Instant::now();
        let at = |ms| start + Duration::from_millis(ms);
        let stream = |until: u64| {
            let mut seen = Seen::default();
            for number in 0..20 {
                seen.message(at(number * 50), Some(u32::try_from(number).unwrap()));
            }
            seen.begin();
            for number in 20..until {
                seen.message(at(number * 50), Some(u32::try_from(number).unwrap()));
            }
            seen
        };
        let mut whole = stream(60);
        whole.pause(at(3_100));
        assert_eq!(whole.failures("/p"), Vec::<String>::new());
        assert_eq!(whole.normal, Some(Duration::from_millis(50)));
        let mut stopped = stream(60);
        stopped.pause(at(5_000));
        assert_eq!(stopped.failures("/p").len(), 1);
        let mut lost = stream(60);
        lost.message(at(3_000), Some(63));
        assert_eq!(lost.lost, 3);
        assert_eq!(lost.failures("/p"), ["3 messages of /p were lost"]);
        let mut cut = stream(60);
        cut.ended = Some("early eof".to_owned());
        assert!(cut.failures("/p")[0].contains("was lost (early eof)"));
        let mut throttled = Seen::default();
        for number in 0..20 {
            throttled.message(at(u64::from(number) * 50), Some(number * 3));
        }
        throttled.begin();
        throttled.message(at(1_000), Some(60));
        assert_eq!(throttled.failures("/p"), Vec::<String>::new());
        let mut rare = Seen::default();
        rare.message(at(0), None);
        rare.begin();
        rare.pause(at(60_000));
        assert_eq!(rare.failures("/p"), Vec::<String>::new());
        assert!(!rare.is_numbered);
    }

    #[test]
    fn the_topics_that_robots_drive_by_are_tried_first() {
        let mut published: Vec<_> = (0..40)
            .map(|number| {
                (
                    format!("/arm/part_{number:02}"),
                    "std_msgs/Float64".to_owned(),
                )
            })
            .collect();
        for (topic, of) in [
            ("/bond", "bond/Status"),
            ("/camera/camera_info", "sensor_msgs/CameraInfo"),
            ("/camera/image_raw", "sensor_msgs/Image"),
            ("/odom", "nav_msgs/Odometry"),
            ("/rosout", "rosgraph_msgs/Log"),
            ("/scan", "sensor_msgs/LaserScan"),
            ("/tf", "tf2_msgs/TFMessage"),
        ] {
            published.push((topic.to_owned(), of.to_owned()));
        }
        let chosen = choose(published);
        let names: Vec<_> = chosen.iter().map(|(topic, _)| &**topic).collect();
        assert_eq!(&names[..4], ["/odom", "/scan", "/tf", "/arm/part_00"]);
        assert_eq!(names.len(), CANDIDATES);
        let few = choose(vec![
            ("/a".to_owned(), "bond/Status".to_owned()),
            ("/b".to_owned(), "std_msgs/String".to_owned()),
        ]);
        assert_eq!(few[0].0, "/b");
    }
}
