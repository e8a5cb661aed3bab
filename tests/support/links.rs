//! Starts many real nodes at the same moment, and checks that each subscriber is connected to exactly the
//! publishers in the master's state.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::path::PathBuf;
use std::thread::sleep;
use std::time::{Duration, Instant};

use serde_json::{Value as Json, json};

use super::node::Library;
use super::patience::eventually;
use super::process::Process;
use super::rpc::Client;
use super::scratch::Scratch;
use super::state::State;

mod stage;
mod traces;

pub(crate) use stage::{Place, Stage};
pub(crate) use traces::Traces;

/// Number of subscribers of each topic, on different nodes. Each topic has one publisher.
const SUBSCRIBERS: usize = 3;
const SPACE: &str = "/links/";
/// Pause between two checks of the nodes' connections. Each check takes some milliseconds of every node.
const LOOK: Duration = Duration::from_millis(500);

/// The order in which a node registers its publishers and subscribers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Order {
    /// All nodes register in the order of topics, so that those of one topic register at about the same time.
    Same,
    /// Each node registers in a different random order.
    Shuffled,
}

/// The nodes to start.
#[derive(Clone, Debug)]
pub(crate) struct Plan {
    pub(crate) library: Library,
    pub(crate) nodes: usize,
    pub(crate) links: usize,
    pub(crate) order: Order,
    /// Number of busy processes that run at the same time.
    pub(crate) load: usize,
    /// How long a link may take after the last node was ready, on a computer without other load.
    pub(crate) wait: Duration,
}

impl Default for Plan {
    fn default() -> Self {
        Self {
            library: Library::Rospy,
            nodes: 12,
            links: 720,
            order: Order::Same,
            load: 0,
            wait: Duration::from_secs(6),
        }
    }
}

/// Random numbers that depend on a seed.
#[derive(Debug)]
pub(crate) struct Dice(pub(crate) u64);

impl Dice {
    /// A number below `end` (splitmix64).
    pub(crate) fn below(&mut self, end: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (mixed ^ (mixed >> 31)) % end
    }

    fn shuffle<T>(&mut self, list: &mut [T]) {
        for last in (1..list.len()).rev() {
            let other = usize::try_from(self.below(last as u64 + 1)).unwrap();
            list.swap(last, other);
        }
    }
}

impl Plan {
    /// The publishers and subscribers of each node, as kind and topic.
    fn ends(&self, dice: &mut Dice) -> BTreeMap<String, Vec<(&'static str, String)>> {
        let count = self.nodes;
        assert!(
            count > SUBSCRIBERS,
            "{SUBSCRIBERS} subscribers beside a publisher"
        );
        let mut nodes: Vec<_> = (0..count).map(|_| Vec::new()).collect();
        for topic in 0..self.links / SUBSCRIBERS {
            let name = format!("{SPACE}{topic:04}");
            let publisher = topic % count;
            nodes[publisher].push(("pub", name.clone()));
            let first = 1 + topic / count % (count - SUBSCRIBERS);
            for nth in 0..SUBSCRIBERS {
                nodes[(publisher + first + nth) % count].push(("sub", name.clone()));
            }
        }
        if self.order == Order::Shuffled {
            nodes.iter_mut().for_each(|ends| dice.shuffle(ends));
        }
        let named = nodes.into_iter().enumerate();
        named
            .map(|(number, ends)| (format!("links_{number:02}"), ends))
            .collect()
    }

    /// How long to wait for the links after the last node was ready.
    fn bound(&self) -> Duration {
        self.wait.mul_f64(1.0 + self.load as f64 / 4.0)
    }
}

/// The outcome of one start.
#[derive(Debug)]
pub(crate) struct Start {
    /// The number of links in the master's state.
    pub(crate) links: usize,
    /// The missing links between a subscriber and a publisher, each with the events that led to it.
    pub(crate) never_made: Vec<String>,
    /// Links to nodes that are not publishers, and registrations that the state lacks.
    pub(crate) wrong: Vec<String>,
    /// Answers whose list was older than one that the node had received before, each with the events that led to it.
    pub(crate) overtaken: Vec<String>,
    /// Notifications whose list was older than an earlier one, each with the events that led to it.
    pub(crate) went_back: Vec<String>,
    /// The time until the last node had registered.
    pub(crate) time: Duration,
    /// The output of rosrescue, if links are missing or wrong.
    pub(crate) log: String,
}

