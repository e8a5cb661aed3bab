//! Calls in a robot with several computers: answered here, or forwarded to the leader.

use std::{
    net::{IpAddr, Ipv4Addr, SocketAddr},
    sync::Arc,
    time::Duration,
};

use bytes::Bytes;
use hyper::header::HeaderValue;
use rescue_core::cluster::{
    journal::RECORD_BYTES_MAX,
    sharing::Source,
    standing::{AnsweredCalls, JournalPosition, Standing},
};
use ros1_master::{
    master::{Kind, Request},
    xmlrpc::Reply,
};
use tokio::{
    sync::{mpsc, oneshot, watch},
    time::Instant,
};

mod control;
mod forwarded;
mod members;
mod passed_on;
mod shown;

use self::{
    control::Control,
    passed_on::{ConfirmOnDrop, ForwardedAnswers},
};
pub(crate) use self::{
    control::HANDOVER, forwarded::Forwarded, members::MemberAddresses, shown::Shown,
};
use super::{
    calls::{Calls, Closed, Incoming, NOT_IN_TIME, Unanswered},
    hold::Hold,
    listener,
    replies::{HttpReply, UntilWritten, forwarded, no_such_page, text, xml},
};
use crate::{
    nodes::served::Served,
    ros_env::MasterUri,
    upstream::{
        Head, RawReply,
        peer::{self, Peer, PeerError, Peers},
    },
    write_queue::PATIENCE,
};

/// Pause before a call is sent to the same leader again.
const RETRY_PAUSE: Duration = Duration::from_millis(20);
/// How long a removal waits for the mirror. It is 3 ms behind the leader, but 200 ms with `--cluster-sync interval`.
const CATCH_UP: Duration = Duration::from_millis(20);
/// The error if the leader's address in etcd is unusable.
const NO_ADDRESS: &str = "the leader's address cannot be used";

/// A handover request: the computer that should lead, and a channel for the result. The result is the previous leader's
/// name, or why the handover failed.
pub(crate) type Handover = (String, oneshot::Sender<Result<String, String>>);

/// The connection to the other computers of the robot.
#[derive(Clone, Debug)]
pub(crate) struct Others {
    pub(crate) standing: watch::Receiver<Standing>,
    pub(crate) peers: Arc<Peers>,
    pub(crate) handovers: mpsc::Sender<Handover>,
    /// Hosts whose nodes use this rosrescue as their master.
    pub(crate) served: Served,
    /// The computers that are believed if they name the caller of a call that they forward.
    pub(crate) members: MemberAddresses,
    /// Answers that followers have not passed on to their callers yet.
    pub(crate) passing: Arc<ForwardedAnswers>,
    /// Writes of this computer that were sent to a leader and have not been read in the journal yet.
    pub(crate) forwarded: Arc<Forwarded>,
    /// The last position in the journal of all computers that the mirror includes.
    pub(crate) followed: watch::Receiver<JournalPosition>,
    pub(crate) shown: Arc<Shown>,
    /// How long a call waits for a leader.
    pub(crate) hold: Duration,
}

/// A call that is being answered.
struct Call<'a> {
    others: &'a Others,
    calls: &'a Calls,
    head: Head,
    body: Bytes,
    call: Option<Request>,
    kind: Kind,
    /// Who made the call. The computer that forwards it, if the caller is there or is not known.
    from: IpAddr,
}

