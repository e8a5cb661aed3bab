//! The deadlines of the machine, and what it does at them.

use std::time::{Duration, Instant};

use super::{
    ANSWER_LIMIT, Action, BEATS, COMMIT_INTERVAL, Commit, Flight, JournalSession, Leadership,
    Machine, Op, PATIENCE, RETRY, RevisionGuard, Role, Settings,
};

impl Machine {
    /// When to pass in [`Input::Wake`](super::Input::Wake). Changes with every input.
    pub fn deadline(&self) -> Option<Instant> {
        let under_way = self.flight.as_ref().is_some_and(|flight| !flight.silent);
        let send = self.send_at().filter(|_| !under_way);
        let flight = self.flight.as_ref().filter(|_| under_way);
        let given_up = flight.map(|flight| flight.sent + ANSWER_LIMIT + RETRY);
        [send, given_up, self.alone_at(), self.lapses_at()]
            .into_iter()
            .flatten()
            .min()
    }

    /// Carries out what is due at `now`: a change of this computer's role, or a request to etcd.
    pub(super) fn review(&mut self, now: Instant, actions: &mut Vec<Action>) {
        if self.role == Role::CatchingUp
            && self.has_caught_up()
            && self.session != JournalSession::Unknown
            && self.is_sole(now)
            && let Some(leadership) = &mut self.leadership
        {
            leadership.caught_up = true;
            self.follow_to(self.view.seq());
            self.become_role(Role::Leading, actions);
        }
        if self.lapses_at().is_some_and(|at| at <= now)
            && let Some(leadership) = &mut self.leadership
        {
            leadership.lapsed = true;
        }
        if self.alone_at().is_some_and(|at| at <= now) {
            self.become_role(Role::Alone, actions);
            self.acknowledge_early(now, actions);
        }
        let under_way = self.flight.as_ref().is_some_and(|flight| !flight.silent);
        if !under_way && self.send_at().is_some_and(|at| at <= now) {
            let flight = match self.flight.take() {
                Some(flight) => flight,
                None => self.next(now),
            };
            self.numbers += 1;
            self.retry_at = None;
            let (number, op) = (self.numbers, flight.op.clone());
            self.flight = Some(Flight {
                number,
                sent: now,
                silent: false,
                ..flight
            });
            actions.push(Action::Send { number, op });
        }
    }

    fn next(&mut self, now: Instant) -> Flight {
        let guard = self.view.guard();
        let op = match self.leadership {
            Some(leadership) => {
                let seq = match leadership.caught_up {
                    true => self.written.recorded,
                    false => self.view.seq(),
                };
                let whole = seq == self.written.committed && self.role == Role::Leading;
                Op::Beat {
                    guard,
                    claim: self.view.leader.as_ref().map_or(0, |of| of.claim),
                    claimed_at: self.view.leader.as_ref().map_or(0, |of| of.claimed_at),
                    beat: leadership.beat + 1,
                    seq,
                    released: self.releasing.clone().filter(|_| whole),
                    settled: self.session.settled_by(seq),
                }
            }
            None if self.must_read(now) => Op::Read,
            None => {
                self.claims += 1;
                let claim = self.claims;
                let begins = self.begins_journal().then_some(self.journal_number + 1);
                let seq = if begins.is_some() { 0 } else { self.view.seq() };
                // The last entry of a journal that is to be replaced may be gone.
                let guard = RevisionGuard { seq, ..guard };
                Op::Claim {
                    guard,
                    claim,
                    begins,
                    seq,
                    settled: self.session.settled_by(seq),
                }
            }
        };
        Flight {
            number: 0,
            op,
            first: now,
            sent: now,
            silent: false,
        }
    }

    /// When the next request to etcd is due, unless one is under way.
    fn send_at(&self) -> Option<Instant> {
        let due = match self.leadership {
            Some(leadership) => self.beat_at(leadership)?,
            None if self.heard_before_pause.is_some() => self.resumed?,
            None => match (self.vacant_at(), self.heard) {
                // While the claim is held back, reads show whether etcd loses data.
                (Some(vacant), Some(heard)) => {
                    let read = heard + self.settings.ttl / 2;
                    self.claim_at()?.min(read.max(vacant))
                }
                _ => self.started?,
            },
        };
        Some(self.retry_at.map_or(due, |at| at.max(due)))
    }

    /// When this computer claims leadership, unless the keys `leader` and `alive` change before. `None` before etcd has
    /// answered.
    fn claim_at(&self) -> Option<Instant> {
        let vacant = self.vacant_at()?;
        Some(self.claim_not_before.map_or(vacant, |at| at.max(vacant)))
    }

    /// Whether etcd must be read before this computer claims leadership.
    fn must_read(&self, now: Instant) -> bool {
        let is_early = self.claim_at().is_none_or(|at| now < at);
        is_early || self.heard_before_pause.is_some() || self.is_cut_off_from_etcd(now)
    }

    fn vacant_at(&self) -> Option<Instant> {
        Some(self.observed? + self.vacant_after())
    }

    fn beat_at(&self, leadership: Leadership) -> Option<Instant> {
        let Some(sent) = leadership.sent.filter(|_| self.releasing.is_none()) else {
            return self.observed;
        };
        let pause = self.settings.ttl / BEATS;
        let waiting = leadership.caught_up && self.written.recorded > self.written.committed;
        Some(match self.settings.commit {
            Commit::Always if waiting => sent,
            Commit::Interval if leadership.full => sent,
            Commit::Interval if waiting => sent + COMMIT_INTERVAL.min(pause),
            _ => sent + pause,
        })
    }

    /// How long after the keys `leader` and `alive` were first seen with their present values this computer may claim
    /// leadership.
    fn vacant_after(&self) -> Duration {
        let own = &self.settings;
        let Settings { name, id, ttl, .. } = own;
        let Some(leader) = &self.view.leader else {
            return Duration::ZERO;
        };
        let released = self
            .view
            .alive
            .as_ref()
            .and_then(|alive| alive.released.as_ref());
        match released {
            // This process has just given up leadership.
            _ if leader.id == *id => *ttl,
            Some(to) if to.is_empty() || to == name => Duration::ZERO,
            Some(_) => *ttl / BEATS,
            // The leader is an earlier process of this computer. It is dead, because only one runs at a time.
            None if own.is_of_this_computer(&leader.name, &leader.uri, &leader.boot) => {
                Duration::ZERO
            }
            None => *ttl,
        }
    }

    /// When this computer counts as cut off, unless etcd or the leader answers before.
    fn alone_at(&self) -> Option<Instant> {
        let patience = self.settings.ttl + PATIENCE;
        let silent = self.heard.or(self.started)? + patience;
        let at = match self.role {
            Role::Joining | Role::CatchingUp => Some(silent),
            Role::Following => match self.peer {
                Some((true, _)) => None,
                Some((false, since)) => Some(silent.min(since + patience)),
                None => Some(silent),
            },
            // Before this time, only committed writes are acknowledged, unless no other computer can lead.
            Role::Leading => Some(self.leadership?.sent? + patience),
            Role::Alone => None,
        };
        // After a pause of this process, etcd is asked first what has happened meanwhile.
        Some(at?.max(self.resumed.map_or(at?, |resumed| resumed + PATIENCE)))
    }
}
