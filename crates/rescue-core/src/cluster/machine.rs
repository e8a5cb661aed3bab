//! Decides who leads, what may be acknowledged, and when this computer is cut off.
//!
//! A state machine without IO, like [`crate::lifecycle`]: the [`member`](crate::cluster::member) passes in what
//! happened and when, and carries out the returned actions. All deadlines are decided here. Each computer uses its own
//! clock, and only to measure durations. Clocks may differ, and may run up to a tenth too fast or too slow.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use crate::cluster::mutant::Mutant;

mod due;
mod flight;
mod session;
mod types;

use self::flight::{Flight, Leadership};
pub use self::session::JournalSession;
pub use types::{
    Action, Alive, Commit, EtcdAnswer, Input, Leader, Op, RevisionGuard, Role, Settings, View,
    WhenAlone,
};

/// How long a request may take before it counts as [`EtcdAnswer::Silence`]. It is longer than a time to live, because an
/// etcd that needs 2 s per answer still shows who leads.
pub const ANSWER_LIMIT: Duration = Duration::from_secs(5);
/// Pause before an unanswered request is sent again.
const RETRY: Duration = Duration::from_millis(100);
/// How often the leader writes the key `alive` per time to live ([`Settings::ttl`]).
const BEATS: u32 = 4;
/// Divisor of the time to live: a leader stops a fifth of it before another computer may begin to lead. A tenth is for
/// a slow clock, and a tenth for a fast one.
const MARGIN: u32 = 5;
/// How long after the time to live a computer waits for the next leader before it counts as cut off. A claim takes
/// three network delays, but etcd may have to elect its own leader first, which takes up to 2.6 s.
const PATIENCE: Duration = Duration::from_millis(1500);
/// How long an acknowledged write may be uncommitted with [`Commit::Interval`].
const COMMIT_INTERVAL: Duration = Duration::from_millis(200);

/// Numbers of this computer's last records.
#[derive(Clone, Copy, Debug, Default)]
struct Written {
    /// In its ledger.
    recorded: u64,
    /// Known to be in the journal.
    committed: u64,
    /// Acknowledged to callers.
    acknowledged: u64,
}

/// Decides who leads. See the [module](self).
#[derive(Debug)]
pub struct Machine {
    settings: Settings,
    role: Role,
    view: View,
    started: Option<Instant>,
    /// When this process continued after a pause.
    resumed: Option<Instant>,
    /// When `view` was first seen. A view with another revision and the same keys counts as the same.
    observed: Option<Instant>,
    /// When etcd last answered.
    heard: Option<Instant>,
    /// When etcd had answered last before this process paused, until a request that was sent later is answered. What arrives
    /// first after a pause may be old.
    heard_before_pause: Option<Instant>,
    leadership: Option<Leadership>,
    flight: Option<Flight>,
    retry_at: Option<Instant>,
    numbers: u64,
    claims: u64,
    /// The last record of the journal that the mirror contains.
    followed: u64,
    /// Whether the mirror must be rebuilt from the journal.
    stale: bool,
    session: JournalSession,
    written: Written,
    /// Whether the leader's rosrescue answers, and since when.
    peer: Option<(bool, Instant)>,
    releasing: Option<String>,
    claim_not_before: Option<Instant>,
    /// What etcd showed when it had lost data. Unless that changes, this computer's next claim begins a new journal.
    left: Option<RevisionGuard>,
    /// The origin of a journal that cannot be read from its beginning, or 0. This computer's claim replaces it.
    unreadable: u64,
    /// The highest [`View::journal_number`] that this computer has heard of.
    journal_number: u64,
    /// The terms in which this computer has led, as far as it knows, with the claim of this process that began each, or 0.
    terms: BTreeMap<u64, u64>,
}

impl Machine {
    /// Creates a machine that does nothing until [`Input::Start`].
    pub fn new(settings: Settings) -> Self {
        Self {
            settings,
            role: Role::Joining,
            view: View::default(),
            started: None,
            resumed: None,
            observed: None,
            heard: None,
            heard_before_pause: None,
            leadership: None,
            flight: None,
            retry_at: None,
            numbers: 0,
            claims: 0,
            followed: 0,
            stale: false,
            session: JournalSession::default(),
            written: Written::default(),
            peer: None,
            releasing: None,
            claim_not_before: None,
            left: None,
            unreadable: 0,
            journal_number: 0,
            terms: BTreeMap::new(),
        }
    }

