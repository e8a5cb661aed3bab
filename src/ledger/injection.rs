//! From a master that is back to the open gate.

use super::{Basis, Ledger};
use crate::{master::Master, replay::Token};

impl Ledger {
    /// The mirror must not change from now on, until [`Self::end_injection`]. What a master that is about to
    /// be brought to its state is planned from.
    pub fn begin_injection(&self) -> Basis {
        let mut inner = self.lock();
        inner.injecting = true;
        Basis {
            mirror: inner.mirror.clone(),
            version: inner.version,
            pending: inner.pending.calls().to_vec(),
        }
    }

    /// The mirror's version and state, and the token that the next incarnation will get.
    pub fn next(&self) -> (u64, Master, Token) {
        let inner = self.lock();
        let token = Token::new(&inner.session.mark, inner.session.incarnation + 1);
        (inner.version, inner.mirror.clone(), token)
    }

    /// The next incarnation takes over, to be brought to the mirror's state: replies of the one before no
    /// longer count. The new one's token.
    pub fn succeed(&self) -> Token {
        let mut inner = self.lock();
        inner.next_incarnation();
        // The new one is brought to the mirror's state, or the mirror to its.
        (inner.doubted, inner.abandoned) = (false, false);
        inner.token()
    }

    /// The present incarnation holds what the mirror holds.
    pub fn delivered(&self) {
        let mut inner = self.lock();
        if !inner.pending.calls().is_empty() {
            inner.pending.clear();
            let seq = inner.seq();
            inner.update_session(|session| session.delivered = seq);
            self.work.notify_one();
        }
    }

    /// The present incarnation is served from now on: its number. The mirror may change again.
    pub fn serve(&self) -> u64 {
        let mut inner = self.lock();
        inner.injecting = false;
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

    /// A batch was in flight when the connection to the present incarnation ended: it may still be run.
    pub fn abandon_batch(&self) {
        self.lock().abandoned = true;
    }

    /// The present incarnation runs no call that it was sent before.
    pub fn settled(&self) {
        self.lock().abandoned = false;
    }

    /// Whether the present incarnation can go on as it is: it owes no write, and runs none that nobody
    /// waits for. The mirror must not change then, until [`Self::end_injection`].
    pub fn resume(&self) -> bool {
        let mut inner = self.lock();
        let whole = inner.pending.calls().is_empty() && !inner.abandoned;
        inner.injecting |= whole;
        whole
    }
}
