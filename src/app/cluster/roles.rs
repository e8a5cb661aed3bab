//! What changes when this computer begins to have the master, and when it no longer has it.

use std::time::Instant;

use super::{
    CutOff, Input, Member, Role, cut_off,
    merging::{self, Route},
};
use crate::{
    app::{RunError, life},
    checkpoint::session::{self, Decision, Evidence},
    cluster::{
        machine::{Leader, Session, Settings, WhenAlone},
        namesake,
        way::{Place, Way},
    },
    gate::State,
    ledger::{Change, Source},
    limit::{Pair, alarm, all_clear, rarely},
    master::Master,
    recovery::master_process::MasterProcess,
    ros_env::MasterUri,
    status::report::{CUT_OFF, STARTED, TAKEN_OVER},
};

/// Whether a change is not another computer's call, which is made elsewhere when it gets no answer here.
fn is_ours(change: &Change) -> bool {
    !matches!(change, Change::Call(_, Source::Forwarded))
}

/// How often the leader's rosrescue is asked within the time to live.
const PROBES: u32 = 4;

/// That this computer is cut off, and that it is not any more.
static ALONE: Pair = Pair::new();

impl Member {
    /// Whether this computer records its own calls: it leads, or it is alone and serves.
    pub(super) fn records(&self) -> bool {
        self.given.context.ledger.records_here()
    }

    /// Whether the ledger holds what the journal does.
    pub(super) fn follows(&self) -> bool {
        self.loaded && !self.ours && !self.records()
    }

    /// Whether the mirror's answers hold: its state is not that of a session which may be over.
    fn knows(&self) -> bool {
        self.given.restored || self.loaded && self.machine.session() == Session::GoesOn
    }

    /// Brings the ledger to the journal's state, if it follows it.
    pub(super) fn adopt_held(&mut self) {
        let ledger = &self.given.context.ledger;
        if self.follows() && ledger.with_mirror(|mirror| *mirror != self.held) {
            // Only if this computer has the master by now.
            let _ = ledger.follow_state(self.held.clone());
        }
    }

    pub(super) async fn become_role(&mut self, role: Role) {
        let before = self.known.set_role(role);
        if before == Role::Alone && role != Role::Alone {
            all_clear!(info, ALONE, role = role.as_str(), "not alone any more");
        }
        match role {
            Role::Leading => self.lead().await,
            Role::Alone => self.be_alone().await,
            Role::Joining | Role::Following | Role::CatchingUp => {
                if self.records() {
                    tracing::warn!(
                        "this computer does not lead any more; another one does, or may"
                    );
                }
                self.give_up_duty().await;
            }
        }
        self.background.say_now();
    }

    async fn lead(&mut self) {
        let term = self.machine.term().unwrap_or_default();
        if !self.records() {
            if matches!(self.machine.session(), Session::Over(_)) {
                let _ = self.given.context.ledger.follow_state(Master::default());
            }
            let cause = match self.known.taken_over(self.before.take(), self.was_released) {
                true => TAKEN_OVER,
                false => STARTED,
            };
            self.ours = false;
            let seq = self.machine.committed();
            self.outgoing.start(seq);
            let ledger = &self.given.context.ledger;
            ledger.lead(seq, &self.held);
            let displaced = self.displaced.at(Instant::now());
            ledger.with_activity(|_, activity| activity.restore_displaced(displaced));
            self.begin_duty(Some(self.given.rosout), cause);
        } else {
            tracing::warn!("this computer leads again: etcd has answered");
            self.given.context.nodes.set_alone(false);
            self.begin_duty(Some(self.given.rosout), CUT_OFF);
            self.cut_off = self.cut_off.take().and_then(CutOff::resumed);
            if self.cut_off.is_none() {
                cut_off::remove(&self.given.context.checkpoint).await;
            }
        }
        let ledger = &self.given.context.ledger;
        ledger.update_session(|session| session.term = term);
        self.set_way(Way::Here { term: Some(term) });
    }

