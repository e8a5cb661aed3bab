//! Finds out which writes of a call a master has executed, and whether the mirror agrees.

use super::unordered;
use ros1_master::master::{Entry, Master, Method, Request, entry_reply, is_success};
use ros1_master::xmlrpc::{Reply, Value};

/// A write that the master has answered, perhaps as an entry of a multicall.
#[derive(Clone, Debug, PartialEq)]
pub struct Answered<'a> {
    pub call: &'a Request,
    /// The master's answer.
    pub reply: Reply,
    /// Whether the write changed the master's state.
    pub executed: bool,
    /// Whether the master's dictionaries are unordered, as on Python 2.
    pub unordered: bool,
}

impl Answered<'_> {
    /// Whether `mirror`, the mirror's answer to the same call, shows that mirror and master have the same state and
    /// return the same value. Two refusals agree, whatever their text.
    ///
    /// `live` says that later entries of the same multicall may have written parameters. If so, a `subscribeParam` may
    /// return the later values, because rosmaster encodes its own dictionary after all entries have run. A value that
    /// cannot be encoded may also have been replaced before that.
    pub fn agrees(&self, mirror: &Reply, live: bool) -> bool {
        let method = self.call.method();
        let live = live && *method == Method::SubscribeParam;
        let same = match [&self.reply, mirror].map(is_success) {
            [true, true] => {
                let in_any_order = || self.unordered && unordered::are_alike(&self.reply, mirror);
                live || self.reply == *mirror || in_any_order()
            }
            [true, false] => live,
            [false, true] => false,
            [false, false] => true,
        };
        same && executed(method, mirror) == Some(self.executed)
    }

    /// Whether only the text of `mirror` differs, as with a patched rosmaster or one of another version.
    pub fn differs_in_words(&self, mirror: &Reply) -> bool {
        let parts = [&self.reply, mirror].map(|reply| match reply {
            Reply::Value(Value::Array(answer)) => match answer.as_slice() {
                [code, _, value] => Some((code, value)),
                _ => None,
            },
            _ => None,
        });
        match parts {
            [Some(master), Some(mirror)] => master == mirror,
            _ => false,
        }
    }
}

/// All writes in a request that the master has answered, including those in nested multicalls.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Accepted<'a> {
    /// The writes in the order in which the master executed them.
    pub calls: Vec<Answered<'a>>,
    /// Whether this list is certainly complete and correct. If not, the master's state must be read again.
    pub certain: bool,
}

/// The writes in `call` that the master has answered, according to its `reply`.
///
/// A write has been executed if its answer has code 1. In a few cases rosmaster changes its state and still answers
/// with an error: to a `setParam` whose callbacks cannot be computed, and to a `subscribeParam` of a value that cannot
/// be returned.
///
/// A multicall that fails as a whole has run up to the entry that failed. For such a multicall, this function returns
/// the writes that `mirror`, the state before the call, would have executed, and marks the result as not certain.
pub fn accepted<'a>(mirror: &Master, call: &'a Request, reply: &Reply) -> Accepted<'a> {
    let mut walk = Walk {
        mirror,
        model: None,
        modelled: 0,
        accepted: Accepted {
            calls: Vec::new(),
            certain: true,
        },
    };
    walk.call(call, reply);
    walk.accepted
}

struct Walk<'m, 'a> {
    mirror: &'m Master,
    /// The mirror after the first `modelled` accepted calls. Created when it is first needed.
    model: Option<Master>,
    modelled: usize,
    accepted: Accepted<'a>,
}

impl<'a> Walk<'_, 'a> {
    fn call(&mut self, request: &'a Request, reply: &Reply) {
        if *request.method() == Method::Multicall {
            return self.multicall(request, reply);
        }
        if !request.kind().mutates() {
            return;
        }
        match executed(request.method(), reply) {
            Some(executed) => self.push(request, reply.clone(), executed),
            None => self.accepted.certain = false,
        }
    }

    fn push(&mut self, call: &'a Request, reply: Reply, executed: bool) {
        self.accepted.calls.push(Answered {
            call,
            reply,
            executed,
            unordered: !self.mirror.python().keeps_order(),
        });
    }

    fn multicall(&mut self, request: &'a Request, reply: &Reply) {
        let entries = request.entries();
        let results = match reply {
            Reply::Value(Value::Array(results)) if results.len() == entries.len() => results,
            Reply::Fault { .. } => return self.simulate(request),
            // This is not an answer of rosmaster. Only reading the master can show the effect of the call.
            Reply::Value(_) => {
                self.accepted.certain = false;
                return;
            }
        };
        for (entry, result) in entries.iter().zip(results) {
            if let Entry::Request(request) = entry {
                match entry_reply(result) {
                    Some(reply) => self.call(request, &reply),
                    None => self.accepted.certain = false,
                }
            }
        }
    }

    /// Runs the entries on a model, because the master's reply does not show their results.
    fn simulate(&mut self, request: &'a Request) {
        for call in request.calls() {
            if !call.kind().mutates() {
                continue;
            }
            let reply = self.predict(call);
            if executed(call.method(), &reply) == Some(true) {
                self.push(call, reply, true);
                self.modelled += 1;
                self.accepted.certain = false;
            }
        }
    }

    /// The model's answer to a call, after the calls accepted so far. The model is kept, because many multicalls may
    /// have to be simulated.
    fn predict(&mut self, request: &Request) -> Reply {
        let model = self.model.get_or_insert_with(|| self.mirror.clone());
        for answered in self.accepted.calls.iter().skip(self.modelled) {
            model.apply_telling(answered.call, &mut ());
        }
        self.modelled = self.accepted.calls.len();
        model.apply_telling(request, &mut ())
    }
}

