//! Replication: whose writes the ledger holds, which of them may be answered, and until when this computer may lead.

use std::time::Instant;

use rescue_core::cluster::sharing::Sharing;
use tokio::sync::watch;

use crate::wait;

/// Which computer's writes the ledger holds.
#[derive(Debug)]
pub(super) enum Shared {
    /// This is the only computer.
    Single,
    /// Another computer has the master. Only its records are applied and recorded.
    Elsewhere,
    /// This computer has the master. The other computers get its writes.
    Here { times_led: u64, sharing: Sharing },
}

/// A record among those that the other computers get: its number, and how often [`Ledger::leave`](super::Ledger::leave) was
/// called before, which tells the times in which this computer records apart.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct SharedRecord {
    times_led: u64,
    pub(super) seq: u64,
}

impl Shared {
    pub(super) fn last(&self) -> Option<SharedRecord> {
        match self {
            Self::Here { times_led, sharing } => Some(SharedRecord {
                times_led: *times_led,
                seq: sharing.last(),
            }),
            _ => None,
        }
    }
}

/// The last record of this term whose call may be answered. With `--cluster-sync interval`, etcd may get it later.
pub(crate) struct Acknowledged(watch::Sender<SharedRecord>);

impl Acknowledged {
    pub(super) fn new() -> Self {
        Self(watch::Sender::default())
    }

    /// Notes that another computer has the master, so calls that still wait get no answer.
    pub(super) fn note_deposed(&self) {
        self.0.send_modify(|acknowledged| {
            *acknowledged = SharedRecord {
                times_led: acknowledged.times_led + 1,
                seq: 0,
            }
        });
    }

    pub(super) fn times_led(&self) -> u64 {
        self.0.borrow().times_led
    }

    /// The number of that record.
    pub(crate) fn last(&self) -> u64 {
        self.0.borrow().seq
    }

    /// Lets the answers to the calls up to record `seq` go out.
    pub(crate) fn reach(&self, seq: u64) {
        self.0.send_if_modified(|acknowledged| {
            let more = seq > acknowledged.seq;
            acknowledged.seq = acknowledged.seq.max(seq);
            more
        });
    }

    /// Waits until the call of this record may be answered. False if this computer stopped leading before that.
    pub(super) async fn wait(&self, record: SharedRecord) -> bool {
        let mut acknowledged = self.0.subscribe();
        // This cannot fail: this owns the sender.
        let reached = acknowledged.wait_for(|reached| *reached >= record).await;
        reached.is_ok_and(|reached| reached.times_led == record.times_led)
    }
}

/// Until when this computer may act as leader.
pub(crate) struct LeaderLease(watch::Sender<Option<Instant>>);

impl LeaderLease {
    pub(super) fn new() -> Self {
        Self(watch::Sender::new(None))
    }

    /// Sets until when no other computer can lead. `None` if there is no limit. After that time no write goes to this
    /// computer's master and no node is notified: another leader may have acknowledged newer writes while this process
    /// stood still. Reads go on until the gate is shut, and show nothing older than this computer has shown before.
    pub(crate) fn set(&self, until: Option<Instant>) {
        self.0.send_if_modified(|lease| {
            // Extending a lease wakes no waiter: readers see it anyway, and waiters need only a new lease, or an earlier
            // end.
            let now = Instant::now();
            let holds = |until: Option<Instant>| until.is_none_or(|until| now < until);
            let was_held = holds(*lease);
            let is_earlier = until.is_some_and(|until| lease.is_none_or(|before| until < before));
            *lease = until;
            if was_held { is_earlier } else { holds(until) }
        });
    }

    /// Whether this computer may act as leader now; see [`Self::set`].
    pub(crate) fn is_held(&self) -> bool {
        self.0.borrow().is_none_or(|until| Instant::now() < until)
    }

    /// Signals when this computer may act as leader again, or for a shorter time than before.
    pub(crate) fn changed(&self) -> watch::Receiver<Option<Instant>> {
        self.0.subscribe()
    }