    pub fn role(&self) -> Role {
        self.role
    }

    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// When the keys `leader` and `alive` were first seen with their present values.
    pub fn observed(&self) -> Option<Instant> {
        self.observed
    }

    /// When etcd last answered.
    pub fn answered_at(&self) -> Option<Instant> {
        self.heard
    }

    /// The keys `leader` and `alive` as this computer knows them.
    pub fn view(&self) -> &View {
        &self.view
    }

    /// What is known about the journal's session.
    pub fn session(&self) -> JournalSession {
        self.session
    }

    /// The term in which this process leads, if it does.
    pub fn term(&self) -> Option<u64> {
        self.leadership.map(|leadership| leadership.term)
    }

    /// Whether recorded changes go to the journal: this process leads, and had read the whole journal before its first
    /// change.
    pub fn writes_journal(&self) -> bool {
        self.leadership.is_some_and(|of| of.caught_up)
    }

    /// The last record of this computer that is known to be in the journal.
    pub fn committed(&self) -> u64 {
        self.written.committed
    }

    /// Whether no other computer can lead at `now`.
    pub fn is_sole(&self, now: Instant) -> bool {
        self.sole_until().is_some_and(|until| now < until)
    }

    /// Until when this computer may act as the leader without asking etcd again. In the past if it may not. `None`
    /// while it is cut off and serves, because it does not claim to lead then.
    pub fn lease(&self, now: Instant) -> Option<Instant> {
        match self.role {
            _ if Mutant::ActsWithoutLease.lives() => None,
            Role::Alone if self.settings.alone == WhenAlone::Serve => None,
            Role::Leading => Some(self.sole_until().unwrap_or(now)),
            _ => Some(now),
        }
    }

    /// Whether this computer may run a master: only while no other computer can lead. While it is cut off, its mirror
    /// answers instead. A master would notify the other computers' nodes of its own state as soon as the network is
    /// back.
    pub fn may_have_master(&self) -> bool {
        let unsafely = match self.role {
            Role::Leading => Mutant::ActsWithoutLease.lives(),
            Role::Alone => Mutant::MasterWhileAlone.lives(),
            _ => false,
        };
        unsafely || self.role == Role::Leading && self.lapses_at().is_some()
    }

    /// The earliest time at which another computer can lead. `None` if one already can.
    fn lapses_at(&self) -> Option<Instant> {
        let leadership = self.leadership.filter(|leadership| !leadership.lapsed)?;
        Some(leadership.sent? + self.settings.ttl)
    }

    fn sole_until(&self) -> Option<Instant> {
        let ttl = self.settings.ttl;
        Some(self.leadership?.sent? + ttl - ttl / MARGIN)
    }

    /// Whether request `number` has a condition, and the keys in `view` meet it, as far as they show.
    pub fn expects(&self, number: u64, view: &View) -> bool {
        let flight = self.flight.as_ref();
        match flight
            .filter(|flight| flight.number == number)
            .map(|of| &of.op)
        {
            Some(Op::Claim { guard, begins, .. }) => {
                // A claim that begins a journal does not require the last entry of the one before.
                let shown = RevisionGuard {
                    seq: guard.seq,
                    ..view.guard()
                };
                (guard.seq > 0 || begins.is_some()) && shown == *guard
            }
            Some(Op::Beat { guard, claim, .. }) => {
                let leader = view.leader.as_ref();
                let leads =
                    leader.is_some_and(|of| (&of.id, of.claim) == (&self.settings.id, *claim));
                guard.seq > 0 && view.guard() == *guard && leads
            }
            Some(Op::Read) | None => false,
        }
    }

    /// Handles `input` at `now`, and returns the actions to carry out, in order.
    pub fn on(&mut self, now: Instant, input: Input) -> Vec<Action> {
        let mut actions = Vec::new();
        if self.started.is_none() && input != Input::Start {
            if let Input::Lost { left, .. } = &input {
                self.left = *left;
            }
            return actions;
        }
        self.give_up_request(now);
        if self
            .deadline()
            .is_some_and(|due| due + self.settings.ttl / BEATS < now)
        {
            self.resumed = Some(now);
            self.heard_before_pause = self.heard_before_pause.or(self.heard);
        }
        match input {
            Input::Start => self.started = Some(now),
            Input::Answer { number, answer } => self.answered(now, number, answer, &mut actions),
            Input::View(view) => self.see(now, view, &mut actions),
            Input::Followed(seq) => self.followed(seq),
            Input::Decided { seq, goes_on } => self.session.decided(seq, goes_on),
            Input::Recorded(seq) => {
                self.written.recorded = self.written.recorded.max(seq);
                self.acknowledge_early(now, &mut actions);
            }
            Input::Peer(leads) => self.peer(now, leads, &mut actions),
            Input::Lost { view, left, until } => {
                self.left = left;
                self.start_over(now, view, until, &mut actions);
            }
            Input::HandOver(to) => {
                self.releasing = Some(to).filter(|_| self.role == Role::Leading);
            }
            Input::Wake => {}
        }
        self.review(now, &mut actions);
        actions
    }

