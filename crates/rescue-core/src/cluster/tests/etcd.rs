//! A model of etcd: both keys and the journal. Transactions are linearizable; what reaches it when, and what
//! of its answers arrives, is the world's affair.

use super::super::machine::{Alive, Answer, Guard, Leader, Op, View};

/// A call that writes, and what becomes of it.
pub(super) type Write = usize;

/// A request as it travels: the records of a beat are in it.
#[derive(Clone, Debug)]
pub(super) struct Request {
    pub(super) from: usize,
    /// The process that sent it.
    pub(super) life: u64,
    pub(super) number: u64,
    pub(super) op: Op,
    pub(super) records: Vec<Write>,
    /// When its sender gives up.
    pub(super) until: u64,
}

#[derive(Debug, Default)]
pub(super) struct Etcd {
    view: View,
    /// The journal. Record 1 is the first.
    pub(super) journal: Vec<Write>,
    /// The names of those who have led, in order.
    pub(super) reigns: Vec<usize>,
}

impl Etcd {
    pub(super) fn view(&self) -> View {
        self.view.clone()
    }

    /// Makes the transaction, if the keys are as it expects.
    pub(super) fn run(&mut self, request: &Request) -> Answer {
        let expected = match &request.op {
            Op::Read => return Answer::Is(self.view()),
            Op::Claim { guard, .. } | Op::Beat { guard, .. } => *guard,
        };
        if self.view.guard() != expected {
            return Answer::Is(self.view());
        }
        self.view.revision += 1;
        let revision = self.view.revision;
        match &request.op {
            Op::Read => {}
            Op::Claim {
                claim,
                seq,
                settled,
                ..
            } => {
                assert_eq!(
                    *seq,
                    self.journal.len() as u64,
                    "a claim knows the journal's end"
                );
                self.reigns.push(request.from);
                self.view.leader = Some(Leader {
                    term: revision,
                    name: name(request.from),
                    id: format!("{} {}", request.from, request.life),
                    claim: *claim,
                    uri: String::new(),
                    boot: String::new(),
                    version: String::new(),
                });
                self.set_alive(0, None, *settled);
            }
            Op::Beat {
                beat,
                released,
                settled,
                ..
            } => {
                self.journal.extend(&request.records);
                self.set_alive(*beat, released.clone(), *settled);
            }
        }
        let seq = self.journal.len() as u64;
        Answer::Applied { revision, seq }
    }

    fn set_alive(&mut self, beat: u64, released: Option<String>, settled: bool) {
        self.view.alive = Some(Alive {
            revision: self.view.revision,
            beat,
            seq: self.journal.len() as u64,
            released,
            settled,
        });
    }

    /// A guard that no key has.
    pub(super) fn changed_since(&self, guard: Guard) -> bool {
        self.view.guard() != guard
    }
}

pub(super) fn name(computer: usize) -> String {
    format!("computer{computer}")
}
