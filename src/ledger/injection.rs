//! The ledger's part in an injection: freezes the mirror while a master is brought to its state, and starts the new
//! incarnation (see [`Token`]).

use super::{Basis, Ledger};
use crate::{master::Master, replay::Token, xmlrpc::Python};

impl Ledger {
    /// Freezes the mirror until [`Self::end_injection`]. Returns the state from which the injection is planned.
    pub fn begin_injection(&self) -> Basis {
        let mut inner = self.lock();
        inner.injecting = true;
        Basis {
            mirror: inner.mirror.clone(),
            version: inner.version,
            pending: inner.pending.calls().to_vec(),
        }
    }

    /// Sets the version of Python on which the present master runs.
    pub fn set_python(&self, python: Python) {
        self.lock().mirror.set_python(python);
    }

    /// Sets whether the present master behaves like version 1.14.3 and earlier.
    pub fn set_old(&self, old: Option<bool>) {
        self.lock().mirror.set_old(old);
    }

    /// The mirror's version and state, and the [`Token`] for the next master.
    pub fn next(&self) -> (u64, Master, Token) {
        let inner = self.lock();
        let token = Token::new(&inner.session.mark, inner.session.incarnation + 1);
        (inner.version, inner.mirror.clone(), token)
    }

    /// Notes that the checkpoint is older than the master, whose [`Token`] has this `number`. So a master has run the
    /// checkpoint's pending writes.
    pub fn catch_up(&self, number: u64) {
        let mut inner = self.lock();
        inner.pending.forget_restored();
        inner.session.incarnation = number;
        inner.session_unwritten = true;
    }

    /// Starts the next incarnation (see [`Token`]), so that replies of the previous one no longer count. Returns the
    /// new token.
    ///
    /// The journal records the new token's number once the master has it. A rosrescue that starts before that finds
    /// either a master with a higher number than the recorded one, or a master without the pending writes.
    pub fn succeed(&self) -> Token {
        let mut inner = self.lock();
        inner.raise_incarnation();
        // The injection makes both sides equal, so no doubt remains.
        (inner.doubted, inner.abandoned) = (false, false);
        inner.token()
    }

    /// Notes that the present master holds the mirror's state, so no write is pending.
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

    /// Lets calls pass to the present master and allows the mirror to change again. Returns the number in the master's
    /// [`Token`].
    pub fn serve(&self) -> u64 {
        let mut inner = self.lock();
        inner.injecting = false;
        inner.unconfirmed = false;
        let incarnation = inner.session.incarnation;
        inner.served = Some(incarnation);
        incarnation
    }

    /// Whether calls have passed to the present master. `None` if calls have never passed to a master.
    pub fn has_served_present(&self) -> Option<bool> {
        let inner = self.lock();
        inner.served.map(|of| of == inner.session.incarnation)
    }

    /// Ends the freeze of [`Self::begin_injection`] and [`Self::resume`]: the mirror may change again.
    pub fn end_injection(&self) {
        self.lock().injecting = false;
    }

    /// Notes that the connection to the present master ended before the answer to a batch. The master may still run
    /// that batch.
    pub fn abandon_batch(&self) {
        let mut inner = self.lock();
        (inner.abandoned, inner.behind) = (true, None);
    }

    /// Notes that the present master can no longer be running a batch of an ended connection.
    pub fn settled(&self) {
        self.lock().abandoned = false;
    }

    /// Whether the present master can continue unchanged: no write is pending, and it runs no batch of an ended
    /// connection. If so, the mirror is frozen until [`Self::end_injection`].
    pub fn resume(&self) -> bool {
        let mut inner = self.lock();
        let whole = inner.pending.calls().is_empty() && !inner.abandoned;
        inner.injecting |= whole;
        whole
    }
}