    async fn be_alone(&mut self) {
        let serves = self.settings.alone == WhenAlone::Serve;
        let silent = self.trouble.is_silent(self.settings.ttl / 2);
        let why = match (&self.view.leader, self.trouble.get()) {
            (Some(leader), _) if !silent && leader.id != self.settings.id => {
                format!(
                    "{} leads, and cannot be reached at {}",
                    leader.name, leader.uri
                )
            }
            (_, Some((_, why))) => format!("etcd: {why}"),
            (_, None) => "etcd has answered too late".to_owned(),
        };
        alarm!(
            error,
            ALONE,
            why,
            serves,
            "ALONE: this computer is cut off from the others or from etcd's majority; with --alone serve its own \
             nodes are served and what they write is sent to the leader later, else writes wait. Repair the \
             network, or etcd"
        );
        if !serves {
            self.give_up_duty().await;
            return self.set_way(Way::Nobody { known: true });
        }
        let led = self.records();
        self.end_duty().await;
        let base = match led {
            true => self.held.clone(),
            false => self.given.context.ledger.with_mirror(Clone::clone),
        };
        // The nodes go on from what they wrote alone before.
        let base = match &self.cut_off {
            Some(cut_off) => cut_off.on(&base),
            None => base,
        };
        self.cut_off_in(base.clone()).await;
        self.given.context.nodes.set_alone(true);
        if let Some(cut_off) = &mut self.cut_off {
            if led {
                let answered = self.given.context.ledger.last_agreed();
                let changes = self.outgoing.changes();
                let kept = changes.filter(|change| change.seq() <= answered || is_ours(change));
                cut_off.add(kept, true).await;
            } else {
                cut_off.expect(self.forwarded.writes());
            }
        }
        if !led {
            let seq = self.machine.committed();
            self.outgoing.start(seq);
            let _ = self.given.context.ledger.follow_state(base.clone());
            self.given.context.ledger.lead(seq, &base);
        }
        self.given.context.gate_tx.set(State::StandingIn);
        self.set_way(Way::Here { term: None });
        self.outgoing.all_ready();
        self.inbox.push_back(Input::Recorded(self.outgoing.ready()));
    }

    /// What is answered from now on is kept for the leader. `base`: the present state.
    async fn cut_off_in(&mut self, base: Master) {
        match &mut self.cut_off {
            // It is not known yet what the others have: that is compared with the first time.
            Some(_) if !self.loaded => {}
            Some(cut_off) => cut_off.again(base),
            None => self.cut_off = Some(CutOff::new(&self.given.context.checkpoint, base).await),
        }
    }

    /// `rosout`: see [`Context::begin`](crate::app::duty::Context::begin).
    fn begin_duty(&mut self, rosout: Option<bool>, cause: &'static str) {
        let process = MasterProcess::new(self.given.rosmaster.clone(), None, None);
        self.duty = Some(self.given.context.begin(process, rosout, cause));
    }

    /// Has a master as long as the machine allows it.
    async fn tend_duty(&mut self) {
        let may = self.machine.may_have_master();
        if self.duty.is_some() && !may {
            tracing::warn!(
                "etcd is silent, and another computer may lead by now: this one's master is ended, and its mirror answers"
            );
            self.end_duty().await;
            self.given.context.gate_tx.set(State::StandingIn);
        } else if self.duty.is_none() && may && self.records() {
            self.begin_duty(Some(self.given.rosout), CUT_OFF);
        }
    }

    async fn end_duty(&mut self) {
        if let Some(duty) = self.duty.take() {
            let ending = duty.end().await;
            self.endings.spawn(ending);
        }
        self.given.context.ledger.end_injection();
    }

    /// Whatever is recorded or answered here from now on is not for the others.
    pub(super) async fn give_up_duty(&mut self) {
        let post = &self.given.context;
        post.ledger.leave();
        self.set_way(Way::Nobody {
            known: self.knows(),
        });
        self.end_duty().await;
        let post = &self.given.context;
        post.nodes.set_alone(false);
        post.gate_tx.set(match self.machine.role() {
            Role::Joining => State::Unknown,
            _ => State::Elsewhere,
        });
        self.adopt_held();
    }

    /// Calls of this computer after record `committed` are in no journal, and were answered up to
    /// `acknowledged`.
    pub(super) async fn give_back(&mut self, committed: u64, acknowledged: u64) {
        let lost: Vec<Change> = self.outgoing.take_all();
        if self.keeps() {
            return;
        }
        let answered = |of: &&Change| of.seq() > committed && of.seq() <= acknowledged;
        let answered: Vec<_> = lost.iter().filter(answered).collect();
        if !answered.is_empty() {
            self.cut_off_in(self.held.clone()).await;
            if let Some(cut_off) = &mut self.cut_off {
                cut_off.add(answered, true).await;
            }
        }
    }

    /// How many writes etcd does not have yet.
    pub(super) fn uncommitted(&self) -> usize {
        match &self.cut_off {
            Some(cut_off) if self.keeps() => cut_off.len(),
            _ => self.outgoing.len(),
        }
    }

