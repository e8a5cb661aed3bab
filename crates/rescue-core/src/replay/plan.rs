//! Brings a new master to a state with one call, and verifies the answer.

use std::fmt;

use bytes::Bytes;

use super::inspect::lookup;
use super::restore::{self, Manner, Restore};
use super::{Token, unordered};
use ros1_master::master::{CALLER_ID, Master, Method, Request, Write, reply_entry, returnable};
use ros1_master::xmlrpc::{self, ListWriter, Reply, Struct, Value};

/// Maximum number of mismatches in an error.
const MISMATCHES_MAX: usize = 20;
/// Part of the fault with which rosmaster answers a multicall if another program sets or deletes a parameter while the
/// answer with all parameters is encoded. CPython says that the dictionary "changed size during iteration", or that its
/// "keys changed during iteration". All calls have been executed by then.
pub(super) const CHANGED_MEANWHILE: &str = "during iteration";

/// One multicall that brings a master to a state, reads it back and leaves a token.
///
/// # Order
///
/// 1. One `setParam('/', tree)`, right after a `getParam('/')` that shows what it overwrites. Parameters come before
///    their subscribers, so these are not notified.
/// 2. Publishers, before there are subscribers to notify. Some topic types are set by a helper that subscribes and
///    unsubscribes at once: types of topics without publishers and subscribers, and types that the order of the calls
///    would put too late in `getTopicTypes`. The plan sets no more types in this way than the order requires.
/// 3. Services, each after the nodes that provided it before.
/// 4. Subscribers, then subscribers of parameters.
/// 5. Reads of everything, for [`Plan::verify`]. Addresses are read back only where the master had one before. The
///    other addresses are certain, because a successful registration has the address of its call. Reading all addresses
///    would take a tenth of the injection's time.
/// 6. The token: a master that has it has been brought to the whole state.
///
/// An empty master sends no callback because of this call, and afterwards answers every read as the old master did.
///
/// # A master that is not empty
///
/// What such a master holds is newer than the target, and stays. The plan leaves out a node that has another address in
/// the master, so that the master shuts no node down. It also leaves out a service that has a provider in the master.
/// Parameters are merged, and the target's values win. If the new master already has subscribers of a topic that lacks
/// several publishers, the plan unregisters these subscribers first and registers them again just before the last
/// publisher. So they are notified once, with the complete list. A partial list would make a roscpp node drop live
/// connections.
///
/// # Memory
///
/// The call and its answer are built as text. For a thousand nodes, values would take ten times as much memory. The C
/// library would keep most of that memory, because it consists of many small allocations.
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
    /// The body of the answer that a rosmaster is expected to send.
    answer: Bytes,
    expected: Master,
    skipped: Vec<Skipped>,
}

/// A part of the state that is not restored in the new master.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Skipped {
    /// The node has another address in the new master.
    Node {
        caller_id: String,
        /// The node's address in the restored state.
        api: String,
        /// The node's address in the new master, which stays.
        found_api: String,
    },
    /// The service has another provider in the new master.
    Service {
        service: String,
        /// The provider in the restored state.
        caller_id: String,
        /// The provider in the new master, which stays.
        found: String,
    },
    /// The reference to a node that exists only because another node has taken over this service.
    Reference { caller_id: String, service: String },
    /// The type `*` of a topic that has no publishers, but subscribers in the new master.
    Type { topic: String },
    /// A parameter that the master would accept but could not return, alone or with the whole tree.
    Param { key: String },
    /// A registration under a key that no call can name.
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
                "the service `{service}` of `{caller_id}`: in the new master `{found}` provides it"
            ),
            Self::Reference { caller_id, service } => write!(
                f,
                "the reference to `{caller_id}`, which has lost the service `{service}`: the new \
                 master has that service"
            ),
            Self::Type { topic } => write!(
                f,
                "the type `*` of the topic `{topic}`: setting it would notify its subscribers"
            ),
            Self::Param { key } => write!(
                f,
                "the parameter `{key}`: rosmaster could not return it, or not together with all others"
            ),
            Self::Unnameable { key, caller_id } => {
                write!(f, "`{key}` of `{caller_id}`: no call can name it")
            }
        }
    }
}

impl Plan {
    /// Plans to bring a master whose state is `found` to `target`, and to leave `token` in it.
    ///
    /// Tokens in `target` and `found` are ignored.
    pub fn new(target: &Master, found: &Master, token: &Token) -> Self {
        Self::write(target, found, None, Manner::Add, token)
    }

    /// Like [`Self::new`], but the parameters become exactly those of `target`. Each that differs is set or deleted by
    /// its own call, so nothing is overwritten that another program sets at the same time.
    pub fn repair(target: &Master, found: &Master, token: &Token) -> Self {
        Self::write(target, found, None, Manner::Repair, token)
    }

    /// Plans to replace the token `before` of a master whose state is `found`, and to change nothing else.
    pub fn renew(found: &Master, before: &Token, token: &Token) -> Self {
        Self::write(found, found, Some(before), Manner::Add, token)
    }

