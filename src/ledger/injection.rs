//! Steps from an examined master to an open gate.

use super::{Basis, Ledger};
use crate::{master::Master, replay::Token};

impl Ledger {
    /// Freezes the mirror until [`Self::end_injection`]. Returns what the injection is planned from.
    pub fn begin_injection(&self) -> Basis {
        let mut inner = self.lock();
        inner.injecting = true;
        Basis {
            mirror: inner.mirror.clone(),
            version: inner.version,
            pending: inner.pending.calls().to_vec(),
        }
    }

    /// Sets whether the dictionaries of the present master have no order, as in Python 2.
    pub fn set_unordered(&self, unordered: bool) {
        self.lock().mirror.set_unordered(unordered);
    }

    /// Sets whether the present master behaves as 1.14.3 and before.
    pub fn set_old(&self, old: Option<bool>) {
        self.lock().mirror.set_old(old);
    }

    /// The mirror's version and state, and the next incarnation's token.
    pub fn next(&self) -> (u64, Master, Token) {
        let inner = self.lock();
        let token = Token::new(&inner.session.mark, inner.session.incarnation + 1);
        (inner.version, inner.mirror.clone(), token)
    }

    /// The checkpoint is older than the master, which is incarnation `number`. The pending writes of the
    /// checkpoint have reached a master since.
    pub fn catch_up(&self, number: u64) {
        let mut inner = self.lock();
        inner.pending.forget_restored();
        inner.session.incarnation = number;
        inner.session_unwritten = true;
    }

    /// Starts the next incarnation: replies of the previous one no longer count. Returns the new token.
    ///
    /// The journal has the new number when the master has it. A rosrescue that is started in between finds a
    /// master of a later number, or one that misses the pending writes.
    pub fn succeed(&self) -> Token {
        let mut inner = self.lock();
        inner.raise_incarnation();
        // Either side is brought to the other's state, so there is no doubt.
        (inner.doubted, inner.abandoned) = (false, false);
        inner.token()
    }

    /// The present incarnation holds the mirror's state: no write is pending.
    pub fn delivered(&self) {
        let mut inner = self.lock();
        if !inner.pending.calls().is_empty() {
            inner.pending.clear();
            inner.session.delivered = inner.seq();
            inner.session_unwritten = true;
        }
        inner.write_session();
        drop(inner);
        self.write_soon();
        self.work.notify_one();
    }

    /// The present incarnation is served from now on: the mirror may change again. Returns its number.
    pub fn serve(&self) -> u64 {
        let mut inner = self.lock();
        inner.injecting = false;
        inner.unconfirmed = false;
        let incarnation = inner.session.incarnation;
        inner.served = Some(incarnation);
        incarnation
    }

    /// Whether the present incarnation has been served; none if none ever was.
    pub fn has_served_present(&self) -> Option<bool> {
        let inner = self.lock();
        inner.served.map(|of| of == inner.session.incarnation)
    }

    /// The mirror may change again.
    pub fn end_injection(&self) {
        self.lock().injecting = false;
    }

    /// The connection to the present incarnation ended with a batch in flight: it may still be run.
    pub fn abandon_batch(&self) {
        let mut inner = self.lock();
        (inner.abandoned, inner.behind) = (true, None);
    }

    /// The present incarnation cannot be running an earlier call any more.
    pub fn settled(&self) {
        self.lock().abandoned = false;
    }

    /// Whether the present incarnation can go on unchanged: no write is pending, and it runs no abandoned
    /// batch. If so, the mirror is frozen until [`Self::end_injection`].
    pub fn resume(&self) -> bool {
        let mut inner = self.lock();
        let whole = inner.pending.calls().is_empty() && !inner.abandoned;
        inner.injecting |= whole;
        whole
    }
}
