//! Messages from each computer to each computer.

use crate::computer::{Computer, NAMES};
use crate::fleet::Fleet;
use crate::network::COUNT;
use crate::support::{Library, eventually};

const TALKERS: [Library; COUNT] = [Library::Roscpp, Library::Rospy, Library::Roscpp];
const LISTENERS: [Library; COUNT] = [Library::Rospy, Library::Roscpp, Library::Roscpp];

/// A listener prints each fifth message.
const EVERY: usize = 5;

/// The number of gaps that each computer's listener has seen so far.
#[derive(Debug)]
pub(crate) struct Mark(Vec<usize>);

impl Fleet {
    /// Starts a talker and a listener on each computer, all on the same topic.
    #[track_caller]
    pub(crate) fn start_all_nodes(&mut self) {
        for index in 0..COUNT {
            self.start_nodes(index);
        }
        self.await_flow(&[0, 1, 2]);
    }

    #[track_caller]
    pub(crate) fn start_nodes(&mut self, index: usize) {
        let computer = &mut self.computers[index];
        let name = |node: &str| format!("__name:={node}_{}", NAMES[index]);
        let arguments = ["30", "quiet", &name("talker")];
        computer.talker = Some(computer.node(TALKERS[index], "talker", &arguments));
        let (every, name) = (EVERY.to_string(), name("listener"));
        let arguments = [every.as_str(), &name];
        computer.listener = Some(computer.node(LISTENERS[index], "listener", &arguments));
    }

    /// Waits until messages arrive from each of these computers at each of them.
    #[track_caller]
    pub(crate) fn await_flow(&self, those: &[usize]) {
        let messages = |(listener, talker): (usize, usize)| {
            let listener: &Computer = &self.computers[listener];
            let listener = listener.listener.as_ref().unwrap();
            listener
                .messages(&format!("/talker_{}", NAMES[talker]))
                .len()
        };
        let before: Vec<_> = pairs(those).map(|pair| (pair, messages(pair))).collect();
        for (pair, before) in before {
            let (to, from) = (NAMES[pair.0], NAMES[pair.1]);
            let what = format!("messages come from {from} to {to}");
            eventually(&what, || messages(pair) >= before + 2);
        }
    }

    pub(crate) fn mark(&self) -> Mark {
        let gaps = self.computers.iter().map(|computer| {
            let listener = computer.listener.as_ref();
            listener.map_or(0, |listener| listener.said("gap").len())
        });
        Mark(gaps.collect())
    }

    /// Panics if a message between these computers was lost since `mark`, or no more messages arrive.
    #[track_caller]
    pub(crate) fn assert_streams_whole(&self, those: &[usize], mark: &Mark) {
        self.await_flow(those);
        for (index, talker) in pairs(those) {
            let listener = self.computers[index].listener.as_ref().unwrap();
            let from = format!("/talker_{} ", NAMES[talker]);
            let gaps = listener.said("gap");
            let mut gaps = gaps.iter().skip(mark.0[index]);
            let gap = gaps.find(|gap| gap.starts_with(&from));
            assert!(
                gap.is_none(),
                "{} lost messages: {gap:?}\n{}",
                NAMES[index],
                listener.log()
            );
        }
    }
}

fn pairs(those: &[usize]) -> impl Iterator<Item = (usize, usize)> {
    those
        .iter()
        .flat_map(move |&one| those.iter().map(move |&other| (one, other)))
}
