//! Tests one situation at a time. `crate::cluster::tests` combines many.

use super::*;
use crate::{
    checkpoint::format::{Record, RecordContent},
    cluster::{
        machine::{Alive, Commit, EtcdAnswer, Leader},
        merge::wire::{Ask, MergeAnswer, WriteOutcome},
        sharing::{Change, Source},
        standing::AnsweredCalls,
    },
};
use ros1_master::{
    master::{Method, Request},
    xmlrpc::Value,
};

/// Record `seq`, in which others set the parameter again.
fn record(seq: u64) -> Record {
    let value = i32::try_from(seq).unwrap();
    let entry = RecordContent::call(set(value));
    Record { seq, entry }
}

fn set(value: i32) -> Request {
    let params = [Value::from("/n"), "/k".into(), value.into()];
    Request::new(Method::SetParam, params)
}

/// The keys when `b` leads, and its journal ends with record `seq`.
fn led(seq: u64) -> View {
    let revision = seq + 1;
    View {
        revision,
        origin: 1,
        journal_number: 1,
        leader: Some(Leader {
            term: 1,
            name: "b".to_owned(),
            id: "b-1".to_owned(),
            claim: 1,
            claimed_at: 0,
            uri: "http://b:1/".to_owned(),
            boot: String::new(),
            version: String::new(),
        }),
        alive: Some(Alive {
            revision,
            beat: seq,
            seq,
            released: None,
            settled: true,
        }),
    }
}

/// A computer that has set the parameter while it was cut off, and a model of etcd's journal.
struct Merges {
    member: Member,
    now: Instant,
    inputs: VecDeque<Input>,
    journal: Progress,
    lost: usize,
}

impl Merges {
    fn new() -> Self {
        let settings = Settings {
            name: "a".to_owned(),
            id: "a-1".to_owned(),
            uri: "http://a:1/".to_owned(),
            boot: String::new(),
            version: String::new(),
            ttl: Duration::from_secs(2),
            commit: Commit::Always,
            alone: WhenAlone::Serve,
        };
        let left = PartitionWrites {
            calls: vec![set(-1)],
            ..PartitionWrites::default()
        };
        let (keys, own) = (Keys::new("robot"), LocalCheckpoint::default());
        Self {
            member: Member::new(settings, keys, own, Some(left), "a-1".to_owned()),
            now: Instant::now(),
            inputs: VecDeque::from([Input::Begin]),
            journal: Progress::default(),
            lost: 0,
        }
    }

    /// Runs until the member asks the leader to merge a portion. `None` once all writes are merged.
    fn next(&mut self) -> Option<(u64, Ask)> {
        let until = self.now + Duration::from_secs(5);
        let mut asked = None;
        while asked.is_none() {
            let input = self.inputs.pop_front().unwrap_or_else(|| {
                self.now = self.member.deadline().unwrap();
                Input::Wake
            });
            assert!(self.now < until, "{:?}", self.member);
            for action in self.member.on(self.now, input) {
                match action {
                    Action::Send { number, .. } => {
                        let answer = EtcdAnswer::Is(led(self.journal.seq));
                        self.inputs.push_back(Input::Answer { number, answer });
                    }
                    Action::Load(known) => {
                        assert_eq!(known.seq, self.journal.seq);
                        self.load();
                    }
                    Action::Report(outcomes) => self.lost += outcomes.len(),
                    Action::Merge { number, ask, .. } => asked = Some((number, ask)),
                    Action::Log(News::Merged { .. }) => return None,
                    _ => {}
                }
            }
        }
        asked
    }

    /// The values of the parameter that the mirror gets because of `input`.
    fn shown_after(&mut self, input: Input) -> Vec<Value> {
        let actions = self.member.on(self.now, input);
        let states = actions.iter().filter_map(|action| match action {
            Action::FollowState { state, .. } => state.params().get("k").cloned(),
            _ => None,
        });
        states.collect()
    }

    /// Answers a read of the journal, in which others have set the parameter again.
    fn load(&mut self) {
        let seq = self.journal.seq + 1;
        let records = vec![record(seq)];
        self.journal.take(records.clone(), 1).unwrap();
        self.inputs.push_back(Input::Loaded(Some(Read {
            view: led(seq),
            is_readable: true,
            state: None,
            records,
            progress: self.journal,
            members: Vec::new(),
        })));
    }
}

/// A merge must end, because the calls of this computer's nodes wait for it.
#[test]
fn a_merge_ends_although_others_keep_changing_a_parameter_whose_value_was_lost() {
    let (mut merges, mut told) = (Merges::new(), 0);
    while let Some((number, ask)) = merges.next() {
        // The write itself is lost, so the nodes must hear the others' value.
        let value = i32::try_from(merges.journal.seq).unwrap();
        assert_eq!(ask.calls.len(), 1);
        assert_eq!(ask.calls[0].params().get(2), Some(&value.into()));
        let outcome = WriteOutcome::Lost {
            why: "changed".to_owned(),
            present: None,
        };
        let answer = Some(MergeAnswer::Done(vec![outcome]));
        merges.inputs.push_back(Input::Merged { number, answer });
        told += 1;
    }
    assert_eq!((told, merges.lost), (4, 1));
}

