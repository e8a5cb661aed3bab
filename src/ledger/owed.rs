//! The notifications that a lost master may not have sent.

use std::time::{Duration, Instant};

use rescue_core::{health::port_of, order::Subject};
use ros1_master::master::Displaced;

use super::{Ledger, activity::Owed};
use crate::{ledger::mutant::Mutant, status::report::RecoveryOutcome};

/// How long a master that lives may still send old notifications after it has answered again, if nothing is known of its
/// backlog.
pub(crate) const BACKLOG: Duration = Duration::from_secs(1);

/// When nodes get the notifications that they may lack.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Telling {
    /// Now. The master that may not have sent them is dead.
    Now,
    /// Now, and once more after [`BACKLOG`]. The master that may not have sent them lives, or was just killed, or an earlier
    /// rosrescue was sending some, so nodes may read older notifications after these.
    Twice,
    /// After [`BACKLOG`]. A living master is probably sending them.
    Later,
}

impl Telling {
    /// When nodes get the notifications that they may lack after a recovery with this outcome. `None` if they lack none,
    /// because the same master has gone on. `may_be_late` says whether notifications of an earlier rosrescue of this
    /// session, or of a living master that was killed, may still arrive.
    pub(crate) fn after(outcome: RecoveryOutcome, may_be_late: bool) -> Option<Self> {
        match outcome {
            RecoveryOutcome::Resumed => None,
            // This master notifies nodes itself, but the previous rosrescue may have died while it stood in for another
            // master.
            RecoveryOutcome::Adopted => Some(Self::Later),
            // The master may send outdated notifications now.
            RecoveryOutcome::Reconciled => Some(Self::Twice),
            RecoveryOutcome::Begun | RecoveryOutcome::Injected => {
                let is_late = may_be_late && !Mutant::ForgetsLastProcess.lives();
                Some(if is_late { Self::Twice } else { Self::Now })
            }
        }
    }
}

/// The notifications that have been queued.
#[derive(Debug, Default)]
pub(crate) struct Queued {
    /// The topics of which subscribers are notified.
    pub(crate) topics: Vec<String>,
    /// Nodes that must shut down, because the lost master may have died before it asked them to.
    pub(crate) displaced: Vec<Displaced>,
}

impl Ledger {
    /// Notes until when notifications of an earlier process may still arrive; see [`Order::expect_earlier`](rescue_core::order::Order::expect_earlier).
    pub(crate) fn expect_earlier(&self, until: Instant) {
        if !Mutant::ForgetsLastProcess.lives() {
            self.with_order(|order, _| order.expect_earlier(until));
        }
    }

    /// Queues the state of each topic and parameter whose notifications may not have been sent by the master that was
    /// lost at `outage`.
    pub(crate) fn queue_owed(&self, now: Instant, outage: Instant, telling: Telling) -> Queued {
        let Owed {
            mut topics,
            params,
            displaced,
        } = self.with_activity(|_, activity| {
            if telling == Telling::Twice {
                activity.notify_again();
            }
            activity.take_owed(outage)
        });
        if Mutant::OwesNothing.lives() {
            return Queued::default();
        }
        self.with_order(|order, mirror| {
            let mut tell = |api: &str, subject: Subject| {
                if telling != Telling::Later {
                    order.notify_of_state(port_of(api), subject.clone());
                }
                let is_once = telling == Telling::Now || Mutant::TellsOnce.lives();
                if !is_once {
                    order.notify_of_state_at(now + BACKLOG, port_of(api), subject);
                }
            };
            topics.retain(|topic| {
                let subscribers = mirror.subscribers_of(topic);
                for api in &subscribers {
                    tell(api, Subject::Topic(topic.clone()));
                }
                !subscribers.is_empty()
            });
            for (api, key) in params {
                tell(&api, Subject::Param(key.to_string()));
            }
        });
        Queued { topics, displaced }
    }
}