    /// Waits until this computer may act as leader.
    pub(crate) async fn wait(&self) {
        let mut changed = self.changed();
        while !self.is_held() {
            // This cannot fail: this owns the sender.
            let _ = changed.changed().await;
        }
    }

    /// Waits until this computer may no longer act as leader.
    pub(crate) async fn lapsed(&self) {
        let mut changed = self.changed();
        while self.is_held() {
            let until = *changed.borrow_and_update();
            tokio::select! {
                // This cannot fail: this owns the sender.
                _ = changed.changed() => {}
                () = wait::sleep_until(until.map(Into::into)) => {}
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::{sync::Arc, time::Duration};

    use super::*;
    use crate::{
        cli::SyncPolicy,
        ledger::{Ledger, Mark},
    };
    use rescue_core::{
        checkpoint::format::{Origin, Record, RecordContent, Session},
        cluster::{
            merge::MergeVerdict,
            sharing::{Change, Source},
        },
    };
    use ros1_master::{
        master::{Master, Method, Request},
        xmlrpc::{Reply, Value},
    };

    fn ledger() -> Ledger {
        let (mirror, session) = (Master::default(), Session::default());
        let stats = Box::leak(Box::default());
        Ledger::new(
            mirror,
            session,
            Vec::new(),
            None,
            SyncPolicy::Interval,
            stats,
        )
    }

    fn set(value: i32) -> Request {
        let params = [Value::from("/n"), "/a".into(), value.into()];
        Request::new(Method::SetParam, params)
    }

    fn record(seq: u64, call: Request) -> Record {
        let entry = RecordContent::call(call);
        Record { seq, entry }
    }

    fn state_of(calls: impl IntoIterator<Item = Request>) -> Master {
        let mut state = Master::default();
        for call in calls {
            state.apply(&call);
        }
        state
    }

    /// Answers `call` in place of a master, and returns what must be safe before the answer counts.
    fn answer(ledger: &Ledger, call: &Request) -> Mark {
        ledger.answer_from_mirror(Instant::now(), call).unwrap().1
    }

    fn seqs(ledger: &Ledger) -> Vec<u64> {
        let changes = ledger.take_changes();
        changes.iter().map(Change::seq).collect()
    }

    /// Whether a call with this mark was acknowledged. `None` if it still waits.
    async fn acknowledged(ledger: &Ledger, mark: Mark) -> Option<bool> {
        let Some(mark) = ledger.to_await(mark) else {
            return Some(true);
        };
        tokio::select! {
            biased;
            safe = ledger.durable(mark) => Some(safe),
            () = tokio::task::yield_now() => None,
        }
    }

    #[tokio::test]
    async fn without_other_computers_nothing_is_collected_and_no_answer_waits_for_them() {
        let ledger = ledger();
        let mark = answer(&ledger, &set(1));
        assert_eq!(acknowledged(&ledger, mark).await, Some(true));
        assert!(seqs(&ledger).is_empty());
        assert!(ledger.follow(&[record(1, set(2))]).is_err());
        assert!(ledger.follow_state(1, Master::default()).is_err());
    }

    #[test]
    fn while_another_computer_has_the_master_its_records_are_followed_and_nothing_else_is_taken() {
        let ledger = ledger();
        ledger.leave();
        assert!(ledger.answer_from_mirror(Instant::now(), &set(1)).is_none());
        let reply = Reply::Value(vec![Value::from(1), "".into(), 0.into()].into());
        let recorded = ledger.record_here(Instant::now(), 0, &[(&set(1), &reply)]);
        assert!(recorded.is_err());
        let before = ledger.version();
        assert!(ledger.adopt_if(0, before, state_of([set(1)])).is_err());
        ledger
            .follow(&[record(1, set(2)), record(2, set(3))])
            .unwrap();
        assert!(ledger.with_mirror(|mirror| *mirror == state_of([set(3)])));
        assert_ne!(ledger.version(), before);
        ledger.follow_state(3, state_of([set(4)])).unwrap();
        assert!(ledger.with_mirror(|mirror| *mirror == state_of([set(4)])));
        assert!(seqs(&ledger).is_empty());
    }

    #[tokio::test]
    async fn a_leaders_records_have_the_next_numbers_and_are_acknowledged_when_the_others_have_them()
     {
        let ledger = ledger();
        ledger.leave();
        ledger.lead(7, &Master::default());
        let marks = [set(1), set(2)].map(|call| answer(&ledger, &call));
        assert_eq!(seqs(&ledger), [8, 9]);
        assert!(seqs(&ledger).is_empty());
        assert_eq!(acknowledged(&ledger, marks[0]).await, None);
        ledger.acknowledged.reach(8);
        assert_eq!(acknowledged(&ledger, marks[0]).await, Some(true));
        assert_eq!(acknowledged(&ledger, marks[1]).await, None);
        ledger.acknowledged.reach(9);
        // A late acknowledgement undoes nothing.
        ledger.acknowledged.reach(8);
        assert_eq!(acknowledged(&ledger, marks[1]).await, Some(true));
    }

    #[test]
    fn a_leaders_checkpoint_tells_how_much_of_the_computers_journal_it_holds() {
        let ledger = ledger();
        ledger.leave();
        ledger.lead(7, &Master::default());
        let cluster_seq = || ledger.checkpoint()().session.cluster_seq;
        assert_eq!(cluster_seq(), 7);
        answer(&ledger, &set(1));
        assert_eq!(cluster_seq(), 8);
        ledger.update_session(|session| session.term = 3);
        let in_record = || ledger.lock().session_record().cluster_seq;
        assert_eq!(in_record(), 8);
        // A state without a record is in the next checkpoint, but not in the file before it.
        ledger.adopt(state_of([set(2)]));
        answer(&ledger, &set(3));
        assert_eq!(in_record(), 0);
        assert_eq!(cluster_seq(), 10);
    }

    /// A number that is too high looks like a loss of etcd's data at the next start, and one that is too low hides one.
    #[test]
    fn a_followers_checkpoint_tells_how_much_of_etcds_journal_it_holds() {
        let ledger = ledger();
        let cluster_seq = || ledger.checkpoint()().session.cluster_seq;
        ledger.leave();
        ledger
            .follow(&[record(7, set(1)), record(8, set(2))])
            .unwrap();
        assert_eq!(cluster_seq(), 8);
        // While it is cut off, it counts its own writes, of which the journal gets the last.
        ledger.lead(8, &state_of([set(2)]));
        for value in 3..53 {
            answer(&ledger, &set(value));
        }
        assert_eq!(cluster_seq(), 58);
        // As at an orderly stop.
        ledger.leave();
        assert_eq!(cluster_seq(), 58);
        ledger.note_followed(9);
        assert_eq!(cluster_seq(), 9);
        assert!(!ledger.lock().session_unwritten, "the file still has 58");
        ledger.follow(&[record(10, set(60))]).unwrap();
        assert_eq!(cluster_seq(), 10);
        // The file lacks a state that is adopted, until a complete checkpoint is written.
        ledger.follow_state(20, state_of([set(61)])).unwrap();
        assert_eq!(cluster_seq(), 20);
        assert!(ledger.lock().session_unwritten);
        assert_eq!(ledger.lock().session_record().cluster_seq, 0);
        // A record comes while that checkpoint is written, and the one after it must not count on from 0.
        let version = ledger.lock().version;
        ledger.lock().whole.taken = version;
        ledger.follow(&[record(21, set(62))]).unwrap();
        ledger.set_attempted(Ok(()));
        assert!(ledger.lock().session_unwritten);
        assert_eq!(ledger.lock().session_record().cluster_seq, 21);
    }

    #[tokio::test]
    async fn a_first_write_that_changes_nothing_does_not_wait() {
        let ledger = ledger();
        ledger.leave();
        let watch = Request::new(Method::SubscribeParam, ["/n", "http://n:1/", "/a"]);
        ledger.follow(&[record(7, watch.clone())]).unwrap();
        ledger.lead(7, &state_of([watch.clone()]));
        let mark = answer(&ledger, &watch);
        assert_eq!(acknowledged(&ledger, mark).await, Some(true));
        assert!(seqs(&ledger).is_empty());
    }

    /// Otherwise an older value from a computer that was cut off would replace it.
    #[tokio::test]
    async fn a_parameter_that_is_set_again_gets_a_record_for_the_others() {
        let ledger = ledger();
        ledger.leave();
        ledger.follow(&[record(7, set(1))]).unwrap();
        ledger.lead(7, &state_of([set(1)]));
        let cluster_seq = || ledger.checkpoint()().session.cluster_seq;
        let pending = ledger.pending();
        let again = answer(&ledger, &set(1));
        assert_eq!((seqs(&ledger), cluster_seq()), (vec![8], 8));
        assert_eq!(ledger.pending(), pending);
        assert_eq!(acknowledged(&ledger, again).await, None);
        ledger.acknowledged.reach(8);
        assert_eq!(acknowledged(&ledger, again).await, Some(true));
        answer(&ledger, &set(2));
        assert_eq!((seqs(&ledger), cluster_seq()), (vec![9], 9));
        // A slow master runs it first.
        let early = Arc::new(ledger).answer_if_unchanged(Instant::now(), &set(2));
        assert!(early.is_none());
    }

    #[tokio::test]
    async fn what_the_others_lack_when_another_computer_leads_is_not_acknowledged() {
        let ledger = ledger();
        ledger.leave();
        ledger.lead(0, &Master::default());
        let marks = [set(1), set(2)].map(|call| answer(&ledger, &call));
        ledger.acknowledged.reach(1);
        ledger.leave();
        assert!(seqs(&ledger).is_empty());
        assert_eq!(acknowledged(&ledger, marks[1]).await, Some(false));
        // The old calls stay unacknowledged when this computer leads again and uses their numbers for other calls.
        ledger.follow_state(1, state_of([set(1)])).unwrap();
        ledger.lead(1, &state_of([set(1)]));
        let again = answer(&ledger, &set(3));
        ledger.acknowledged.reach(2);
        assert_eq!(acknowledged(&ledger, again).await, Some(true));
        assert_eq!(acknowledged(&ledger, marks[1]).await, Some(false));
    }

    fn set_of(key: &str, value: i32) -> Request {
        let params = [Value::from("/n"), key.into(), value.into()];
        Request::new(Method::SetParam, params)
    }

    /// Whether a computer that was cut off may set each of these parameters to -1.
    fn judged(ledger: &Ledger, seq: u64, keys: &[&str]) -> Option<Vec<bool>> {
        let set = |key: &&str| Request::new(Method::SetParam, ["/m", key, "-1"]);
        let calls: Vec<_> = keys.iter().map(set).collect();
        let calls: Vec<_> = calls.iter().collect();
        let verdicts = ledger.merge_verdicts(seq, "mine", &calls)?;
        Some(
            verdicts
                .iter()
                .map(|of| *of == MergeVerdict::Apply)
                .collect(),
        )
    }

    #[test]
    fn what_others_have_changed_after_a_record_is_known_by_its_number_and_by_who_it_was() {
        let ledger = ledger();
        assert_eq!(judged(&ledger, 0, &["/a"]), None);
        ledger.leave();
        assert_eq!(judged(&ledger, 0, &["/a"]), None);
        ledger.lead(7, &Master::default());
        let reply = Reply::Value(vec![Value::from(1), "".into(), 0.into()].into());
        let sources = [
            Source::Here,
            Source::Forwarded,
            Source::Merge("mine".into()),
            Source::Merge("another's".into()),
        ];
        let keys = ["/a", "/b", "/c", "/d", "/e"];
        let calls: Vec<_> = keys.iter().map(|key| set_of(key, 1)).collect();
        let batch = calls.iter().zip(&sources);
        let batch: Vec<_> = batch
            .map(|(call, source)| (call, &reply, source, Origin::Unknown))
            .collect();
        ledger
            .record(Instant::now(), ledger.incarnation(), &batch)
            .unwrap();
        let of = |seq| judged(&ledger, seq, &keys);
        assert_eq!(of(6), None);
        assert_eq!(of(7), Some(vec![false, false, true, false, true]));
        assert_eq!(of(8), Some(vec![true, false, true, false, true]));
        assert_eq!(of(11), Some(vec![true; 5]));
        let changes = ledger.take_changes();
        let forwarded = |change: &Change| matches!(change, Change::Call(_, Source::Forwarded));
        let forwarded = changes.iter().filter(|change| forwarded(change));
        assert_eq!(forwarded.map(Change::seq).collect::<Vec<_>>(), [9]);
        // A new state may differ in any part.
        ledger.adopt(state_of([set(1)]));
        assert_eq!(judged(&ledger, 11, &["/x"]), None);
        assert_eq!(judged(&ledger, 12, &["/x"]), Some(vec![true]));
    }

    #[test]
    fn changes_that_nobody_is_given_become_one_state() {
        let ledger = ledger();
        assert!(ledger.take_as_state().is_none());
        ledger.leave();
        ledger.lead(7, &Master::default());
        for call in [set(1), set(2)] {
            answer(&ledger, &call);
        }
        let Some(Change::State { seq: 9, state }) = ledger.take_as_state() else {
            panic!("no state");
        };
        assert!(*state == state_of([set(2)]));
        assert!(seqs(&ledger).is_empty());
    }

    #[tokio::test]
    async fn who_waits_for_the_lease_goes_on_when_there_is_a_new_one() {
        let ledger = ledger();
        assert!(
            ledger.lease.is_held(),
            "without other computers it always holds"
        );
        let now = Instant::now();
        ledger.lease.set(Some(now));
        assert!(!ledger.lease.is_held());
        let waits = async { ledger.lease.wait().await };
        let renews = async {
            tokio::task::yield_now().await;
            ledger.lease.set(Some(now + Duration::from_secs(60)));
        };
        tokio::join!(waits, renews);
        assert!(ledger.lease.is_held());
        ledger.lease.set(None);
        assert!(ledger.lease.is_held());
    }

    #[tokio::test]
    async fn a_lease_lapses_when_it_is_not_extended_or_gets_a_first_limit() {
        let ledger = ledger();
        let lapsed = || ledger.lease.lapsed();
        let limits = async {
            tokio::task::yield_now().await;
            ledger.lease.set(Some(Instant::now()));
        };
        tokio::join!(lapsed(), limits);
        let until = Instant::now() + Duration::from_millis(100);
        ledger.lease.set(Some(until));
        let extends = async {
            tokio::task::yield_now().await;
            ledger.lease.set(Some(until + Duration::from_millis(100)));
        };
        tokio::join!(lapsed(), extends);
        assert!(Instant::now() >= until + Duration::from_millis(100));
    }

    /// A computer that hands over stops leading before its lease ends.
    #[tokio::test]
    async fn a_lease_that_is_ended_early_lapses_at_once() {
        let ledger = ledger();
        let now = Instant::now();
        ledger.lease.set(Some(now + Duration::from_secs(60)));
        let ends = async {
            tokio::task::yield_now().await;
            ledger.lease.set(Some(now));
        };
        let both = async { tokio::join!(ledger.lease.lapsed(), ends) };
        let limit = Duration::from_secs(20);
        assert!(tokio::time::timeout(limit, both).await.is_ok());
    }

    #[tokio::test]
    async fn a_state_that_other_computers_lack_is_sent_to_them_as_a_whole() {
        let ledger = ledger();
        answer(&ledger, &set(1));
        ledger.leave();
        ledger.lead(7, &Master::default());
        let mark = answer(&ledger, &set(2));
        ledger.adopt(state_of([set(3)]));
        let changes = ledger.take_changes();
        let [
            Change::State {
                seq: 8,
                state: first,
            },
            Change::Call(Record { seq: 9, .. }, _),
            Change::State {
                seq: 10,
                state: last,
            },
        ] = changes.as_slice()
        else {
            panic!("{changes:?}");
        };
        assert!(**first == state_of([set(1)]) && **last == state_of([set(3)]));
        ledger.acknowledged.reach(8);
        assert_eq!(acknowledged(&ledger, mark).await, None);
    }
}
