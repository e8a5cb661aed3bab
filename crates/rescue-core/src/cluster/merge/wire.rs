//! The request by which a computer that was cut off sends its writes to the leader, and the leader's answer.

use std::sync::Arc;

use super::{Conflict, LostWrite, MergeVerdict};
use ros1_master::{
    master::{CALLER_ID, Method, Request, entry_reply, is_success, returnable},
    xmlrpc::{Call, Reply, Value},
};

/// The name of the XML-RPC method by which a computer sends its writes to the leader.
pub const METHOD: &str = "rosrescue/merge";
/// The name of the method that contains several calls.
const MULTICALL: &str = "system.multicall";

/// A request to the leader to make some partition writes.
#[derive(Clone, Debug, PartialEq)]
pub struct Ask {
    /// The name under which this process of the computer sends all its partition writes. What it has changed under this name
    /// is no conflict.
    pub id: Arc<str>,
    /// The writes conflict with no change up to this record of the journal.
    pub seq: u64,
    pub calls: Vec<Request>,
}

impl Ask {
    pub fn to_request(&self) -> Request {
        let calls = Request::multicall(self.calls.iter().cloned())
            .wire_params()
            .into_owned();
        let seq = self.seq.to_string();
        let head = [CALLER_ID, &*self.id, seq.as_str()].map(Value::from);
        Request::new(Method::named(METHOD), head.into_iter().chain(calls))
    }

    /// Reads a request. `None` if it calls another method.
    pub fn read(request: &Request) -> Option<Self> {
        let is_it = matches!(request.method(), Method::Unknown(name) if **name == *METHOD);
        let calls = request.params().get(3).filter(|_| is_it)?;
        let calls = Request::from(Call::new(MULTICALL, vec![calls.clone()]));
        Some(Self {
            id: request.text(1)?.into(),
            seq: request.text(2)?.parse().ok()?,
            calls: calls.calls().into_iter().cloned().collect(),
        })
    }
}

/// The outcome of one write.
#[derive(Clone, Debug, PartialEq)]
pub enum WriteOutcome {
    /// The write was made, or its value is already set.
    Holds,
    /// The master refused the write.
    Refused(String),
    /// Another computer has changed the same parameter, node, service or topic registration. `present` is the parameter's
    /// value now. `None` if it has none, or one that no answer can contain.
    Lost { why: String, present: Option<Value> },
}

impl WriteOutcome {
    /// Whether the write `call` is lost: it was neither made, nor is its result there already.
    pub fn is_loss_of(&self, call: &Request) -> bool {
        match self {
            Self::Holds => false,
            // Others have deleted the parameter, too.
            Self::Refused(_) => *call.method() != Method::DeleteParam,
            Self::Lost { .. } => true,
        }
    }
}

impl From<&LostWrite> for WriteOutcome {
    fn from(lost: &LostWrite) -> Self {
        Self::Lost {
            why: lost.why.to_string(),
            present: match lost.why {
                Conflict::Parameter(_) => lost.present.clone(),
                _ => None,
            },
        }
    }
}

/// The leader's answer to an [`Ask`].
#[derive(Clone, Debug, PartialEq)]
pub enum MergeAnswer {
    /// The sender must read the journal again and decide again which writes to send: the leader no longer knows all
    /// changes after the record [`Ask::seq`], or the node of one of the writes has made a change that conflicts with it.
    Again,
    /// The outcome of each write.
    Done(Vec<WriteOutcome>),
}

impl MergeAnswer {
    /// The answer for writes that were decided on as in `verdicts`. `reply` is the master's reply to those that it ran.
    pub fn from_reply(verdicts: &[MergeVerdict], reply: &Reply) -> Self {
        let results = match reply {
            Reply::Value(Value::Array(results)) => results.as_slice(),
            _ => &[],
        };
        let mut results = results.iter();
        let outcomes = verdicts.iter().map(|verdict| match verdict {
            MergeVerdict::Redundant => WriteOutcome::Holds,
            MergeVerdict::Overtaken(lost) => lost.into(),
            // A write without a result was made; the master could not encode the whole answer.
            MergeVerdict::Apply => match results.next().and_then(entry_reply) {
                Some(reply) if !is_success(&reply) => WriteOutcome::Refused(text(&reply)),
                _ => WriteOutcome::Holds,
            },
        });
        Self::Done(outcomes.collect())
    }

    pub fn to_reply(&self) -> Reply {
        let (code, outcomes) = match self {
            Self::Again => (0, Vec::new()),
            Self::Done(outcomes) => (1, outcomes.iter().map(value).collect()),
        };
        let text = match self {
            Self::Again => "read the journal again",
            Self::Done(_) => "merged",
        };
        Reply::Value(vec![code.into(), text.into(), Value::Array(outcomes)].into())
    }

    /// Reads the answer for `count` writes. `None` for anything else.
    pub fn read(reply: &Reply, count: usize) -> Option<Self> {
        let Reply::Value(Value::Array(answer)) = reply else {
            return None;
        };
        match answer.as_slice() {
            [Value::Int(0), _, Value::Array(none)] if none.is_empty() => Some(Self::Again),
            [Value::Int(1), _, Value::Array(outcomes)] => {
                let outcomes: Vec<_> = outcomes.iter().map(outcome).collect::<Option<_>>()?;
                (outcomes.len() == count).then_some(Self::Done(outcomes))
            }
            _ => None,
        }
    }
}