    /// Whether what is answered now is kept for the leader.
    fn keeps(&self) -> bool {
        self.known.role() == Role::Alone && self.settings.alone == WhenAlone::Serve
    }

    /// A change is in the journal.
    pub(super) fn hold(&mut self, change: Change) {
        if change.seq() <= self.progress.seq {
            return;
        }
        match change {
            Change::Call(record, _) => {
                if let Ok(new) = self.progress.take(vec![record], 0) {
                    self.hold_records(&new);
                    if let Some(cut_off) = &mut self.cut_off {
                        cut_off.note(&new);
                    }
                }
            }
            Change::State { seq, state } => {
                if let Some(cut_off) = &mut self.cut_off {
                    cut_off.note_difference(Some(&self.held), &state);
                }
                self.held = *state;
                self.progress.take_state(seq, 0);
            }
        }
    }

    /// The ledger has changed.
    pub(super) async fn take_changes(&mut self) {
        let changes = self.given.context.ledger.take_changes();
        let is_alone = self.machine.role() == Role::Alone;
        if self.keeps()
            && let Some(cut_off) = &mut self.cut_off
        {
            let given = self.machine.term().is_some();
            cut_off
                .add(changes.iter().filter(|of| is_ours(of)), given)
                .await;
        }
        let leads_on = self.machine.term().is_some();
        self.outgoing.add(changes);
        if is_alone {
            self.outgoing.all_ready();
            match leads_on {
                // Nobody is given them: the leader gets what is kept.
                false => self.outgoing.forget(),
                true if self.outgoing.has_outgrown() => {
                    let rest = self.given.context.ledger.take_as_state();
                    self.outgoing.replace_rest(rest);
                    self.outgoing.all_ready();
                }
                true => {}
            }
            self.inbox.push_back(Input::Recorded(self.outgoing.ready()));
        } else {
            self.prepare();
        }
    }

    fn prepare(&mut self) {
        let Some(term) = self.machine.term().filter(|_| self.records()) else {
            return;
        };
        match self.outgoing.prepare(&self.replica.keys) {
            Ok(Some(parts)) => {
                let replica = self.replica.clone();
                self.outgoing.preparing = Some(Box::pin(async move {
                    match replica.prepare(term, &parts).await {
                        Ok(leads) => Some(leads),
                        Err(error) => {
                            rarely!(warn, %error, "a large write is not in etcd yet; retrying");
                            tokio::time::sleep(super::AGAIN).await;
                            None
                        }
                    }
                }));
            }
            Ok(None) => {}
            Err(error) => {
                rarely!(
                    error,
                    %error,
                    "a change of the state cannot be given to the other computers; they go on without it"
                );
                self.outgoing.leave_out_next();
                return self.prepare();
            }
        }
        self.inbox.push_back(Input::Recorded(self.outgoing.ready()));
    }

    pub(super) fn prepared(&mut self, leads: Option<bool>) {
        self.outgoing.preparing = None;
        if leads == Some(true) {
            self.outgoing.prepared();
        }
        // If another one leads, the keys show it.
        self.prepare();
    }

    /// Begins to find out whether the session in etcd continues, if the machine waits for that.
    pub(super) fn decide(&mut self) {
        let waits = self.machine.role() == Role::CatchingUp
            && self.machine.session() == Session::Unknown
            && self.deciding.is_none();
        if !waits {
            return;
        }
        let seq = self.progress.seq;
        if self.ours || seq == 0 {
            let goes_on = true;
            return self.inbox.push_back(Input::Decided { seq, goes_on });
        }
        let (restore, state) = (self.given.restore, self.held.clone());
        let evidence = Evidence {
            same_boot: self.given.restored,
            closed: self.was_released,
            node_alive: false,
        };
        self.deciding = Some(Box::pin(async move {
            let node_alive = session::depends_on_nodes(restore, evidence)
                && life::any_alive(&state, evidence.same_boot).await;
            let evidence = Evidence {
                node_alive,
                ..evidence
            };
            let goes_on = match session::decide(restore, evidence) {
                Decision::Restore(why) => {
                    tracing::info!(why, "the session in etcd continues: {}", state.counts());
                    true
                }
                Decision::Fresh(why) => {
                    tracing::info!(why, "a new session begins; the one in etcd is over");
                    false
                }
            };
            Input::Decided { seq, goes_on }
        }));
    }