    /// Plans to bring a master whose state is `found` to exactly `target`, and to replace its token `before` by
    /// `token`. Registrations are removed, subscribers first, and added again. No node is notified.
    pub fn replace(target: &Master, found: &Master, before: &Token, token: &Token) -> Self {
        Self::write(target, found, Some(before), Manner::Replace, token)
    }

    /// Plans to bring a master that holds exactly `found`, because it was given that just now, to exactly `target`, and to
    /// replace its token `before` by `token`. Only what differs is removed and added; no node is notified. Nothing is read
    /// back: the answers to these few calls show whether they were executed. If the order of a list would differ from
    /// that of `target`, the plan is that of [`Self::replace`].
    pub fn update(target: &Master, found: &Master, before: &Token, token: &Token) -> Self {
        let plan = Self::write(target, found, Some(before), Manner::Update, token);
        match plan.expected() == target {
            true => plan,
            false => Self::replace(target, found, before, token),
        }
    }

    /// Plans to run `writes` on a master whose state is `behind`, and to replace its token `before` by `token`.
    pub fn run(behind: &Master, writes: Vec<Request>, before: &Token, token: &Token) -> Self {
        Self::sequence(Some(behind), Some(before), token, |write| {
            let mut model = behind.clone();
            for call in writes {
                let predicted = model.apply(&call).reply;
                write(call, predicted);
            }
            (model, Vec::new())
        })
    }

    /// Plans the calls that bring a master from `found` to `target`. To [replace](Manner::Replace), the first calls
    /// remove all registrations; to [update](Manner::Update), those that differ.
    fn write(
        target: &Master,
        found: &Master,
        before: Option<&Token>,
        manner: Manner,
        token: &Token,
    ) -> Self {
        let (removed, last) = match manner {
            Manner::Replace => (restore::removal(found), Vec::new()),
            Manner::Update => restore::outdated(found, target),
            Manner::Add | Manner::Repair => (Vec::new(), Vec::new()),
        };
        let reads_back = (manner != Manner::Update).then_some(found);
        Self::sequence(reads_back, before, token, |write| {
            let mut emptied = found.clone();
            for call in removed {
                let predicted = emptied.apply(&call).reply;
                write(call, predicted);
            }
            let restored = Restore::run(target, &emptied, manner, &mut *write);
            let (mut model, skipped) = (restored.model, restored.skipped);
            for call in last {
                let predicted = model.apply(&call).reply;
                write(call, predicted);
            }
            (model, skipped)
        })
    }

