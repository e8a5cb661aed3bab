//! Brings a new master to a state with one call, and checks the answer.

use std::fmt;

use bytes::Bytes;

use super::inspect::lookup;
use super::restore::{self, Restore};
use super::{Token, order};
use crate::master::{CALLER_ID, Master, Method, Request, reply_entry, returnable};
use crate::xmlrpc::{self, ListWriter, Reply, Value};

/// Most mismatches to list.
const MOST_MISMATCHES: usize = 20;

/// One multicall that brings a master to a state, reads it back and leaves a token.
///
/// # Order
///
/// 1. One `setParam('/', tree)`. Parameters come before their subscribers, who are then not notified.
/// 2. Publishers, before there are subscribers to notify. Some types are set by a helper's subscription that
///    is undone at once: those of topics without publishers and subscribers, and those that the order of
///    calls would put too late in `getTopicTypes`. Only as many as the order requires.
/// 3. Services, each after its former providers.
/// 4. Subscribers, then subscribers of parameters.
/// 5. Reads of everything, for [`Plan::verify`]. Of addresses only those that the master had before: a
///    successful registration has the address of its call, and reading each would cost a tenth of the
///    injection.
/// 6. The token: a master that bears it has been brought to the whole state.
///
/// On an empty master no callback is sent, and afterwards every read is answered as before.
///
/// # A master that is not empty
///
/// What it holds is newer, and stays. A node that has another address there is left out, so that the master
/// shuts no node down; so is a service that has a provider. Parameters are merged, and ours win. If the new
/// master has subscribers of a topic that lacks several publishers, they are unregistered first and
/// registered again before the last publisher. So they are notified once, with the complete list; every partial list
/// would make a roscpp node drop its live connections.
///
/// # Memory
///
/// Call and answer are text from the start. As values those of a thousand nodes take ten times as much, and
/// the C library keeps most of the memory of so many small allocations.
///
/// # Example
///
/// ```
/// use rescue_core::replay::{Plan, Token};
/// use ros1_master::master::{Master, Method, Request};
///
/// let mut before = Master::default();
/// before.apply(&Request::new(Method::SetParam, ["/node", "/robot", "r2d2"]));
///
/// let mut new = Master::default();
/// let plan = Plan::new(&before, &new, &Token::new("session", 1));
/// let reply = new.apply(&Request::decode(plan.request())?).reply;
/// assert_eq!(plan.verify(&reply), Ok(()));
/// assert_eq!(new.params(), before.params());
/// # Ok::<(), ros1_master::xmlrpc::DecodeError>(())
/// ```
#[derive(Clone, Debug)]
pub struct Plan {
    request: Bytes,
    /// The expected answer.
    answer: Bytes,
    expected: Master,
    skipped: Vec<Skipped>,
}

/// A part of the state that is not brought to the master.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Skipped {
    /// The node has another address in the new master.
    Node {
        caller_id: String,
        /// Its address in the state.
        api: String,
        /// Its address in the new master, which is kept.
        found_api: String,
    },
    /// The service has another provider in the new master.
    Service {
        service: String,
        /// The provider in the state.
        caller_id: String,
        /// The provider in the new master, which is kept.
        found: String,
    },
    /// A node's reference by a service that another node took over.
    Reference { caller_id: String, service: String },
    /// The type `*` of a topic without publishers, but with subscribers in the new master.
    Type { topic: String },
    /// A parameter that the master would accept but could not return, alone or together with the whole tree.
    Param { key: String },
    /// A registration whose key no name resolves to.
    Unnameable { key: String, caller_id: String },
}

