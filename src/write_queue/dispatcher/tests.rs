//! How long writes wait for the master.

use rescue_core::checkpoint::format::Session;
use ros1_master::{master::Method, xmlrpc::Value};

use super::{super::tests::raw, *};
use crate::cli::SyncPolicy;

/// A write queue whose master answers late.
struct Late {
    ledger: Arc<Ledger>,
    dispatcher: Dispatcher,
    now: Instant,
}

impl Late {
    fn new() -> Self {
        let stats: &'static Stats = Box::leak(Box::default());
        let (session, sync) = (Session::default(), SyncPolicy::Interval);
        let ledger = Ledger::new(Master::default(), session, Vec::new(), None, sync, stats);
        let ledger = Arc::new(ledger);
        ledger.succeed();
        ledger.open_gate();
        let (judge, patience) = (Arc::new(()), Patience::new(PATIENCE));
        Self {
            dispatcher: Dispatcher::new(ledger.clone(), judge, stats, Writes::Master, patience),
            ledger,
            now: Instant::now(),
        }
    }

    /// What the dispatcher reports after `input`.
    fn reports(&mut self, input: Input) -> Vec<Report> {
        let view = View {
            now: self.now,
            gate: self.ledger.gate().state(),
            gate_changed: false,
            leads: true,
            silent_since: None,
        };
        let actions = self.dispatcher.on(&view, input).into_iter();
        let reports = actions.filter_map(|action| match action {
            Action::Report(report) => Some(report),
            _ => None,
        });
        reports.collect()
    }

    /// Sends a write, and waits until the mirror must answer it. Returns how long that takes.
    fn late_after(&mut self) -> Duration {
        let params = [Value::from("/n"), "/p".into(), 1.into()];
        let call = Arc::new(Request::new(Method::SetParam, params));
        let (item, _answered) = Item::new(MadeBy::Rosrescue(None), Some(call));
        let sent = self.now;
        let mut reports = self.reports(Input::Calls(vec![item]));
        while reports.is_empty() {
            self.now = self.dispatcher.deadline().expect("the write waits");
            reports = self.reports(Input::Wake);
        }
        assert_eq!(reports, [Report::Late]);
        self.now - sent
    }

    /// The mirror answers until the master has answered, too, and has what it missed.
    fn catch_up(&mut self) {
        self.ledger.shut_gate(State::Late);
        assert_eq!(self.reports(Input::Wake), []);
        let success = Value::Array(vec![1.into(), "".into(), 0.into()]);
        let answer = Received::Reply(raw(&Reply::Value(success)));
        let ended = Input::Ended(Ok(answer));
        assert_eq!(self.reports(ended), [Report::LateAnswered]);
        let missed = self.ledger.begin_catch_up();
        assert!(missed.is_some(), "the master has answered");
        self.ledger.delivered();
        self.ledger.open_gate();
    }
}

#[test]
fn writes_wait_longer_after_false_alarms_and_a_minute_later_as_before() {
    let mut late = Late::new();
    for factor in [1, 1, 1, 1, 1, 1, 2, 4, 8] {
        assert_eq!(late.late_after(), PATIENCE * factor);
        late.catch_up();
    }
    late.now += Duration::from_secs(70);
    assert_eq!(late.late_after(), PATIENCE);
}

/// Then the alarm was not false.
#[test]
fn writes_wait_no_longer_after_the_connection_to_a_late_master_has_ended() {
    let mut late = Late::new();
    for _ in 0..10 {
        assert_eq!(late.late_after(), PATIENCE);
        late.ledger.shut_gate(State::Late);
        assert_eq!(late.reports(Input::Wake), []);
        let ended = Input::Ended(Err(Failure::MayHaveRun));
        assert_eq!(late.reports(ended), [Report::Lost]);
        late.ledger.settled();
        late.ledger.delivered();
        late.ledger.open_gate();
    }
}