    /// Plans the calls that `bring` writes. `bring` returns the resulting state and what it has left out. The master is
    /// read back unless `found`, the state that it had before, is `None`.
    fn sequence(
        found: Option<&Master>,
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
        // A token is not part of the mirror. It subscribes to a key that is not set, so an empty model predicts the
        // right answer.
        let aside = |call: Request| {
            let predicted = Master::default().apply(&call).reply;
            (call, predicted)
        };
        if let Some(before) = before {
            let (call, predicted) = aside(before.remove());
            write(call, predicted);
        }
        let (mut model, skipped) = bring(&mut write);
        for call in found.map_or_else(Vec::new, |found| reads(&model, found)) {
            let predicted = model.apply(&call).reply;
            write(call, predicted);
        }
        for call in token.set_calls() {
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

    /// The answer's body, if rosmaster answers every entry as the model predicts.
    pub fn answer(&self) -> &Bytes {
        &self.answer
    }

    /// The state of the master after the call, without the token.
    pub fn expected(&self) -> &Master {
        &self.expected
    }

    /// The parts of the target that the plan leaves out.
    pub fn skipped(&self) -> &[Skipped] {
        &self.skipped
    }

    /// Checks that every entry was answered as predicted. The texts may differ. Not needed if the reply
    /// equals [`Self::answer`] byte for byte.
    ///
    /// # Errors
    ///
    /// How the answers differ.
    pub fn verify(&self, reply: &Reply) -> Result<(), Deviation> {
        self.verify_by(reply, true)
    }

    /// Like [`Self::verify`], but also accepts answers that differ only in the order of names and struct members. A
    /// master with unordered dictionaries gives such answers.
    ///
    /// # Errors
    ///
    /// As for [`Self::verify`].
    pub fn verify_in_any_order(&self, reply: &Reply) -> Result<(), Deviation> {
        self.verify_by(reply, false)
    }

    fn verify_by(&self, reply: &Reply, ordered: bool) -> Result<(), Deviation> {
        let mut deviation = Deviation::default();
        let whole = |text: &str| vec![format!("the whole injection was answered with {text}")];
        let call = Request::decode(&self.request);
        let (Ok(call), Ok(predicted)) = (call, xmlrpc::decode_reply(&self.answer)) else {
            deviation.failed = whole("something else than predicted");
            return Err(deviation);
        };
        let (results, predicted) = match (reply, &predicted) {
            (Reply::Value(Value::Array(results)), Reply::Value(Value::Array(predicted)))
                if results.len() == predicted.len() =>
            {
                (results, predicted)
            }
            (Reply::Fault { text, .. }, _) => {
                deviation.beyond_params = true;
                match text.contains(CHANGED_MEANWHILE) {
                    true => deviation.changed = whole(text),
                    false => deviation.failed = whole(text),
                }
                return Err(deviation);
            }
            _ => {
                deviation.failed = whole("another number of results than there were calls");
                return Err(deviation);
            }
        };
        let calls = call.calls();
        for (index, (result, predicted)) in results.iter().zip(predicted).enumerate() {
            let Some(call) = calls.get(index) else { break };
            let in_any_order = || {
                let lists = !matches!(call.method(), Method::GetParam);
                let values = [result, predicted]
                    .map(|entry| value(entry).map(|value| unordered::sorted(value, lists)));
                code(result) == code(predicted) && values[0].is_some() && values[0] == values[1]
            };
            if is_alike(result, predicted) || !ordered && in_any_order() {
                continue;
            }
            if calls.get(index + 1).is_some_and(|next| sets_all(next)) {
                deviation.overwritten = value(result).and_then(Value::as_struct).cloned();
            }
            deviation.beyond_params |= *call.method() != Method::GetParam;
            // A registration is answered with the other nodes of its topic, which another program may have registered.
            let list = match !call.kind().mutates() || code(result) == code(predicted) {
                true => &mut deviation.changed,
                false => &mut deviation.failed,
            };
            if list.len() < MISMATCHES_MAX {
                list.push(mismatch(call));
            }
        }
        match deviation == Deviation::default() {
            true => Ok(()),
            false => Err(deviation),
        }
    }

    /// The state that a master must have, after it has answered this plan with `deviation`, for [`Self::repair`].
    /// `target` is the plan's target, `found` what the master held before, and `now` what it has held since.
    ///
    /// Parameters that another program has set or deleted since `found` was read count as newer, unless the target
    /// differs from `found` in the same ones. What the master lacks of the rest is given to it again.
    pub fn remaining(
        &self,
        target: &Master,
        found: &Master,
        deviation: &Deviation,
        now: &Master,
    ) -> Master {
        let given = self.expected.params();
        let mut tree = given.clone();
        if let Some(overwritten) = &deviation.overwritten {
            tree = restore::changed(found.params(), given, overwritten);
        }
        tree = match deviation.failed.is_empty() {
            true => restore::changed(given, now.params(), &tree),
            // It is not known whether the master has executed the `setParam`.
            false => restore::merged(&tree, now.params()),
        };
        let mut wanted = target.clone();
        let params = [CALLER_ID.into(), "/".into(), Value::Struct(tree)];
        wanted.apply_telling(&Request::new(Method::SetParam, params), &mut ());
        wanted
    }
}

/// How a master has answered a plan differently than predicted.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Deviation {
    /// A sentence for each call that was not executed, at most 20, without parameter values.
    pub failed: Vec<String>,
    /// A sentence for each answer that shows that another program has changed the master since it was read, at most 20.
    pub changed: Vec<String>,
    /// Whether more than the reads of parameters was answered differently.
    pub beyond_params: bool,
    /// The parameters that the plan has overwritten, if they were not those that the master held when it was read.
    pub overwritten: Option<Struct>,
}

/// The reads that check the whole target state. Looks up only addresses that the master had before, because the others
/// are set by the plan itself.
fn reads(model: &Master, found: &Master) -> Vec<Request> {
    let own = |method| Request::new(method, [CALLER_ID]);
    let mut calls = vec![own(Method::GetSystemState), own(Method::GetTopicTypes)];
    // A single value that cannot be returned would make the whole multicall fail.
    if returnable::is_writable(model.params()) {
        calls.push(Request::new(Method::GetParam, [CALLER_ID, "/"]));
    }
    let nodes = found.registry().nodes.keys();
    calls.extend(nodes.filter_map(|node| lookup(Method::LookupNode, node)));
    let services = found.registry().services.keys();
    calls.extend(services.filter_map(|service| lookup(Method::LookupService, service)));
    calls
}

/// The code of a call's answer in a multicall. `None` for a fault.
fn code(entry: &Value) -> Option<i32> {
    entry.as_array()?.first()?.as_array()?.first()?.as_int()
}

/// The value of a call's answer in a multicall.
fn value(entry: &Value) -> Option<&Value> {
    entry.as_array()?.first()?.as_array()?.get(2)
}

/// Whether `call` sets the whole parameter tree.
fn sets_all(call: &Request) -> bool {
    *call.method() == Method::SetParam && call.text(1) == Some("/")
}

/// Whether an entry was answered as predicted, whatever the text. For a refusal only the code is compared.
fn is_alike(result: &Value, predicted: &Value) -> bool {
    let code = code(predicted).filter(|predicted| code(result) == Some(*predicted));
    let in_words = || code.is_some_and(|code| code != 1 || value(result) == value(predicted));
    result == predicted || in_words()
}

/// Names a call that was not answered as predicted.
fn mismatch(call: &Request) -> String {
    let method = call.method();
    let write = Write::parse(call);
    let name = write.as_ref().map(Write::name).or_else(|| call.text(1));
    let subject = name.map_or_else(String::new, |name| {
        format!(" of `{name}` by `{}`", call.caller().unwrap_or_default())
    });
    format!("{method}{subject} was not answered as predicted")
}