    /// Counts a request that never ends as unanswered.
    fn give_up_request(&mut self, now: Instant) {
        let lost = self.flight.as_ref().filter(|flight| !flight.silent);
        let lost = lost.filter(|flight| flight.sent + ANSWER_LIMIT + RETRY <= now);
        if let Some(number) = lost.map(|flight| flight.number)
            && !Mutant::WaitsForEver.lives()
        {
            self.answered(now, number, EtcdAnswer::Silence, &mut Vec::new());
        }
    }

    fn answered(
        &mut self,
        now: Instant,
        number: u64,
        answer: EtcdAnswer,
        actions: &mut Vec<Action>,
    ) {
        let Some(flight) = self.flight.take_if(|flight| flight.number == number) else {
            return;
        };
        let view = match answer {
            EtcdAnswer::Silence => {
                self.retry_at = Some(now + RETRY);
                // The effect of a heartbeat is unknown, so it is sent again. The keys show whether a claim succeeded.
                self.flight = matches!(flight.op, Op::Beat { .. }).then_some(Flight {
                    silent: true,
                    ..flight
                });
                return;
            }
            EtcdAnswer::Is(view) => view,
            EtcdAnswer::Applied { revision, seq } => self.after(&flight.op, revision, seq),
        };
        self.retry_at = None;
        let is_new = Some(flight.sent) >= self.resumed;
        self.flight = Some(flight);
        self.see(now, view, actions);
        self.heard_before_pause.take_if(|_| is_new);
        self.flight.take_if(|flight| flight.number == number);
    }

    /// The keys `leader` and `alive` after `op` has succeeded.
    fn after(&self, op: &Op, revision: u64, seq: u64) -> View {
        let (mut origin, mut journal_number) = (self.view.origin, self.view.journal_number);
        let (leader, beat, released, settled) = match op {
            Op::Read => return self.view.clone(),
            Op::Claim {
                claim,
                seq,
                settled,
                begins,
                ..
            } => {
                if let Some(begun) = begins {
                    (origin, journal_number) = (revision, *begun);
                }
                let Settings {
                    name,
                    id,
                    uri,
                    boot,
                    version,
                    ..
                } = self.settings.clone();
                let leader = Leader {
                    term: revision,
                    name,
                    id,
                    claim: *claim,
                    claimed_at: *seq,
                    uri,
                    boot,
                    version,
                };
                (Some(leader), 0, None, *settled)
            }
            Op::Beat {
                beat,
                released,
                settled,
                ..
            } => {
                let leader = self.view.leader.clone();
                (leader, *beat, released.clone(), *settled)
            }
        };
        let alive = Alive {
            revision,
            beat,
            seq,
            released,
            settled,
        };
        View {
            revision,
            origin,
            journal_number,
            leader,
            alive: Some(alive),
        }
    }

    /// Starts over with the keys in `view`, because etcd has lost its data.
    fn start_over(&mut self, now: Instant, view: View, until: Instant, actions: &mut Vec<Action>) {
        self.flight = None;
        self.deposed(actions);
        // A claim in an old snapshot is not this process's claim.
        self.settings.id.push('+');
        (self.observed, self.heard) = (Some(now), Some(now));
        (self.peer, self.retry_at) = (None, None);
        self.session = JournalSession::GoesOn;
        self.claim_not_before = Some(until);
        self.note_journal(view.journal_number);
        self.view = view;
        self.follow_to(0);
        self.stale = false;
        actions.push(Action::CatchUp(self.last()));
    }

    /// Makes this computer claim leadership no earlier than `until`.
    pub fn hold_claims(&mut self, until: Instant) {
        self.claim_not_before = self.claim_not_before.max(Some(until));
    }

    /// Notes that a journal with this number has existed.
    pub fn note_journal(&mut self, journal_number: u64) {
        self.journal_number = self.journal_number.max(journal_number);
    }