/// Whether a write has been executed, according to its answer. `None` if that is unclear.
///
/// rosmaster changes its state and answers an error nevertheless
///
/// * to `setParam`, if it cannot compute the callbacks (for a struct with slashes in its keys),
/// * to `subscribeParam`, if the value is nil or holds anything that it cannot encode.
fn executed(method: &Method, reply: &Reply) -> Option<bool> {
    let answer = match reply {
        Reply::Value(Value::Array(answer)) => answer.as_slice(),
        Reply::Fault { text, .. } if *method == Method::SubscribeParam && is_write_error(text) => {
            return Some(true);
        }
        _ => return None,
    };
    let [Value::Int(code), Value::String(message), _] = answer else {
        return None;
    };
    Some(match (code, method) {
        (1, _) => true,
        (_, Method::SetParam) => {
            message.starts_with("Internal failure: ")
                || (message.starts_with("Error: invalid arguments: ")
                    && !message.contains("cannot set root of parameter tree"))
        }
        (_, Method::SubscribeParam) => message == "Internal error (None value returned)",
        _ => false,
    })
}

/// Whether a fault concerns the encoding of the reply, instead of the decoding of the call.
pub(super) fn is_write_error(text: &str) -> bool {
    // The first form is from Python 3, the second from Python 2.
    let mut prefixes = ["<class '", "<type 'exceptions."].into_iter();
    let class = prefixes.find_map(|prefix| text.strip_prefix(prefix));
    let classes = [
        "TypeError",
        "OverflowError",
        "RecursionError",
        "RuntimeError",
    ];
    class.is_some_and(|class| classes.iter().any(|of| class.starts_with(of)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros1_master::xmlrpc::Struct;
    use test_support::calls::malformed;

    #[test]
    fn two_refusals_agree_and_a_refusal_does_not_agree_with_a_success() {
        let answer = |code: i32, text: &str, value: Value| {
            Reply::Value(vec![Value::from(code), text.into(), value].into())
        };
        let delete = Request::new(Method::DeleteParam, [Value::from("/n"), "/a".into()]);
        let refused = answer(-1, "parameter [/a] is not set", 0.into());
        let done = answer(1, "parameter /a deleted", 0.into());
        let of = accepted(&Master::default(), &delete, &refused)
            .calls
            .remove(0);
        assert!(of.agrees(&refused, false));
        assert!(!of.agrees(&done, false));
        let other = answer(-1, "no such parameter", 0.into());
        assert!(of.agrees(&other, false));
    }

    #[test]
    fn a_subscription_may_return_what_the_same_multicall_writes_later() {
        let answer =
            |value: i32| Reply::Value(vec![Value::from(1), "".into(), value.into()].into());
        let params = [Value::from("/n"), "http://n/".into(), "/a".into()];
        let subscribe = Request::new(Method::SubscribeParam, params);
        let of = accepted(&Master::default(), &subscribe, &answer(2))
            .calls
            .remove(0);
        assert!(of.agrees(&answer(1), true));
        assert!(!of.agrees(&answer(1), false));
        // A value that could not be encoded has been replaced by then.
        let fault = |class: &str| Reply::Fault {
            code: 1,
            text: format!("<class '{class}'>:cannot marshal it"),
        };
        assert!(of.agrees(&fault("TypeError"), true));
        assert!(!of.agrees(&fault("TypeError"), false));
        assert!(!of.agrees(&fault("Exception"), true));
        let python_2 = Reply::Fault {
            code: 1,
            text: "<type 'exceptions.OverflowError'>:int exceeds XML-RPC limits".to_owned(),
        };
        assert!(of.agrees(&python_2, true));
        // A `setParam` that has run and then failed has its own message.
        let failed = |text: &str| answer_with(0, &format!("Internal failure: {text}"));
        let set = set("/a", 1);
        let of = accepted(&Master::default(), &set, &failed("'x'"));
        assert!(of.calls[0].agrees(&failed("y"), false));
        let refused = answer_with(-1, "ERROR: parameter [key] must be a string");
        assert!(!of.calls[0].agrees(&refused, false));
    }

    fn answer_with(code: i32, text: &str) -> Reply {
        Reply::Value(vec![Value::from(code), text.into(), 0.into()].into())
    }

    fn set(key: &str, value: impl Into<Value>) -> Request {
        Request::new(
            Method::SetParam,
            [Value::from("/n"), key.into(), value.into()],
        )
    }

    fn watched(keys: &[&str]) -> Master {
        let mut master = Master::default();
        for key in keys {
            let params = [Value::from("/n"), "http://n/".into(), (*key).into()];
            master.apply(&Request::new(Method::SubscribeParam, params));
        }
        master
    }

    /// The executed calls.
    fn executed(accepted: Accepted<'_>) -> Vec<Request> {
        let executed = accepted.calls.into_iter().filter(|of| of.executed);
        executed.map(|of| of.call.clone()).collect()
    }

    /// The accepted writes of `call`, according to the model's own answer.
    fn accepted_by_model<'a>(master: &Master, call: &'a Request) -> Accepted<'a> {
        let reply = master.clone().apply(call).reply;
        accepted(master, call, &reply)
    }

    #[test]
    fn refused_calls_and_reads_are_not_accepted() {
        let master = Master::default();
        assert_eq!(
            executed(accepted_by_model(&master, &set("/a", 1))),
            [set("/a", 1)]
        );
        assert_eq!(executed(accepted_by_model(&master, &set("/", 1))), []);
        assert_eq!(
            executed(accepted_by_model(&master, &set("/a", Value::Nil))),
            []
        );
        let read = Request::new(Method::GetParamNames, [Value::from("/n")]);
        assert_eq!(
            accepted_by_model(&master, &Request::multicall([read.clone(), read])).calls,
            []
        );
    }

    #[test]
    fn each_entry_of_a_multicall_is_judged_by_its_own_result() {
        let inner = Request::multicall([set("/b", 2), set("/", 3)]);
        let call = Request::multicall([set("/a", 1), set("", 1), inner]);
        let found = accepted_by_model(&Master::default(), &call);
        assert!(found.certain);
        assert_eq!(executed(found), [set("/a", 1), set("/b", 2)]);
    }

    #[test]
    fn entries_before_a_malformed_one_have_run() {
        let call = malformed(Request::multicall([set("/a", 1)]));
        let found = accepted_by_model(&Master::default(), &call);
        assert_eq!(found.calls.len(), 1);
        assert!(!found.certain);
    }

    /// The model must not be built again for each nested multicall: that would take hours.
    #[test]
    fn many_failing_multicalls_inside_a_long_one_are_judged_quickly() {
        let count = 20_000;
        let sets = (0..count).map(|index| set(&format!("/p{index}"), 1));
        let fails = (0..count)
            .map(|index| malformed(Request::multicall([set("/q", index), set("/", index)])));
        let call = Request::multicall(sets.chain(fails));
        let found = accepted_by_model(&Master::default(), &call);
        assert!(!found.certain);
        assert_eq!(executed(found).len(), 40_000);
    }

    #[test]
    fn a_reply_that_does_not_fit_a_multicall_accepts_nothing_and_is_uncertain() {
        let call = Request::multicall([set("/a", 1)]);
        for value in [Value::Int(1), Value::Array(vec![])] {
            let found = accepted(&Master::default(), &call, &Reply::Value(value));
            assert_eq!((found.calls, found.certain), (vec![], false));
        }
    }

    #[test]
    fn a_set_param_whose_callbacks_fail_has_run() {
        let master = watched(&["/k/x/y"]);
        let call = set(
            "/k",
            Value::Struct(Struct::from([("x/y".to_owned(), 1.into())])),
        );
        let mut after = master.clone();
        let Reply::Value(Value::Array(answer)) = after.apply(&call).reply else {
            panic!()
        };
        assert_eq!(answer[0], 0.into());
        assert_ne!(master, after);
        assert_eq!(accepted_by_model(&master, &call).calls.len(), 1);
    }

    #[test]
    fn a_subscription_to_an_unreturnable_value_has_run() {
        let mut master = Master::default();
        master.apply(&set("/p", Value::Array(vec![Value::Nil])));
        master.apply(&set(
            "/n",
            Value::Struct(Struct::from([("x".to_owned(), Value::Nil)])),
        ));
        for key in ["/p", "/n/x"] {
            let params = [Value::from("/n"), "http://n/".into(), key.into()];
            let call = Request::new(Method::SubscribeParam, params);
            let found = accepted_by_model(&master, &call);
            assert_eq!((found.calls.len(), found.certain), (1, true), "{key}");
        }
    }
}
