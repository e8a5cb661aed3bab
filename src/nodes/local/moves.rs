//! Calls that move a name to another address: the master shuts down whatever node listens at the old one.
//!
//! With `--reap report`, such a call does not wait until the kernel's sockets are read: [`LocalNodes::report_moves`]
//! reads them at the same time. A node that ends within that millisecond counts as ended.

use std::{
    collections::BTreeSet,
    sync::{MutexGuard, PoisonError},
    time::Instant,
};

use rescue_core::health::{Eviction, Evidence, Feud, Moving, Reap};
use ros1_master::master::{Master, Request};

use super::LocalNodes;
use crate::{ledger::Ledger, limit::rarely, write_queue::MoveJudge};

/// Maximum number of moved names that wait for their report. Reading the evidence of one takes some hundred
/// microseconds, and only a multicall of a hostile client moves more.
const UNREPORTED_MAX: usize = 64;

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
        if self.reap == Reap::Report {
            let mut unreported = self.lock_unreported();
            let room = UNREPORTED_MAX.saturating_sub(unreported.len());
            unreported.extend(moving.into_iter().take(room));
            drop(unreported);
            self.moved.notify_one();
            return Some(None);
        }
        let gone: BTreeSet<_> = moving
            .into_iter()
            .filter(|moving| self.judge_old_node(moving))
            .map(|moving| moving.node)
            .collect();
        Some(ledger.with_mirror(|mirror| Eviction::for_nodes(mirror, gone)))
    }

    fn note_registration(&self) {
        self.registered.notify_one();
    }
}

impl LocalNodes {
    /// Reports the moves that no call has waited for. Must precede [`Self::update`] with names that were read after such
    /// a move, because the update forgets what was known of the old address. Blocks for less than a millisecond if there
    /// are any.
    pub(in crate::nodes) fn report_moves(&self) {
        let moves = std::mem::take(&mut *self.lock_unreported());
        for moving in moves {
            self.judge_old_node(&moving);
        }
    }

    fn lock_unreported(&self) -> MutexGuard<'_, Vec<Moving>> {
        self.unreported
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    /// Reads what the kernel shows about the node at the old address, and reports it. Returns whether that node must be
    /// unregistered before the call.
    fn judge_old_node(&self, moving: &Moving) -> bool {
        let evidence = self.evidence_now(moving);
        self.note_feud(moving, evidence);
        let is_first = moving.is_unregistered_first(self.reap, evidence);
        if moving.hits_another(evidence) {
            match is_first {
                true => {
                    self.stats.shutdowns_prevented.count();
                    log_prevented_shutdown(moving);
                }
                false => {
                    self.stats.shutdowns_misdirected.count();
                    log_misdirected_shutdown(moving);
                }
            }
        }
        is_first
    }

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