    /// Notes that an earlier process of this computer may have led in this term.
    pub fn note_term(&mut self, term: u64) {
        self.terms.entry(term).or_default();
    }

    /// Notes the origin of a journal that cannot be read from its beginning, or 0.
    pub fn set_unreadable(&mut self, origin: u64) {
        self.unreadable = origin;
    }

    /// Whether this computer's claim begins a new journal: there is none, or nobody can continue it.
    fn begins_journal(&self) -> bool {
        let guard = self.view.guard();
        let is_left = self.left == Some(guard) || self.view.is_torn();
        is_left || [0, self.unreadable].contains(&guard.origin)
    }

    /// The last record to read. What is left of a lost journal is not read.
    fn last(&self) -> u64 {
        match self.begins_journal() {
            true => 0,
            false => self.view.seq(),
        }
    }

    /// Whether etcd has been silent for so long that this computer must read it before it claims: if an older copy is
    /// restored meanwhile, etcd shows the leader that this computer knew. Twice the time to live, because a claim
    /// follows one time to live after the last answer; or once, if this process has paused.
    fn is_cut_off_from_etcd(&self, now: Instant) -> bool {
        let Settings { ttl, .. } = self.settings;
        let is_long = |at: Option<Instant>, limit| at.is_some_and(|at| at + limit <= now);
        is_long(self.heard, 2 * ttl) || is_long(self.heard_before_pause, ttl)
    }

    /// Handles the keys `leader` and `alive` as etcd shows them.
    fn see(&mut self, now: Instant, view: View, actions: &mut Vec<Action>) {
        let Settings { ttl, .. } = self.settings;
        let was_silent = self.heard.is_some_and(|at| at + ttl <= now);
        let first = self.observed.is_none();
        // The keys of an etcd that is not new may have been deleted.
        let is_bare = view.leader.is_none() && view.revision > 1;
        if is_bare && (first || was_silent) || self.is_cut_off_from_etcd(now) {
            // Others may have led meanwhile, and etcd may have lost their journal. They say so now.
            self.hold_claims(now + ttl);
        }
        self.heard = Some(now);
        if view.revision < self.view.revision {
            return;
        }
        let changed = view.guard() != self.view.guard();
        if first || changed {
            self.observed = Some(now);
        }
        let other = view.leader.as_ref();
        let other = other.is_some_and(|leader| leader.id != self.settings.id);
        if let Some(alive) = &view.alive {
            self.session.see(alive, other && changed && !first);
        }
        if view.guard().leader != self.view.guard().leader {
            // Nothing is known yet about the next leader's rosrescue.
            self.peer = None;
        }
        self.note_journal(view.journal_number);
        self.view = view;
        let leader = self.view.leader.as_ref();
        let mine = leader.filter(|leader| leader.id == self.settings.id);
        // A journal that has lost one of its keys cannot go on.
        let mine = mine.filter(|_| !self.view.is_torn());
        let mine = mine.map(|leader| leader.term);
        let alive = self.view.alive.as_ref();
        match (self.leadership, mine) {
            (Some(leadership), Some(term)) if leadership.term == term => {
                let beat = alive.map_or(0, |alive| alive.beat);
                if let Some(flight) = self.flight.take_if(|flight| flight.is_beat(beat)) {
                    self.beaten(now, leadership, &flight, actions);
                }
            }
            (Some(_), _) => self.deposed(actions),
            (None, Some(term)) if alive.is_some_and(|alive| alive.released.is_none()) => {
                let claim = leader.map_or(0, |leader| leader.claim);
                match *self.terms.entry(term).or_insert(claim) == claim {
                    true => self.claimed(term, actions),
                    // A restored etcd has given this term out again, and others may take it for the earlier one. The
                    // next claim gets another term, and is made at once.
                    false => self.settings.id.push('+'),
                }
            }
            (None, _) if self.role == Role::Joining && self.view.leader.is_some() => {
                self.become_role(Role::Following, actions);
                actions.push(Action::CatchUp(self.last()));
            }
            (None, _) => {}
        }
    }