impl fmt::Display for Skipped {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Node {
                caller_id,
                api,
                found_api,
            } => write!(
                f,
                "the node `{caller_id}` at {api}: the new master has it at {found_api}"
            ),
            Self::Service {
                service,
                caller_id,
                found,
            } => write!(
                f,
                "the service `{service}` of `{caller_id}`: the new master has it from `{found}`"
            ),
            Self::Reference { caller_id, service } => write!(
                f,
                "the reference of `{caller_id}` by the service `{service}` that it lost: the new \
                 master has that service"
            ),
            Self::Type { topic } => write!(
                f,
                "the type `*` of the topic `{topic}`: its subscribers would be told"
            ),
            Self::Param { key } => write!(
                f,
                "the parameter `{key}`: rosmaster could not return it, or not in one reply with all others"
            ),
            Self::Unnameable { key, caller_id } => {
                write!(f, "`{key}` of `{caller_id}`: no name leads to it")
            }
        }
    }
}

impl Plan {
    /// The plan that brings a master that holds `found` to `target` and leaves `token`.
    ///
    /// Tokens in `target` or `found` are ignored.
    pub fn new(target: &Master, found: &Master, token: &Token) -> Self {
        Self::write(target, found, None, false, token)
    }

    /// The plan that replaces the token `before` of a master that holds `found`, and changes nothing else.
    pub fn renew(found: &Master, before: &Token, token: &Token) -> Self {
        Self::write(found, found, Some(before), false, token)
    }

    /// The plan that brings a master that holds `found` to exactly `target`, and replaces its token `before`
    /// by `token`. Everything is removed, subscribers first, and added again. No node is called back.
    pub fn replace(target: &Master, found: &Master, before: &Token, token: &Token) -> Self {
        Self::write(target, found, Some(before), true, token)
    }

    /// The plan that has a master that holds `behind` run `writes`, and replaces its token `before` by `token`.
    pub fn run(behind: &Master, writes: Vec<Request>, before: &Token, token: &Token) -> Self {
        Self::sequence(behind, Some(before), token, |write| {
            let mut model = behind.clone();
            for call in writes {
                let predicted = model.apply(&call).reply;
                write(call, predicted);
            }
            (model, Vec::new())
        })
    }

    /// `empties`: everything is removed first.
    fn write(
        target: &Master,
        found: &Master,
        before: Option<&Token>,
        empties: bool,
        token: &Token,
    ) -> Self {
        Self::sequence(found, before, token, |write| {
            let mut emptied = None;
            if empties {
                let mut model = found.clone();
                for call in restore::removal(found, target) {
                    let predicted = model.apply(&call).reply;
                    write(call, predicted);
                }
                emptied = Some(model);
            }
            let Restore { model, skipped, .. } =
                Restore::run(target, emptied.as_ref().unwrap_or(found), empties, write);
            (model, skipped)
        })
    }

    /// The plan of the calls that `bring` writes, to a master that holds `found`. It returns the state afterwards,
    /// and what it has left out.
    fn sequence(
        found: &Master,
        before: Option<&Token>,
        token: &Token,
        bring: impl FnOnce(&mut dyn FnMut(Request, Reply)) -> (Master, Vec<Skipped>),
    ) -> Self {
        let mut request = ListWriter::request(Method::Multicall.name());
        let mut answer = ListWriter::answer();
        let mut write = |call: Request, predicted: Reply| {
            request.push(&call.into_entry());
            answer.push(&reply_entry(predicted));
        };
        // Tokens are not a part of the mirror. They subscribe unset keys.
        let aside = |call: Request| {
            let predicted = Master::default().apply(&call).reply;
            (call, predicted)
        };
        if let Some(before) = before {
            let (call, predicted) = aside(before.remove());
            write(call, predicted);
        }
        let (mut model, skipped) = bring(&mut write);
        for call in reads(&model, found) {
            let predicted = model.apply(&call).reply;
            write(call, predicted);
        }
        for call in token.leave() {
            let (call, predicted) = aside(call);
            write(call, predicted);
        }
        Self {
            request: request.finish().into(),
            answer: answer.finish().into(),
            expected: model,
            skipped,
        }
    }

    /// The body of the multicall to send.
    pub fn request(&self) -> &Bytes {
        &self.request
    }

    /// The answer's body if rosmaster answers each entry as the model predicted.
    pub fn answer(&self) -> &Bytes {
        &self.answer
    }

