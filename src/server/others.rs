//! Calls where there are several computers: answered here, or by the leader.

use std::{sync::Arc, time::Duration};

use bytes::Bytes;
use tokio::{
    sync::{mpsc, oneshot, watch},
    time::Instant,
};

use super::{
    calls::{Calls, Closed, NOT_IN_TIME, PATIENCE, Unanswered},
    replies::{HttpReply, forwarded, text, xml},
};
use crate::{
    cluster::{journal::RECORD_BYTES_MAX, way::Way},
    master::{Kind, Method, Request, names},
    upstream::{
        Head, RawReply,
        peer::{self, Peer, PeerError, Peers},
    },
    xmlrpc::{Reply, Value},
};

/// Pause before a call is sent to the same leader again.
const RETRY_PAUSE: Duration = Duration::from_millis(20);
/// The method by which `rosrescue handover` has the leader give up leading.
pub(crate) const HANDOVER: &str = "rosrescue/handover";

/// A request to give up leading: in whose favour, and where to say who led, or why it cannot be done.
pub(crate) type Handover = (String, oneshot::Sender<Result<String, String>>);

/// The way to the other computers.
#[derive(Clone, Debug)]
pub(crate) struct Others {
    pub(crate) way: watch::Receiver<Way>,
    pub(crate) peers: Arc<Peers>,
    pub(crate) handovers: mpsc::Sender<Handover>,
    /// How long a call waits for a leader.
    pub(crate) hold: Duration,
}

/// A call on its way.
struct Call<'a> {
    calls: &'a Calls,
    head: Head,
    body: Bytes,
    call: Option<Request>,
    kind: Kind,
}

impl Others {
    pub(super) async fn answer(
        &self,
        calls: &Calls,
        mut head: Head,
        body: Bytes,
        call: Option<Request>,
    ) -> Result<HttpReply, Closed> {
        let asked_term = peer::term_of(&head.path);
        if asked_term.is_some() {
            head.path = Head::default().path;
        }
        let kind = call.as_ref().map_or(Kind::Mutate, Request::kind);
        if body.len() > RECORD_BYTES_MAX && kind.mutates() {
            return Ok(too_large(body.len()));
        }
        if let Some(call) = call.as_ref().filter(|_| asked_term.is_none())
            && kind == Kind::Identity
        {
            return calls.identity(call);
        }
        let on_its_way = Call {
            calls,
            head,
            body,
            call,
            kind,
        };
        let mut way = self.way.clone();
        self.conduct(&on_its_way, &mut way, asked_term).await
    }

    async fn conduct(
        &self,
        call: &Call<'_>,
        way: &mut watch::Receiver<Way>,
        asked_term: Option<u64>,
    ) -> Result<HttpReply, Closed> {
        let mut hold = std::pin::pin!(tokio::time::sleep(self.hold));
        let deletes = call.deletes();
        let mut sent = false;
        loop {
            // The leader that ran it died before it could answer; the next one would refuse it.
            if sent && deletes.is_some() && call.deletes().is_none() {
                return Ok(deleted(deletes.as_deref().unwrap_or_default()));
            }
            let now = way.borrow_and_update().clone();
            if let Some(term) = asked_term
                && now != (Way::Here { term: Some(term) })
            {
                return Ok(not_leading(term));
            }
            let retry = match now {
                Way::Here { .. } => {
                    if let Some(to) = call.hands_over() {
                        return Ok(self.hand_over(to).await);
                    }
                    let Call {
                        calls, head, body, ..
                    } = call;
                    let (head, body, request) = (head.clone(), body.clone(), call.call.clone());
                    let mut leads = self.way.clone();
                    let answered = tokio::select! {
                        biased;
                        // What is answered alone holds only if nobody else changes it: the computer that has
                        // asked need not be cut off, and may be about to lead itself.
                        _ = leads.wait_for(|way| *way == Way::Here { term: None }), if asked_term.is_some() => continue,
                        answered = calls.answer_here(head, body, request) => answered,
                    };
                    match answered {
                        Err(Unanswered::Elsewhere) => None,
                        answered => return Ok(answered?),
                    }
                }
                Way::Leader { uri, term } => {
                    let leader = self.peers.at(&uri);
                    if call.hands_over().is_some() {
                        // Once: the next leader would give up, too.
                        let silent = || handed_over(Err("the leader does not answer".to_owned()));
                        return Ok(call.forward(&leader, term).await.unwrap_or_else(silent));
                    }
                    sent = true;
                    tokio::select! {
                        answered = call.forward(&leader, term) => match answered {
                            Some(reply) => return Ok(reply),
                            None => Some(Instant::now() + RETRY_PAUSE),
                        },
                        // Its answer would never come, or does not count any more.
                        _ = way.changed(), if call.kind != Kind::Read => continue,
                    }
                }
                Way::Nobody { known } => {
                    if known && let Some(reply) = call.by_mirror().await {
                        return Ok(reply);
                    }
                    None
                }
            };
            let retry = async {
                match retry {
                    Some(at) => tokio::time::sleep_until(at).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                changed = way.changed() => changed.map_err(|_| Closed("rosrescue stops"))?,
                () = retry => {}
                () = &mut hold => {
                    call.calls.stats.calls_unanswered.count();
                    return Err(Closed(NOT_IN_TIME));
                }
            }
        }
    }

    async fn hand_over(&self, to: &str) -> HttpReply {
        let (tell, told) = oneshot::channel();
        // It ends only when rosrescue stops.
        let _ = self.handovers.send((to.to_owned(), tell)).await;
        handed_over(
            told.await
                .unwrap_or_else(|_| Err("rosrescue stops".to_owned())),
        )
    }
}

/// The answer to a handover: who has led, or why it still does.
fn handed_over(result: Result<String, String>) -> HttpReply {
    let (code, text, who) = match result {
        Ok(who) => (1, "another computer may lead now".to_owned(), who),
        Err(why) => (0, why, String::new()),
    };
    let reply: [Value; 3] = [code.into(), text.as_str().into(), who.as_str().into()];
    xml(&Reply::Value(reply.to_vec().into()))
}

impl Call<'_> {
    /// In whose favour the leader is to give up leading, if that is what is asked.
    fn hands_over(&self) -> Option<&str> {
        let call = self.call.as_ref()?;
        let is_it = matches!(call.method(), Method::Unknown(name) if **name == *HANDOVER);
        is_it.then(|| call.text(1).unwrap_or_default())
    }