impl Start {
    /// Panics unless every link was made. On an overloaded computer a node may read an answer after a notification that
    /// was sent later; the notification is then repeated.
    #[track_caller]
    pub(crate) fn assert_whole(&self, plan: &Plan) {
        println!("answers read too late: {}", self.overtaken.len());
        assert_eq!(self.links, plan.links, "{:#?}", self.wrong);
        for (what, found) in [
            ("never made", &self.never_made),
            ("links that the state lacks", &self.wrong),
            ("updates with an older list", &self.went_back),
        ] {
            assert!(
                found.is_empty(),
                "{what}: {}\n{}\n{}",
                found.len(),
                found.join("\n"),
                self.log
            );
        }
    }
}

/// Nodes that are loaded and wait for the signal to begin.
#[derive(Debug)]
struct Fleet {
    processes: Vec<Process>,
    folder: PathBuf,
    names: Vec<String>,
    library: Library,
}

/// What a node reports when it has registered.
#[derive(Clone, Debug)]
struct Ready {
    name: String,
    api: String,
    begin: f64,
    end: f64,
}

impl Fleet {
    #[track_caller]
    fn load(scratch: &Scratch, port: u16, plan: &Plan, dice: &mut Dice) -> Self {
        let folder = scratch.path("links");
        fs::create_dir_all(&folder).unwrap();
        for name in ["go", "end"] {
            rustix::fs::mknodat(
                rustix::fs::CWD,
                folder.join(name),
                rustix::fs::FileType::Fifo,
                rustix::fs::Mode::from_raw_mode(0o600),
                0,
            )
            .unwrap();
        }
        let ends = plan.ends(dice);
        let names = ends.keys().map(|name| format!("/{name}")).collect();
        let processes: Vec<_> = match plan.library {
            Library::Rospy => {
                fs::write(folder.join("plan.json"), json!(ends).to_string()).unwrap();
                let mut command = plan.library.command(scratch, port, "links");
                vec![Process::start("links.py", command.arg(&folder))]
            }
            Library::Roscpp => {
                let start = |(name, ends): (&String, &Vec<(&str, String)>)| {
                    let mut command = plan.library.command(scratch, port, "links");
                    command.arg(folder.join("go")).arg(name);
                    command.args(ends.iter().map(|(kind, topic)| format!("{kind}:{topic}")));
                    Process::start(name, &mut command)
                };
                ends.iter().map(start).collect()
            }
        };
        let mut fleet = Self {
            processes,
            folder,
            names,
            library: plan.library,
        };
        for process in &mut fleet.processes {
            process.wait_line("`loaded`", |line| line == "loaded");
        }
        fleet
    }

    /// Opens the FIFO that is the signal to begin. As long as the file is kept, nodes that open it later get
    /// the signal too.
    fn open(&self, name: &str) -> File {
        File::options()
            .write(true)
            .open(self.folder.join(name))
            .unwrap()
    }

    fn lines(&self, word: &str) -> Vec<String> {
        let lines = self.processes.iter().flat_map(Process::stdout);
        let start = format!("{word} ");
        lines
            .filter_map(|line| line.strip_prefix(&start).map(str::to_owned))
            .collect()
    }

    #[track_caller]
    fn wait_for_all(&self, word: &str) -> Vec<String> {
        eventually(&format!("all nodes say `{word}`"), || {
            let ended = self.lines("ended");
            assert!(ended.is_empty(), "{ended:?}\n{}", self.log());
            self.lines(word).len() == self.names.len()
        });
        self.lines(word)
    }

    #[track_caller]
    fn wait_ready(&self) -> Vec<Ready> {
        let parse = |line: &String| {
            let words: Vec<_> = line.split(' ').collect();
            Ready {
                name: words[0].to_owned(),
                api: words[1].to_owned(),
                begin: words[2].parse().unwrap(),
                end: words[3].parse().unwrap(),
            }
        };
        self.wait_for_all("ready").iter().map(parse).collect()
    }

