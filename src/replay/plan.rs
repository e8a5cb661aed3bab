//! Bringing a new master to a state: one call, and what it must answer.

use std::fmt;

use bytes::Bytes;

use super::Token;
use super::inspect::lookup;
use super::restore::{self, Restore};
use crate::master::{CALLER_ID, Master, Method, Request, multicall, returnable};
use crate::xmlrpc::{self, ListWriter, Reply, Value};

/// Most mismatches that are told apart.
const MOST_MISMATCHES: usize = 20;

/// One multicall that brings a master to a state, reads it back and leaves a token.
///
/// # Order
///
/// 1. One `setParam('/', tree)`. Parameters come before their subscribers, who are not told then.
/// 2. Publishers, before there is anybody to be told of them. Types of topics that have neither
///    publishers nor subscribers left, and those that the natural order of calls would put too late
///    in `getTopicTypes`, are brought in silently: a subscription by a helper, undone at once. These
///    are the fewest that give the order.
/// 3. Services, each after the nodes that it was taken from.
/// 4. Subscribers, then subscribers of parameters.
/// 5. Reads of everything, for [`Plan::verify`]. Of addresses only those that the master had before:
///    a registration that was answered with success has the address that it was made with, and a
///    question for each would cost a tenth of the injection.
/// 6. The token: a master that bears it has been brought to the state as a whole.
///
/// On an empty master no callback is sent at all, and every read is answered afterwards as it was
/// before.
///
/// # A master that is not empty
///
/// What it holds is newer, and stays: a node that is there under another address is left out, so
/// that the master bumps nobody, and so is a service that has a provider. Parameters are merged, and
/// ours win. Where the new master has subscribers of a topic that lacks several publishers, they
/// are taken out first and put back before the last publisher: they are told once, with the complete
/// list, while every partial list would make a roscpp node drop its live connections.
///
/// # Memory
///
/// Call and answer are text from the start. As values those of a thousand nodes take ten times as much,
/// and the C library keeps most of what was once taken for so many small pieces.
///
/// # Example
///
/// ```
/// use rosrescue::master::{Master, Method, Request};
/// use rosrescue::replay::{Plan, Token};
///
/// let mut before = Master::default();
/// before.apply(&Request::new(Method::SetParam, ["/node", "/robot", "r2d2"]));
///
/// let mut new = Master::default();
/// let plan = Plan::new(&before, &new, &Token::new("session", 1));
/// let reply = new.apply(&Request::decode(plan.request())?).reply;
/// assert_eq!(plan.verify(&reply), Ok(()));
/// assert_eq!(new.params(), before.params());
/// # Ok::<(), rosrescue::xmlrpc::DecodeError>(())
/// ```
#[derive(Clone, Debug)]
pub struct Plan {
    request: Bytes,
    /// What the request must be answered with.
    answer: Bytes,
    expected: Master,
    skipped: Vec<Skipped>,
}

/// Something of the state that is not brought into a master.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Skipped {
    /// A node that is there under another address.
    Node {
        caller_id: String,
        /// Its address in the state.
        api: String,
        /// Its address in the new master, which stays.
        found_api: String,
    },
    /// A service that has a provider.
    Service {
        service: String,
        /// The provider in the state.
        caller_id: String,
        /// The provider in the new master, which stays.
        found: String,
    },
    /// The reference of a node by a service that another node took over.
    Reference { caller_id: String, service: String },
    /// The type `*` of a topic without publishers that has subscribers in the new master.
    Type { topic: String },
    /// A parameter that the master would take and could not return, alone or in one reply with the
    /// whole tree.
    Param { key: String },
    /// A registration whose key no name leads to.
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
    /// Tokens that `target` or `found` hold themselves are not brought over.
    pub fn new(target: &Master, found: &Master, token: &Token) -> Self {
        Self::write(target, found, None, token)
    }

    /// The plan that brings a master that holds `found` to exactly `target`, and replaces its token
    /// `before` by `token`: everything is taken out, subscribers first, and brought in anew. No node
    /// is called back by it.
    pub fn replace(target: &Master, found: &Master, before: &Token, token: &Token) -> Self {
        Self::write(target, found, Some(before), token)
    }

    fn write(target: &Master, found: &Master, before: Option<&Token>, token: &Token) -> Self {
        let mut request = ListWriter::request(Method::Multicall.name());
        let mut answer = ListWriter::answer();
        let mut write = |call: Request, predicted: Reply| {
            request.push(&call.into_entry());
            answer.push(&multicall::reply_entry(predicted));
        };
        // Tokens are no part of the mirror. They subscribe to what is not set.
        let aside = |call: Request| {
            let predicted = Master::default().apply(&call).reply;
            (call, predicted)
        };
        let mut emptied = None;
        if let Some(before) = before {
            let (call, predicted) = aside(before.remove());
            write(call, predicted);
            let mut model = found.clone();
            for call in restore::removal(found, target) {
                let predicted = model.apply(&call).reply;
                write(call, predicted);
            }
            emptied = Some(model);
        }
        let Restore {
            mut model, skipped, ..
        } = Restore::run(target, emptied.as_ref().unwrap_or(found), &mut write);
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

    /// The body that a rosmaster answers with if it answers each entry as the model predicted.
    pub fn answer(&self) -> &Bytes {
        &self.answer
    }

    /// What the master holds afterwards, the token apart.
    pub fn expected(&self) -> &Master {
        &self.expected
    }

    /// What of the target is not brought over.
    pub fn skipped(&self) -> &[Skipped] {
        &self.skipped
    }

    /// Whether every entry was answered as the model predicted, refusals in whatever words. Not needed for a reply that is
    /// [`Self::answer`] to the byte.
    ///
    /// # Errors
    ///
    /// A sentence for each entry that was not, up to 20 of them. They hold no values.
    pub fn verify(&self, reply: &Reply) -> Result<(), Vec<String>> {
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
            .filter(|((result, predicted), _)| !is_alike(result, predicted))
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

/// Reads that show everything a master in the target state can show, but for addresses that it was
/// given in the same call.
fn reads(model: &Master, found: &Master) -> Vec<Request> {
    let own = |method| Request::new(method, [CALLER_ID]);
    let mut calls = vec![own(Method::GetSystemState), own(Method::GetTopicTypes)];
    // A single value that cannot be returned would fault the whole multicall.
    if returnable::is_writable(model.params()) {
        calls.push(Request::new(Method::GetParam, [CALLER_ID, "/"]));
    }
    let nodes = found.registry.nodes.keys();
    calls.extend(nodes.filter_map(|node| lookup(Method::LookupNode, node)));
    let services = found.registry.services.keys();
    calls.extend(services.filter_map(|service| lookup(Method::LookupService, service)));
    calls
}

/// Whether an entry was answered as predicted. Of a refusal the code counts, and not the text.
fn is_alike(result: &Value, predicted: &Value) -> bool {
    let code = |entry: &Value| entry.as_array()?.first()?.as_array()?.first()?.as_int();
    let refused = code(predicted).filter(|code| *code != 1);
    result == predicted || refused.is_some() && refused == code(result)
}

/// What is said of a call that was answered otherwise than predicted.
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