    /// The leader's answer, or to a read the mirror's if that of the leader takes long; none if there is none
    /// now.
    async fn forward(&self, leader: &Arc<Peer>, term: u64) -> Option<HttpReply> {
        let Self { calls, call, .. } = self;
        if self.kind != Kind::Read {
            return match leader.forward(term, &self.head, &self.body).await {
                Ok(raw) => Some(forwarded(&calls.uri, call.as_ref(), raw)),
                Err(error) => {
                    tracing::debug!(%error, "a call to the leader");
                    None
                }
            };
        }
        if leader.is_late()
            && let Some(reply) = self.by_mirror().await
        {
            return Some(reply);
        }
        // Goes on when the mirror has answered: the next answer in time shows that the leader is there again.
        let mut asked = {
            let (leader, head, body) = (leader.clone(), self.head.clone(), self.body.clone());
            tokio::spawn(async move { leader.forward(term, &head, &body).await })
        };
        let reply: Result<RawReply, PeerError> =
            match tokio::time::timeout(PATIENCE, &mut asked).await {
                Ok(reply) => reply.ok()?,
                Err(_) => {
                    leader.set_late(true);
                    if let Some(reply) = self.by_mirror().await {
                        return Some(reply);
                    }
                    asked.await.ok()?
                }
            };
        match reply {
            Ok(raw) => Some(forwarded(&calls.uri, call.as_ref(), raw)),
            Err(error) => {
                tracing::debug!(%error, "a read from the leader");
                self.by_mirror().await
            }
        }
    }

    /// The parameter that is deleted, if it is one that the mirror has.
    fn deletes(&self) -> Option<String> {
        let call = self.call.as_ref()?;
        let (caller, key) = (call.caller()?, call.text(1)?);
        if *call.method() != Method::DeleteParam {
            return None;
        }
        let has = Request::new(Method::HasParam, [caller, key]);
        let Some(Reply::Value(Value::Array(answer))) = self.calls.ledger.answer(&has) else {
            return None;
        };
        let there = answer.get(2) == Some(&Value::Bool(true));
        there.then(|| names::resolve(key, caller))
    }

    /// The mirror's answer to a read; none to any other call.
    async fn by_mirror(&self) -> Option<HttpReply> {
        let read = self.call.as_ref().filter(|_| self.kind == Kind::Read);
        self.calls.stand_in(read).await
    }
}

/// A master's answer to the deletion of `key`.
fn deleted(key: &str) -> HttpReply {
    let text = format!("parameter {key} deleted");
    let reply: [Value; 3] = [1.into(), text.as_str().into(), 0.into()];
    xml(&Reply::Value(reply.to_vec().into()))
}

fn not_leading(term: u64) -> HttpReply {
    text(
        peer::NOT_LEADING,
        format!("this rosrescue does not lead in term {term}\n"),
    )
}

fn too_large(bytes: usize) -> HttpReply {
    xml(&Reply::Fault {
        code: 1,
        text: format!(
            "the call has {bytes} bytes, and with --cluster it may have {RECORD_BYTES_MAX} at most; set a \
             large parameter in parts, or give nodes a file"
        ),
    })
}

#[cfg(test)]
mod tests;