    /// The master's state afterwards, without the token.
    pub fn expected(&self) -> &Master {
        &self.expected
    }

    /// The parts of the target that are not brought to the master.
    pub fn skipped(&self) -> &[Skipped] {
        &self.skipped
    }

    /// Whether every entry was answered as the model predicted; texts of refusals may differ. Not needed if
    /// the reply equals [`Self::answer`] byte for byte.
    ///
    /// # Errors
    ///
    /// A sentence for each entry that was not, up to 20 of them. They hold no parameter values.
    pub fn verify(&self, reply: &Reply) -> Result<(), Vec<String>> {
        self.verify_by(reply, true)
    }

    /// As [`Self::verify`], for a master whose dictionaries have no order.
    ///
    /// # Errors
    ///
    /// The same.
    pub fn verify_in_any_order(&self, reply: &Reply) -> Result<(), Vec<String>> {
        self.verify_by(reply, false)
    }

    fn verify_by(&self, reply: &Reply, ordered: bool) -> Result<(), Vec<String>> {
        let whole = |text: &str| {
            let sentence = format!("the injection as a whole was answered: {text}");
            Err(vec![sentence])
        };
        let call = Request::decode(&self.request);
        let (Ok(call), Ok(predicted)) = (call, xmlrpc::decode_reply(&self.answer)) else {
            return whole("otherwise than predicted");
        };
        let (results, predicted) = match (reply, &predicted) {
            (Reply::Value(Value::Array(results)), Reply::Value(Value::Array(predicted)))
                if results.len() == predicted.len() =>
            {
                (results, predicted)
            }
            (Reply::Fault { text, .. }, _) => return whole(text),
            _ => return whole("another number of results than of calls"),
        };
        let mismatches: Vec<_> = (results.iter().zip(predicted))
            .zip(call.calls())
            .filter(|((result, predicted), call)| {
                let in_any_order = || {
                    let lists = !matches!(call.method(), Method::GetParam);
                    order::sorted(result, lists) == order::sorted(predicted, lists)
                };
                !is_alike(result, predicted) && (ordered || !in_any_order())
            })
            .map(|(_, call)| mismatch(call))
            .take(MOST_MISMATCHES)
            .collect();
        if mismatches.is_empty() {
            Ok(())
        } else {
            Err(mismatches)
        }
    }
}

/// Reads that show everything that a master in the target state can show, except for addresses given in the
/// same call.
fn reads(model: &Master, found: &Master) -> Vec<Request> {
    let own = |method| Request::new(method, [CALLER_ID]);
    let mut calls = vec![own(Method::GetSystemState), own(Method::GetTopicTypes)];
    // A single value that cannot be returned would fault the whole multicall.
    if returnable::is_writable(model.params()) {
        calls.push(Request::new(Method::GetParam, [CALLER_ID, "/"]));
    }
    let nodes = found.registry().nodes.keys();
    calls.extend(nodes.filter_map(|node| lookup(Method::LookupNode, node)));
    let services = found.registry().services.keys();
    calls.extend(services.filter_map(|service| lookup(Method::LookupService, service)));
    calls
}

/// Whether an entry was answered as predicted. Of a refusal only the code is compared.
fn is_alike(result: &Value, predicted: &Value) -> bool {
    let code = |entry: &Value| entry.as_array()?.first()?.as_array()?.first()?.as_int();
    let refused = code(predicted).filter(|code| *code != 1);
    result == predicted || refused.is_some() && refused == code(result)
}

/// Describes a call whose answer was not as predicted.
fn mismatch(call: &Request) -> String {
    let method = call.method();
    let at = match method {
        Method::SubscribeParam => 2,
        _ => 1,
    };
    let subject = call.text(at).map_or_else(String::new, |subject| {
        format!(" of `{subject}` by `{}`", call.caller().unwrap_or_default())
    });
    format!("{method}{subject} was answered otherwise than predicted")
}