    /// What follows from all that has happened.
    pub(super) async fn tend(&mut self) {
        let now = Instant::now();
        self.tend_duty().await;
        let role = self.machine.role();
        let seq = self.progress.seq;
        let leader = self.view.leader.as_ref();
        // The whole journal up to this leader's first record, at least.
        let whole = leader.filter(|_| self.loaded && seq >= self.view.seq());
        self.followed.send_if_modified(|now| {
            let term = whole.map_or(now.term, |leader| leader.term);
            let place = Place { term, seq };
            std::mem::replace(now, place) != place
        });
        self.look_for_namesake();
        let alive = self.view.alive.as_ref();
        let other = self
            .view
            .leader
            .as_ref()
            .filter(|leader| leader.id != self.settings.id);
        let released = alive.is_some_and(|alive| alive.released.is_some());
        if other.is_some() {
            self.was_released = released;
            self.before = self.known.before();
        }
        // An earlier process of this computer answers nobody any more, and its address is our own.
        let is_own = |of: &&Leader| of.name == self.settings.name && of.uri == self.settings.uri;
        let leader = other.filter(|of| !released && !is_own(of));
        let leader = leader.and_then(|of| Some((MasterUri::parse(&of.uri).ok()?, of.term)));
        if role == Role::Following {
            self.set_way(match leader.clone() {
                Some((uri, term)) => Way::Leader { uri, term },
                None => Way::Nobody {
                    known: self.knows(),
                },
            });
        }
        self.ask_leader(
            now,
            leader.filter(|_| matches!(role, Role::Following | Role::Alone)),
        );
        let settled = match role {
            Role::Following => self.wanted.is_none() && self.loaded,
            Role::Leading => self.records(),
            _ => false,
        };
        if settled
            && self.merging.is_none()
            && let Some(time) = self.cut_off.as_ref().and_then(CutOff::first)
        {
            let present = self.present();
            let hide = self.given.hide.clone();
            let route = Route {
                leads: self.leads.subscribe(),
                peers: self.peers.clone(),
                write_queue: self.given.context.write_queue.clone(),
            };
            self.merging = Some(Box::pin(async move {
                merging::send(time, present, route, &hide).await
            }));
        }
        self.work_beside(now);
        self.show();
    }

    /// Notices another living computer of this name, best before this one takes part.
    fn look_for_namesake(&mut self) {
        let now = Instant::now();
        let signs = self.signs_of_namesake();
        let living = self.namesakes.as_ref();
        let living = living.and_then(|watch| watch.living(now, &signs));
        if let Some(sign) = living {
            self.namesake = Some(sign.uri.clone());
            return;
        }
        let Some(leader) = &self.view.leader else {
            return;
        };
        // There is one process at a time on a computer, so that one is another computer's.
        if leader.id == self.settings.id {
            self.led = true;
        } else if self.led && leader.name == self.settings.name {
            self.namesake = Some(leader.uri.clone());
        }
    }

    /// What etcd shows of another computer with this one's name.
    pub(super) fn signs_of_namesake(&self) -> Vec<namesake::Sign> {
        let leader = namesake::sign_of_leader(&self.settings, &self.view);
        let member = self.known.namesake().cloned();
        leader.into_iter().chain(member).collect()
    }

    /// Why this computer does not take part.
    pub(super) fn namesake_at(&self, uri: String) -> RunError {
        let Settings { name, uri: own, .. } = &self.settings;
        let name = name.clone();
        match uri == *own {
            true => RunError::Double { name, uri },
            false => RunError::Namesake {
                name,
                uri,
                own: own.clone(),
            },
        }
    }

    /// Asks the leader's rosrescue whether it leads, now and then.
    fn ask_leader(&mut self, now: Instant, leader: Option<(MasterUri, u64)>) {
        let Some((uri, term)) = leader else {
            (self.probe, self.probe_at) = (None, None);
            return;
        };
        let pause = self.settings.ttl / PROBES;
        let at = *self.probe_at.get_or_insert(now);
        if self.probe.is_none() && at <= now {
            self.probe_at = Some(now + pause);
            let peer = self.peers.at(&uri);
            self.probe = Some(Box::pin(async move {
                let leads = tokio::time::timeout(pause, peer.leads(term)).await;
                leads.unwrap_or(false)
            }));
        }
    }

    /// The writes of a time alone have been sent; so many did not hold.
    pub(super) async fn merged(&mut self, lost: u64) {
        self.merging = None;
        self.known.lost_writes += lost;
        if let Some(cut_off) = self.cut_off.take() {
            self.cut_off = cut_off.sent().await;
        }
        if self.cut_off.is_none() {
            cut_off::remove(&self.given.context.checkpoint).await;
        }
        let leads = self.leads.borrow().clone();
        self.set_way(leads);
    }
}