    /// The notifications and answers that each node received. roscpp nodes report nothing.
    #[track_caller]
    fn traces(&self, nodes: &[Ready]) -> Traces {
        let begin = nodes
            .iter()
            .map(|node| node.begin)
            .fold(f64::INFINITY, f64::min);
        let mut traces = Traces::new(begin);
        if self.library == Library::Rospy {
            let _word = self.open("end");
            self.wait_for_all("written");
            for node in nodes {
                let file = self.folder.join(format!("{}.json", &node.name[1..]));
                let events = fs::read_to_string(file).unwrap();
                traces.add(
                    &node.name,
                    &node.api,
                    &serde_json::from_str::<Json>(&events).unwrap(),
                );
            }
        }
        traces
    }

    fn log(&self) -> String {
        self.processes.iter().map(Process::log).collect()
    }
}

/// A link: topic, subscriber, and address of the publisher.
type Link = (String, String, String);

/// The links that belong to a state of the master.
fn wanted(state: &State) -> BTreeSet<Link> {
    let apis: BTreeMap<_, _> = state.nodes.iter().cloned().collect();
    let mut links = BTreeSet::new();
    let own = state
        .subscribers
        .iter()
        .filter(|(topic, _)| topic.starts_with(SPACE));
    for (topic, subscribers) in own {
        for publisher in state.publishers_of(topic) {
            for subscriber in subscribers {
                let api = apis.get(&publisher).cloned().unwrap_or_default();
                links.insert((topic.clone(), subscriber.clone(), api));
            }
        }
    }
    links
}

/// The links that the nodes have made.
fn made(nodes: &[Ready]) -> BTreeSet<Link> {
    let mut links = BTreeSet::new();
    for node in nodes {
        let port = node.api.trim_end_matches('/').rsplit(':').next().unwrap();
        let client = Client::new(port.parse().unwrap());
        let info = client.ok("getBusInfo", vec!["/test".into()]);
        for entry in info.as_array().unwrap() {
            let text = |place: usize| {
                entry.as_array().unwrap()[place]
                    .as_str()
                    .unwrap_or_default()
            };
            if text(2) == "i" && text(4).starts_with(SPACE) {
                links.insert((text(4).to_owned(), node.name.clone(), text(1).to_owned()));
            }
        }
    }
    links
}

/// Starts the nodes of `plan` at a master of the kind `place`, and compares their links with its state.
#[track_caller]
pub(crate) fn start(place: Place, plan: &Plan, seed: u64) -> Start {
    let mut dice = Dice(seed);
    let mut stage = Stage::start(place);
    let fleet = Fleet::load(stage.scratch(), stage.port(), plan, &mut dice);
    stage.set();
    let busy: Vec<_> = (0..plan.load).map(|_| busy(stage.scratch())).collect();
    let word = fleet.open("go");
    stage.disturb(&mut dice);
    let nodes = fleet.wait_ready();
    drop(word);
    let begin = Instant::now();
    let client = stage.client();
    let (state, has) = loop {
        sleep(LOOK);
        let has = made(&nodes);
        let is_over = begin.elapsed() > plan.bound();
        if has.len() != plan.links && !is_over {
            continue;
        }
        let state = State::read(&client);
        if wanted(&state) == has || is_over {
            break (state, has);
        }
    };
    drop(busy);
    let traces = fleet.traces(&nodes);
    let wants = wanted(&state);
    let missing = wants.difference(&has);
    let mut wrong: Vec<_> = has
        .difference(&wants)
        .map(|link| format!("{link:?}"))
        .collect();
    if wants.len() != plan.links {
        wrong.push(format!("the state has {} links:\n{state}", wants.len()));
    }
    let log = match wants == has {
        true => String::new(),
        false => stage.log(),
    };
    let first = nodes
        .iter()
        .map(|node| node.begin)
        .fold(f64::INFINITY, f64::min);
    let last = nodes.iter().map(|node| node.end).fold(0.0, f64::max);
    Start {
        links: wants.len(),
        never_made: missing
            .map(|(topic, node, api)| {
                format!(
                    "{node} is not connected to {topic} of {api}:\n{}",
                    traces.of(topic, node)
                )
            })
            .collect(),
        wrong,
        overtaken: traces.older("answer"),
        went_back: traces.older("update"),
        time: Duration::from_secs_f64(last - first),
        log,
    }
}

/// A process that is never idle.
fn busy(scratch: &Scratch) -> Process {
    let mut command = std::process::Command::new("sh");
    scratch.prepare(&mut command);
    Process::start("busy", command.args(["-c", "while :; do :; done"]))
}