impl Others {
    pub(super) async fn answer(
        &self,
        calls: &Calls,
        peer: SocketAddr,
        mut head: Head,
        body: Bytes,
        call: Option<Request>,
    ) -> Result<HttpReply, Closed> {
        let asked_term = peer::term_of(&head.path);
        if asked_term.is_some() {
            head.path = Head::default().path;
        }
        if asked_term.is_none() && !head.may_be_for_rpc() {
            // A forwarded call loses its path.
            return Ok(no_such_page());
        }
        // Any program that may call can claim to be a follower, but not one at a member's address. Only the log shows
        // this address.
        let is_believed = asked_term.is_some() && self.members.contains(peer.ip());
        let said = head.caller.take().filter(|_| is_believed);
        let kind = call.as_ref().map_or(Kind::Mutate, Request::kind);
        if body.len() > RECORD_BYTES_MAX && kind.mutates() {
            return Ok(too_large(body.len()));
        }
        if let Some(call) = call.as_ref().filter(|_| asked_term.is_none())
            && kind == Kind::Identity
        {
            return calls.identity(call);
        }
        if let Some(call) = call
            .as_ref()
            .filter(|_| asked_term.is_none() && kind.mutates())
        {
            self.served.add(call);
        }
        let on_its_way = Call {
            others: self,
            calls,
            head,
            body,
            call,
            kind,
            from: said.unwrap_or_else(|| peer.ip()).to_canonical(),
        };
        let control = on_its_way.call.as_ref();
        let control = control.and_then(|call| Control::read(call, asked_term));
        if let Some(control) = control {
            return self.answer_control(&on_its_way, control, asked_term).await;
        }
        let mut standing = self.standing.clone();
        self.conduct(&on_its_way, &mut standing, asked_term).await
    }

    async fn conduct(
        &self,
        call: &Call<'_>,
        standing: &mut watch::Receiver<Standing>,
        asked_term: Option<u64>,
    ) -> Result<HttpReply, Closed> {
        let limit = call.head.hold.filter(|_| asked_term.is_some());
        let limit = limit.map_or(self.hold, |left| left.min(self.hold));
        let mut hold = Hold::new(limit);
        // A leader that has not answered may have run this call. If the call removes something, the next leader then
        // finds nothing to remove, and this is the answer.
        let mut removed: Option<Reply> = None;
        let mut unanswered = None;
        loop {
            let now = standing.borrow_and_update().clone();
            if let Some(term) = asked_term
                && !now.answers_others(term)
            {
                return Ok(not_leading(term));
            }
            let mut by_mirror = false;
            let retry = match now {
                Standing::Leads {
                    answers: AnsweredCalls::All,
                    ..
                }
                | Standing::Alone => {
                    let Call {
                        calls, head, body, ..
                    } = call;
                    let (head, body, request) = (head.clone(), body.clone(), call.call.clone());
                    let mut standing = self.standing.clone();
                    let source = match asked_term {
                        Some(_) => Source::Forwarded,
                        None => Source::Here,
                    };
                    let incoming = Incoming::new(source, call.from);
                    let answered = tokio::select! {
                        biased;
                        // A cut-off computer answers only its own nodes. The computer that forwarded this call may not
                        // be cut off, and may become the next leader.
                        Ok(_) = standing.wait_for(|now| *now == Standing::Alone), if asked_term.is_some() => continue,
                        answered = calls.answer_here(head, body, request, incoming, &mut hold) => answered,
                    };
                    match answered {
                        Err(Unanswered::Elsewhere) => None,
                        Ok(mut reply) if asked_term.is_some() => {
                            if let Some(held) = reply.extensions_mut().remove() {
                                let number = self.passing.add(Instant::now(), held);
                                let number = HeaderValue::from(number);
                                reply.headers_mut().insert(peer::ANSWER_HEADER, number);
                            }
                            let acknowledged = calls.ledger.acknowledged.last();
                            let last = calls.ledger.last_shared();
                            let seq = JournalPosition::shown_seq(
                                call.kind == Kind::Read,
                                acknowledged,
                                last,
                            );
                            let seq = HeaderValue::from(seq);
                            reply.headers_mut().insert(peer::SEQ_HEADER, seq);
                            return Ok(reply);
                        }
                        answered => return Ok(instead(answered?, removed)),
                    }
                }
                Standing::Follows { uri, term } => {
                    let uri = MasterUri::parse(&uri).map_err(|_| Closed(NO_ADDRESS))?;
                    let leader = self.peers.peer_at(&uri);
                    let removes = call.removes().await;
                    if unanswered.is_none() && call.kind.mutates() {
                        unanswered = call
                            .call
                            .as_ref()
                            .and_then(|call| self.forwarded.begin(call));
                    }
                    // If the leader answers, its master has worked on the call, or its own clock counts.
                    let asked = Instant::now();
                    tokio::select! {
                        answered = call.forward(&leader, term, hold.time_left()) => match answered {
                            Ok(reply) => {
                                if let Some(sent) = unanswered {
                                    sent.answered(self.shown.get(), *self.followed.borrow());
                                }
                                return Ok(instead(reply, removed));
                            }
                            Err(may_have_run) => {
                                hold.spend(asked.elapsed());
                                removed = removed.or_else(|| removes.filter(|_| may_have_run));
                                Some(Instant::now() + RETRY_PAUSE)
                            }
                        },
                        // When the leader changes, the old leader's answer never comes or no longer counts. A computer
                        // that is alone answers reads itself. When rosrescue stops, nothing changes any more, and the leader
                        // may still answer.
                        Ok(()) = standing.changed() => {
                            hold.spend(asked.elapsed());
                            removed = removed.or(removes);
                            continue;
                        }
                    }
                }
                // Waits until the next leader has taken over, or the merge is done.
                Standing::Leads { answers, .. } => {
                    by_mirror = answers == AnsweredCalls::Reads;
                    None
                }
                Standing::NoLeader { known } => {
                    by_mirror = known;
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
                biased;
                Some(reply) = call.by_mirror_when_fresh(), if by_mirror => return Ok(reply),
                changed = standing.changed() => changed.map_err(|_| Closed("rosrescue is stopping"))?,
                () = retry => {}
                () = hold.wait_until_spent() => {
                    call.calls.stats.calls_unanswered.count();
                    return Err(Closed(NOT_IN_TIME));
                }
            }
        }
    }
}

/// The address that stands for this computer in the robot's journal, which other computers read. `uri` is its advertised
/// address.
pub(crate) fn own_address(uri: &str) -> IpAddr {
    let advertised = MasterUri::parse(uri).ok();
    let advertised = advertised.and_then(|uri| uri.host.parse().ok());
    let local = || listener::local_address().unwrap_or(IpAddr::V4(Ipv4Addr::LOCALHOST));
    advertised.unwrap_or_else(local)
}

impl Call<'_> {
    /// Passes the leader's answer on to the caller. Notes the answer's position in the journal: from now on the mirror
    /// answers here only if it has reached that position.
    fn pass_on(&self, leader: &Arc<Peer>, term: u64, raw: RawReply) -> HttpReply {
        let seq = raw.headers.get(peer::SEQ_HEADER);
        let seq = seq.and_then(|seq| seq.to_str().ok()?.parse().ok());
        let seq = seq.unwrap_or(0);
        let epoch = self.others.followed.borrow().epoch;
        self.others.shown.raise(JournalPosition {
            epoch,
            term,
            seq,
            ..JournalPosition::default()
        });
        let number = raw.headers.get(peer::ANSWER_HEADER);
        let number = number.and_then(|number| number.to_str().ok().map(str::to_owned));
        let mut reply = forwarded(&self.calls.uri, self.call.as_ref(), raw);
        if let Some(number) = number {
            let leader = leader.clone();
            let pass_on = ConfirmOnDrop {
                leader,
                term,
                number,
            };
            reply.extensions_mut().insert(UntilWritten::new(pass_on));
        }
        reply
    }