fn value(outcome: &WriteOutcome) -> Value {
    let (code, text, present) = match outcome {
        WriteOutcome::Holds => (1, "", None),
        WriteOutcome::Refused(text) => (0, text.as_str(), None),
        WriteOutcome::Lost { why, present } => {
            // With such a value the whole answer would be a fault, and be asked for again and again.
            let present = present.clone().filter(returnable::is_readable);
            (-1, why.as_str(), present)
        }
    };
    let parts = [Value::Int(code), text.into()].into_iter().chain(present);
    Value::Array(parts.collect())
}

fn outcome(value: &Value) -> Option<WriteOutcome> {
    let parts = value.as_array()?;
    let text = || Some(parts.get(1)?.as_str()?.to_owned());
    Some(match parts.first()?.as_int()? {
        1 => WriteOutcome::Holds,
        0 => WriteOutcome::Refused(text()?),
        -1 => WriteOutcome::Lost {
            why: text()?,
            present: parts.get(2).cloned(),
        },
        _ => return None,
    })
}

/// The text of a refusal.
fn text(reply: &Reply) -> String {
    match reply {
        Reply::Fault { text, .. } => text.clone(),
        Reply::Value(value) => {
            let text = value.as_array().and_then(|answer| answer.get(1)?.as_str());
            text.unwrap_or_default().to_owned()
        }
    }
}

#[cfg(test)]
mod tests {
    use ros1_master::xmlrpc::{decode_reply, encode_reply};

    use super::*;

    fn set(key: &str, value: i32) -> Request {
        let params = [Value::from("/n"), key.into(), value.into()];
        Request::new(Method::SetParam, params)
    }

    fn coded(request: Request) -> Request {
        let body = request.encode();
        Request::decode(&body).unwrap()
    }

    #[test]
    fn what_is_asked_is_read_as_it_was_written() {
        let ask = Ask {
            id: "one".into(),
            seq: u64::MAX,
            calls: vec![set("/a", 1), set("/b", 2)],
        };
        assert_eq!(Ask::read(&coded(ask.to_request())), Some(ask));
        assert_eq!(Ask::read(&set("/a", 1)), None);
        let short = Request::new(Method::named(METHOD), [CALLER_ID, "one", "1"]);
        assert_eq!(Ask::read(&short), None);
    }

    #[test]
    fn each_write_has_an_outcome_and_those_that_did_not_run_take_no_result() {
        let call = set("/a", 1);
        let why = Conflict::Parameter("/a".to_owned());
        let present = Some(Value::Int(2));
        let lost = MergeVerdict::Overtaken(LostWrite { call, why, present });
        let verdicts = [
            MergeVerdict::Apply,
            lost,
            MergeVerdict::Redundant,
            MergeVerdict::Apply,
        ];
        let result = |code: i32, text: &str| {
            let reply: Vec<Value> = vec![code.into(), text.into(), 0.into()];
            Value::Array(vec![reply.into()])
        };
        let reply = Reply::Value(vec![result(1, "done"), result(-1, "no")].into());
        let answer = MergeAnswer::from_reply(&verdicts, &reply);
        let expected = MergeAnswer::Done(vec![
            WriteOutcome::Holds,
            WriteOutcome::Lost {
                why: "the parameter `/a` was changed meanwhile".to_owned(),
                present: Some(Value::Int(2)),
            },
            WriteOutcome::Holds,
            WriteOutcome::Refused("no".to_owned()),
        ]);
        assert_eq!(answer, expected);
        assert_eq!(MergeAnswer::read(&answer.to_reply(), 4), Some(expected));
        assert_eq!(MergeAnswer::read(&answer.to_reply(), 3), None);
        let again = MergeAnswer::Again.to_reply();
        assert_eq!(MergeAnswer::read(&again, 4), Some(MergeAnswer::Again));
    }

    /// Found by the fuzz target `cluster`.
    #[test]
    fn a_value_that_no_answer_can_contain_is_left_out_of_it() {
        let whole = b"<methodCall><methodName>m</methodName><params><param><value><int>18446744073709551615</int></value></param></params></methodCall>";
        let present = Request::decode(whole).unwrap().params().first().cloned();
        assert!(present.is_some());
        let why = "it was changed".to_owned();
        let lost = |present| {
            let why = why.clone();
            MergeAnswer::Done(vec![WriteOutcome::Lost { why, present }])
        };
        let sent = encode_reply(&lost(present).to_reply());
        let read = MergeAnswer::read(&decode_reply(&sent).unwrap(), 1);
        assert_eq!(read, Some(lost(None)));
    }

    #[test]
    fn a_fault_or_a_malformed_answer_is_no_answer() {
        let (code, text) = (1, "method is not supported".to_owned());
        assert_eq!(MergeAnswer::read(&Reply::Fault { code, text }, 1), None);
        let reply: Vec<Value> = vec![(-1).into(), "what?".into(), 0.into()];
        assert_eq!(MergeAnswer::read(&Reply::Value(reply.into()), 1), None);
    }
}