/// With thousands of writes to merge, each new state costs 10 ms. If every record of others cost as much, this computer
/// would fall further and further behind.
#[test]
fn however_many_records_arrive_at_once_they_make_one_new_state() {
    let mut merges = Merges::new();
    assert!(merges.next().is_some());
    let first = merges.journal.seq + 1;
    let entries = (first..first + 50).map(|seq| {
        let records = vec![record(seq)];
        (seq + 1, WatchedEntry::Records { records, bytes: 1 })
    });
    let (view, entries, members) = (led(first + 49), entries.collect(), Vec::new());
    let watched = Input::Watched {
        view,
        entries,
        deleted: None,
        members,
    };
    let last = i32::try_from(first + 49).unwrap();
    assert_eq!(merges.shown_after(watched), [last.into()]);
}

/// A computer restarts before the writes that it answered while cut off are merged, and others have changed the same
/// parameter. It showed their value before, so it must not show its own again.
#[test]
fn after_a_restart_a_kept_write_that_conflicts_with_the_journal_is_not_shown() {
    let mut merges = Merges::new();
    assert_eq!(merges.shown_after(Input::Begin), []);
    merges.load();
    let loaded = merges.inputs.pop_back().unwrap();
    let shown = merges.shown_after(loaded);
    assert!(shown.iter().all(|value| *value == 1.into()), "{shown:?}");
    assert!(!shown.is_empty());
}

/// A leader that was cut off twice leads again, and its journal lacks the writes of the second time when those of the
/// first have been merged. A power cut would lose them.
#[test]
fn the_end_of_a_merge_keeps_the_file_of_writes_that_the_journal_lacks() {
    let keeps_nothing = |member: &mut Member| {
        member.finish_partition(Instant::now());
        let mut actions = member.queue.actions.drain(..);
        actions.any(|action| matches!(action, Action::DeletePartitionWrites))
    };
    assert!(keeps_nothing(&mut Merges::new().member));
    let mut member = Merges::new().member;
    member.chores.keep_until(5);
    assert!(!keeps_nothing(&mut member));
}

/// A leader restarts and finds that its checkpoint holds the whole journal. Then etcd carries out its earlier process's
/// last request. The checkpoint must not replace that.
#[test]
fn a_record_that_reaches_the_journal_after_the_first_read_counts_more_than_the_checkpoint() {
    let own_view = |seq| {
        let mut view = led(seq);
        let leader = view.leader.as_mut().unwrap();
        (leader.name, leader.id) = ("a".to_owned(), "a-0".to_owned());
        view
    };
    let records = |seq| vec![record(seq)];
    let mut progress = Progress::default();
    progress.take(records(1), 1).unwrap();
    let mut state = Master::default();
    state.apply(&set(1));
    let own = LocalCheckpoint {
        state,
        seq: 1,
        term: 1,
        journal_number: 1,
        restored: true,
    };
    let (keys, settings) = (Keys::new("robot"), Merges::new().member.settings().clone());
    let mut member = Member::new(settings, keys, own, None, "a-1".to_owned());
    let now = Instant::now();
    let mut followed = |input| {
        let mut actions = member.on(now, input).into_iter();
        actions.find_map(|action| match action {
            Action::FollowState { state, .. } => state.params().get("k").cloned(),
            _ => None,
        })
    };
    assert_eq!(followed(Input::Begin), None);
    let loaded = Input::Loaded(Some(Read {
        view: own_view(1),
        is_readable: true,
        state: None,
        records: records(1),
        progress,
        members: Vec::new(),
    }));
    assert_eq!(followed(loaded), None);
    let (revision, records) = (3, records(2));
    let late = Input::Watched {
        view: own_view(2),
        entries: vec![(revision, WatchedEntry::Records { records, bytes: 1 })],
        deleted: None,
        members: Vec::new(),
    };
    assert_eq!(followed(late), Some(2.into()));
}

/// A computer begins a journal, and is cut off before the journal has its state. Compared with the empty journal,
/// everything in the next leader's state would be a change of others.
#[test]
fn who_is_cut_off_from_an_empty_journal_begins_in_its_own_state() {
    let mut state = Master::default();
    state.apply(&set(1));
    let own = LocalCheckpoint {
        state: state.clone(),
        restored: true,
        ..LocalCheckpoint::default()
    };
    let (keys, settings) = (Keys::new("robot"), Merges::new().member.settings().clone());
    let mut member = Member::new(settings, keys, own, None, "a-1".to_owned());
    let mut now = Instant::now();
    let mut inputs = VecDeque::from([Input::Begin]);
    while member.role() != Role::Alone {
        let input = inputs.pop_front().unwrap_or_else(|| {
            now = member.deadline().unwrap();
            Input::Wake
        });
        for action in member.on(now, input) {
            match action {
                Action::Load(_) => inputs.push_back(Input::Loaded(Some(Read::empty()))),
                Action::Send { number, op, .. } => {
                    let answer = match op {
                        machine::Op::Read => EtcdAnswer::Is(View::default()),
                        machine::Op::Claim { seq, .. } => EtcdAnswer::Applied { revision: 1, seq },
                        machine::Op::Beat { .. } => continue,
                    };
                    inputs.push_back(Input::Answer { number, answer });
                }
                _ => {}
            }
        }
    }
    assert_eq!(member.partition_writes().unwrap().base, state);
}