    fn head_for_leader(&self, hold: Duration) -> Head {
        let is_here = self.from.is_loopback();
        Head {
            caller: (!is_here).then_some(self.from),
            hold: Some(hold),
            ..self.head.clone()
        }
    }

    /// The leader's answer, or the mirror's if the leader is slow to answer a read.
    ///
    /// # Errors
    ///
    /// If neither can answer now. The error is whether the leader may have run the call.
    async fn forward(
        &self,
        leader: &Arc<Peer>,
        term: u64,
        hold: Duration,
    ) -> Result<HttpReply, bool> {
        if self.kind == Kind::Read || self.is_subscribed() {
            return self.forward_read(leader, term, hold).await.ok_or(true);
        }
        match leader
            .forward(term, &self.head_for_leader(hold), &self.body)
            .await
        {
            Ok(raw) => Ok(self.pass_on(leader, term, raw)),
            Err(error) => {
                tracing::debug!(%error, "a call to the leader failed");
                Err(error.may_have_run)
            }
        }
    }

    /// The answer to a call that changes nothing. `None` if neither the leader nor the mirror can answer now.
    async fn forward_read(
        &self,
        leader: &Arc<Peer>,
        term: u64,
        hold: Duration,
    ) -> Option<HttpReply> {
        if leader.is_late()
            && let Some(reply) = self.by_mirror().await
        {
            return Some(reply);
        }
        // The request continues after the mirror has answered, because the leader's next answer in time shows that it
        // is back.
        let mut asked = {
            let (leader, head, body) = (
                leader.clone(),
                self.head_for_leader(hold),
                self.body.clone(),
            );
            crate::task::spawn(async move { leader.forward(term, &head, &body).await })
        };
        let reply: Result<RawReply, PeerError> =
            match tokio::time::timeout(PATIENCE, &mut asked).await {
                Ok(reply) => reply.ok()?,
                Err(_) => {
                    leader.set_late(true);
                    tokio::select! {
                        biased;
                        Some(reply) = self.by_mirror_when_fresh() => return Some(reply),
                        reply = &mut asked => reply.ok()?,
                    }
                }
            };
        match reply {
            Ok(raw) => Some(self.pass_on(leader, term, raw)),
            Err(error) => {
                tracing::debug!(%error, "a read from the leader failed");
                self.by_mirror().await
            }
        }
    }