    /// Handles the success of the heartbeat in `flight`.
    fn beaten(
        &mut self,
        now: Instant,
        leadership: Leadership,
        flight: &Flight,
        actions: &mut Vec<Action>,
    ) {
        let Op::Beat {
            beat,
            released,
            seq,
            ..
        } = &flight.op
        else {
            return;
        };
        self.retry_at = None;
        if leadership.caught_up {
            self.written.committed = self.view.seq();
        }
        if released.is_some() {
            // After a release, another computer may lead.
            self.deposed(actions);
            actions.push(Action::Released);
            return;
        }
        self.leadership = Some(Leadership {
            sent: Some(flight.first),
            beat: *beat,
            full: *seq > self.view.seq(),
            lapsed: false,
            ..leadership
        });
        let upto = self.written.committed;
        self.acknowledge(upto, actions);
        if self.role == Role::Alone && self.is_sole(now) {
            match leadership.caught_up {
                true => {
                    if self.settings.alone == WhenAlone::Refuse {
                        // The ledger has stopped recording, and starts again after the journal's last record.
                        self.hand_back(actions);
                        self.stale = false;
                    }
                    self.become_role(Role::Leading, actions);
                }
                false => self.catch_up(actions),
            }
        }
    }

    /// Handles the success of this process's claim.
    fn claimed(&mut self, term: u64, actions: &mut Vec<Action>) {
        let flight = self.flight.take();
        let claim = self.view.leader.as_ref().map_or(0, |leader| leader.claim);
        let sent = flight.filter(|flight| flight.is_claim(claim));
        self.leadership = Some(Leadership {
            term,
            sent: sent.map(|flight| flight.first),
            beat: 0,
            caught_up: false,
            full: false,
            lapsed: false,
        });
        self.catch_up(actions);
    }

    fn catch_up(&mut self, actions: &mut Vec<Action>) {
        if self.role == Role::Alone {
            self.hand_back(actions);
        }
        self.become_role(Role::CatchingUp, actions);
        if !self.has_caught_up() {
            actions.push(Action::CatchUp(self.view.seq()));
        }
    }

    fn has_caught_up(&self) -> bool {
        !self.stale && self.followed >= self.view.seq()
    }

    /// Stops leading, because another computer leads or could lead.
    fn deposed(&mut self, actions: &mut Vec<Action>) {
        (self.leadership, self.releasing) = (None, None);
        self.flight.take_if(|flight| flight.op != Op::Read);
        self.step_down(actions);
    }

    fn step_down(&mut self, actions: &mut Vec<Action>) {
        match self.role {
            Role::Leading | Role::Alone => self.hand_back(actions),
            _ => {}
        }
        self.become_role(Role::Following, actions);
        actions.push(Action::CatchUp(self.last()));
    }

    /// Has the member keep this computer's calls that are not in the journal.
    fn hand_back(&mut self, actions: &mut Vec<Action>) {
        let Written {
            recorded,
            committed,
            acknowledged,
        } = self.written;
        if recorded > committed {
            actions.push(Action::HandBack {
                committed,
                acknowledged,
            });
            self.stale = true;
        }
        self.follow_to(committed);
    }

    fn follow_to(&mut self, seq: u64) {
        self.followed = seq;
        self.written = Written {
            recorded: seq,
            committed: seq,
            acknowledged: seq,
        };
    }

    fn followed(&mut self, seq: u64) {
        match self.role {
            Role::Leading | Role::Alone => return,
            _ => self.follow_to(seq),
        }
        self.stale = false;
    }

    fn peer(&mut self, now: Instant, leads: bool, actions: &mut Vec<Action>) {
        if self.peer.is_none_or(|(before, _)| before != leads) {
            self.peer = Some((leads, now));
        }
        if leads && matches!(self.role, Role::Alone | Role::Joining) {
            self.deposed(actions);
        }
    }

    fn acknowledge_early(&mut self, now: Instant, actions: &mut Vec<Action>) {
        let may = match self.role {
            // Once it gives up leadership, another computer may lead at any moment.
            Role::Leading => {
                let stays = self.releasing.is_none();
                stays && self.settings.commit == Commit::Interval && self.is_sole(now)
            }
            Role::Alone => self.settings.alone == WhenAlone::Serve,
            _ => false,
        };
        if may {
            self.acknowledge(self.written.recorded, actions);
        }
    }

    fn acknowledge(&mut self, seq: u64, actions: &mut Vec<Action>) {
        if seq > self.written.acknowledged {
            self.written.acknowledged = seq;
            actions.push(Action::Acknowledge(seq));
        }
    }

    fn become_role(&mut self, role: Role, actions: &mut Vec<Action>) {
        if self.role != role {
            self.role = role;
            actions.push(Action::Become(role));
        }
    }
}

#[cfg(test)]
mod tests;
