//! Requests of rosrescue itself: from the rosrescue of another computer, and from `rosrescue handover`. They are no ROS
//! calls, so none of them reaches the write queue as a call or a master.

use rescue_core::{
    checkpoint::format::Origin,
    cluster::{
        merge::wire::Ask,
        standing::{AnsweredCalls, Standing},
    },
};
use ros1_master::{
    master::{CALLER_ID, Method, Request},
    xmlrpc::{Reply, Value},
};
use tokio::sync::oneshot;

use super::{Call, NO_ADDRESS, Others, not_leading};
use crate::{
    ros_env::MasterUri,
    server::{
        calls::{Calls, Closed, NOT_IN_TIME},
        replies::{HttpReply, xml},
    },
};

/// The method by which `rosrescue handover` asks the leader to give up leadership. Its parameters are the caller's id and
/// the computer that should lead; an empty text means any.
pub(crate) const HANDOVER: &str = "rosrescue/handover";
/// The method by which a follower tells the leader that it has passed an answer on to its caller.
pub(super) const PASSED_ON: &str = "rosrescue/passedOn";

/// A request of rosrescue itself.
pub(super) enum Control {
    /// Make these partition writes of another computer.
    Merge(Ask),
    /// Let this computer lead, or any if the name is empty.
    HandOver(String),
    /// The caller has the answer with this number, or never gets it.
    AnswerPassedOn(u64),
}

impl Control {
    /// Reads a request. `None` for a ROS call. Only another computer's rosrescue, which addresses the leader of a term,
    /// may send other requests than a handover.
    pub(super) fn read(call: &Request, asked_term: Option<u64>) -> Option<Self> {
        let Method::Unknown(name) = call.method() else {
            return None;
        };
        match &**name {
            HANDOVER => {
                let to = call.text(1).unwrap_or_default();
                Some(Self::HandOver(to.to_owned()))
            }
            _ if asked_term.is_none() => None,
            PASSED_ON => call.text(1)?.parse().ok().map(Self::AnswerPassedOn),
            _ => Ask::read(call).map(Self::Merge),
        }
    }

    /// The request that says that the answer with this number has been passed on.
    pub(super) fn answer_passed_on(number: &str) -> Request {
        Request::new(Method::named(PASSED_ON), [CALLER_ID, number])
    }
}

impl Others {
    /// Answers a request of rosrescue itself. `call` is the same request as it arrived.
    pub(super) async fn answer_control(
        &self,
        call: &Call<'_>,
        control: Control,
        asked_term: Option<u64>,
    ) -> Result<HttpReply, Closed> {
        if let Some(term) = asked_term
            && !self.standing.borrow().answers_others(term)
        {
            return Ok(not_leading(term));
        }
        match control {
            Control::Merge(ask) => {
                let merged = self.merge(call.calls, ask, Origin::At(call.from)).await;
                Ok(merged.unwrap_or_else(|| not_leading(asked_term.unwrap_or_default())))
            }
            Control::HandOver(to) => self.hand_over(call, to).await,
            Control::AnswerPassedOn(number) => {
                self.passing.release(number);
                Ok(passed_on())
            }
        }
    }

    /// Makes another computer's partition writes. `None` if this computer no longer leads.
    async fn merge(&self, calls: &Calls, ask: Ask, origin: Origin) -> Option<HttpReply> {
        let mut standing = self.standing.clone();
        tokio::select! {
            biased;
            _ = standing.wait_for(|now| *now == Standing::Alone) => None,
            answer = calls.write_queue.merge(ask, origin) => Some(xml(&answer?.to_reply())),
        }
    }

    /// Hands leadership over to `to`, here or at the leader, once there is one.
    async fn hand_over(&self, call: &Call<'_>, to: String) -> Result<HttpReply, Closed> {
        let mut standing = self.standing.clone();
        let settled = standing.wait_for(|now| {
            let waits =
                matches!(now, Standing::Leads { answers, .. } if *answers != AnsweredCalls::All);
            !waits && !matches!(now, Standing::NoLeader { .. })
        });
        let Ok(now) = tokio::time::timeout(self.hold, settled).await else {
            call.calls.stats.calls_unanswered.count();
            return Err(Closed(NOT_IN_TIME));
        };
        let now = now.map_err(|_| Closed("rosrescue is stopping"))?.clone();
        if let Standing::Follows { uri, term } = now {
            let uri = MasterUri::parse(&uri).map_err(|_| Closed(NO_ADDRESS))?;
            let leader = self.peers.peer_at(&uri);
            // The request is sent only once, because after a failure the next leader would hand over too.
            let silent = || handed_over(Err("the leader does not answer".to_owned()));
            let answered = call.forward(&leader, term, self.hold).await;
            return Ok(answered.unwrap_or_else(|_| silent()));
        }
        let (tell, told) = oneshot::channel();
        // The channel closes only when rosrescue stops.
        let _ = self.handovers.send((to, tell)).await;
        let stopping = || Err("rosrescue is stopping".to_owned());
        Ok(handed_over(told.await.unwrap_or_else(|_| stopping())))
    }
}

/// The answer to a handover request.
fn handed_over(result: Result<String, String>) -> HttpReply {
    let (code, text, who) = match result {
        Ok(who) => (1, "another computer may lead now".to_owned(), who),
        Err(why) => (0, why, String::new()),
    };
    let reply: [Value; 3] = [code.into(), text.as_str().into(), who.as_str().into()];
    xml(&Reply::Value(reply.to_vec().into()))
}

fn passed_on() -> HttpReply {
    let reply: [Value; 3] = [1.into(), "passed on".into(), 0.into()];
    xml(&Reply::Value(reply.to_vec().into()))
}