    /// The leader's predicted answer, if the call removes something that the mirror has. Waits for the mirror, because
    /// it may lack the last write that was answered here.
    async fn removes(&self) -> Option<Reply> {
        let call = self.call.as_ref().filter(|call| call.removes())?;
        let _ = tokio::time::timeout(CATCH_UP, self.wait_for_mirror()).await;
        self.calls.ledger.answer_if_changing(call)
    }

    /// Whether the call is a `subscribeParam` whose subscription already exists. Nodes repeat such calls whenever they
    /// log, and must not wait for a takeover.
    fn is_subscribed(&self) -> bool {
        let call = self.call.as_ref();
        call.is_some_and(|call| self.calls.ledger.answer_if_subscribed(call).is_some())
    }

    /// The mirror's answer to a read or to a repeated `subscribeParam`. `None` for any other call. Also `None` while
    /// the mirror is behind the leader's earlier answers, so that no later read shows an older state.
    async fn by_mirror(&self) -> Option<HttpReply> {
        let call = self.call.as_ref()?;
        let followed = *self.others.followed.borrow();
        if !followed.shows(self.others.shown.get()) {
            return None;
        }
        match self.kind {
            Kind::Read => self.calls.answer_from_mirror(Some(call)).await,
            _ => self.calls.answer_subscribed_from_mirror(call).await,
        }
    }

    /// Waits until the mirror has reached the leader's earlier answers, then answers as [`Self::by_mirror`] does.
    async fn by_mirror_when_fresh(&self) -> Option<HttpReply> {
        if self.kind != Kind::Read && !self.is_subscribed() {
            return None;
        }
        self.wait_for_mirror().await?;
        self.by_mirror().await
    }

    /// Waits until the mirror has reached the leader's earlier answers. `None` if rosrescue is stopping.
    async fn wait_for_mirror(&self) -> Option<()> {
        let mut followed = self.others.followed.clone();
        let fresh = followed.wait_for(|followed| followed.shows(self.others.shown.get()));
        fresh.await.ok().map(drop)
    }
}

/// `reply`, with `removed` in its place if there is one.
fn instead(mut reply: HttpReply, removed: Option<Reply>) -> HttpReply {
    let Some(removed) = removed else {
        return reply;
    };
    let mut answer = xml(&removed);
    std::mem::swap(answer.extensions_mut(), reply.extensions_mut());
    answer
}

fn not_leading(term: u64) -> HttpReply {
    text(
        peer::NOT_LEADING,
        format!("this rosrescue is not the leader in term {term}\n"),
    )
}

fn too_large(bytes: usize) -> HttpReply {
    xml(&Reply::Fault {
        code: 1,
        text: format!(
            "the call has {bytes} bytes, but with --cluster at most {RECORD_BYTES_MAX} are allowed; set a large parameter in parts, or store it in a file"
        ),
    })
}

#[cfg(test)]
mod tests;