/// A computer that starts with an etcd of its own, which is empty.
struct Lone {
    member: Member,
    now: Instant,
    inputs: VecDeque<Input>,
    revision: u64,
    /// Whether etcd answers.
    has_etcd: bool,
}

impl Lone {
    fn new() -> Self {
        let (keys, settings) = (Keys::new("robot"), Merges::new().member.settings().clone());
        let own = LocalCheckpoint::default();
        Self {
            member: Member::new(settings, keys, own, None, "a-1".to_owned()),
            now: Instant::now(),
            inputs: VecDeque::from([Input::Begin]),
            revision: 0,
            has_etcd: true,
        }
    }

    /// Gives the member its next input, and answers what it asks etcd. Returns its other actions.
    fn step(&mut self) -> Vec<Action> {
        let input = self.inputs.pop_front().unwrap_or_else(|| {
            self.now = self.member.deadline().unwrap();
            Input::Wake
        });
        let mut others = Vec::new();
        for action in self.member.on(self.now, input) {
            match action {
                Action::Load(_) => self.inputs.push_back(Input::Loaded(Some(Read::empty()))),
                Action::Send { number, op, .. } if self.has_etcd => {
                    self.revision += 1;
                    let revision = self.revision;
                    let answer = match op {
                        machine::Op::Read => EtcdAnswer::Is(View::default()),
                        machine::Op::Claim { seq, .. } | machine::Op::Beat { seq, .. } => {
                            EtcdAnswer::Applied { revision, seq }
                        }
                    };
                    self.inputs.push_back(Input::Answer { number, answer });
                }
                other => others.push(other),
            }
        }
        others
    }

    /// Has the member record a write so large that its parts are written to etcd first.
    fn record_large(&mut self, seq: u64) {
        let value = "x".repeat(4 << 20);
        let params = [Value::from("/n"), "/k".into(), (&*value).into()];
        let entry = RecordContent::call(Request::new(Method::SetParam, params));
        let change = Change::Call(Record { seq, entry }, Source::Here);
        self.inputs.push_back(Input::Recorded(vec![change]));
    }
}

/// A leader drops its changes when it leads again after it was cut off, while a slow etcd may still take the parts of one.
#[test]
fn the_parts_of_an_earlier_write_are_not_taken_for_those_of_the_present_one() {
    let mut it = Lone::new();
    let (mut jobs, mut before) = (Vec::new(), 0);
    while jobs.len() < 2 {
        for action in it.step() {
            match action {
                Action::StartRecording { seq, .. } => {
                    before = seq;
                    it.record_large(before + 1);
                }
                Action::Prepare { number, .. } => {
                    jobs.push(number);
                    if jobs.len() < 2 {
                        it.member.outgoing.start(before);
                        it.record_large(before + 1);
                    }
                }
                _ => {}
            }
        }
    }
    for (number, ready) in jobs.into_iter().zip([before, before + 1]) {
        let leads = Some(true);
        it.member.on(it.now, Input::Prepared { number, leads });
        assert_eq!(it.member.outgoing.ready(), ready);
    }
}

/// The disk may be slow, and the next leader may notify all nodes already.
#[test]
fn a_leader_that_is_cut_off_notifies_only_its_own_nodes_before_it_stores_anything() {
    let mut it = Lone::new();
    let mut steps = Vec::new();
    while it.member.machine().role() != Role::Alone {
        steps.clear();
        for action in it.step() {
            match action {
                Action::BeginMaster(_) => it.has_etcd = false,
                Action::NotifyOwnOnly(true) => steps.push("own only"),
                Action::ReplacePartitionWrites(_) => steps.push("store"),
                Action::AnswerFromMirror => steps.push("answer"),
                _ => {}
            }
        }
    }
    assert_eq!(steps, ["own only", "store", "answer"]);
}

/// etcd takes no parts of a large value, so a handover cannot begin. Its time runs out, and calls do not wait any longer.
#[test]
fn a_handover_of_which_etcd_never_hears_ends_in_time() {
    let mut it = Lone::new();
    let mut refused = false;
    while !refused {
        for action in it.step() {
            match action {
                Action::StartRecording { seq, .. } => {
                    it.record_large(seq + 1);
                    let (to, none) = (String::new(), None);
                    it.inputs.push_back(Input::HandOver { to, refused: none });
                }
                Action::HandedOver(result) => {
                    assert!(result.is_err());
                    refused = true;
                }
                _ => {}
            }
        }
    }
    let member = it.member;
    let answers = AnsweredCalls::All;
    let term = member.machine().term().unwrap();
    assert_eq!(*member.standing(), Standing::Leads { term, answers });
}
