//! Calls that move a name to another address: the master shuts down whatever node listens at the old one.

use std::{collections::BTreeSet, sync::PoisonError, time::Instant};

use rescue_core::health::{Eviction, Evidence, Feud, Moving};
use ros1_master::master::{Master, Request};

use super::LocalNodes;
use crate::{ledger::Ledger, limit::rarely, write_queue::MoveJudge};

impl MoveJudge for LocalNodes {
    fn first_move(&self, mirror: &Master, calls: &[&Request]) -> Option<usize> {
        calls
            .iter()
            .position(|call| Moving::moves_any(mirror, call))
    }

    fn judge_move(&self, ledger: &Ledger, call: &Request) -> Option<Option<Eviction>> {
        let moving = ledger.with_mirror(|mirror| Moving::caused_by(mirror, call));
        if moving.is_empty() {
            return None;
        }
        let mut gone = BTreeSet::new();
        for moving in moving {
            let evidence = self.evidence_now(&moving);
            self.note_feud(&moving, evidence);
            let hits_another = moving.hits_another(evidence);
            if moving.is_unregistered_first(self.reap, evidence) {
                if hits_another {
                    self.stats.shutdowns_prevented.count();
                    log_prevented_shutdown(&moving);
                }
                gone.insert(moving.node);
            } else if hits_another {
                self.stats.shutdowns_misdirected.count();
                log_misdirected_shutdown(&moving);
            }
        }
        Some(ledger.with_mirror(|mirror| Eviction::for_nodes(mirror, gone)))
    }

    fn note_registration(&self) {
        self.registered.notify_one();
    }
}

impl LocalNodes {
    /// The feuds of this moment.
    pub(crate) fn feuds(&self) -> Vec<Feud> {
        let mut feuds = self.feuds.lock().unwrap_or_else(PoisonError::into_inner);
        feuds.list(Instant::now())
    }

    fn note_feud(&self, moving: &Moving, evidence: Evidence) {
        let lived = match evidence {
            Evidence::Listens => Some(true),
            Evidence::Ended(_) | Evidence::Replaced => Some(false),
            Evidence::Unknown => None,
        };
        let addresses = (moving.from.as_str(), moving.to.as_str());
        let mut feuds = self.feuds.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(feud) = feuds.displaced(&moving.node, addresses, lived, Instant::now()) {
            let Feud {
                node,
                from,
                to,
                times,
            } = feud;
            tracing::warn!(
                node,
                from,
                to,
                times,
                "two programs take a node name from each other, and the master shuts one down each time; stop one of them or give it another name (__name:=)"
            );
        }
    }
}

fn log_prevented_shutdown(moving: &Moving) {
    let Moving {
        node, from, others, ..
    } = moving;
    rarely!(
        info,
        node,
        from,
        ?others,
        "a node has moved, and another node uses its old port: unregistered the old node first, so that the master does not shut down the other one"
    );
}

fn log_misdirected_shutdown(moving: &Moving) {
    let Moving {
        node, from, others, ..
    } = moving;
    rarely!(
        warn,
        node,
        from,
        ?others,
        "the master shuts down the wrong node: a node has moved, and another one uses its old port. `--reap local` prevents this"
    );
}
