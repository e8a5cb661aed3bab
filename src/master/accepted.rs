//! Which of a call's mutations a master has accepted.

use super::multicall::{self, Entry};
use super::{Master, api};
use crate::xmlrpc::{Call, Reply, Value};

/// The mutating calls, taken out of multicalls, that a master has executed.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Accepted {
    /// The calls in the order of their execution, with the answer to each.
    pub calls: Vec<(Call, Reply)>,
    /// Whether that is known for certain. If not, the master's state has to be read again.
    pub certain: bool,
}

/// Which mutating calls within `call` the master has executed, given its `reply`.
///
/// A call has been executed if its answer's code is 1, and in the few cases where rosmaster changes
/// its state and answers an error: a `setParam` whose callbacks cannot be worked out, a
/// `subscribeParam` of what cannot be returned.
///
/// A multicall that fails as a whole has run up to the entry at fault. Of such a one this gives what
/// `mirror`, the state before the call, would have accepted, and says that it is not certain.
pub fn accepted(mirror: &Master, call: &Call, reply: &Reply) -> Accepted {
    let mut walk = Walk {
        mirror,
        accepted: Accepted {
            calls: Vec::new(),
            certain: true,
        },
    };
    walk.call(&call.method, &call.params, reply, multicall::DEEPEST);
    walk.accepted
}

struct Walk<'a> {
    mirror: &'a Master,
    accepted: Accepted,
}

impl Walk<'_> {
    fn call(&mut self, method: &str, params: &[Value], reply: &Reply, levels: usize) {
        if method == multicall::METHOD {
            return match levels.checked_sub(1) {
                Some(levels) => self.multicall(params, reply, levels),
                None => self.accepted.certain = false,
            };
        }
        if !api::method(method).is_some_and(|method| method.kind.mutates()) {
            return;
        }
        match executed(method, reply) {
            Some(true) => {
                let call = Call::new(method, params.to_vec());
                self.accepted.calls.push((call, reply.clone()));
            }
            Some(false) => {}
            None => self.accepted.certain = false,
        }
    }

    fn multicall(&mut self, params: &[Value], reply: &Reply, levels: usize) {
        let Ok(entries) = multicall::entries(params) else {
            return;
        };
        let results = match reply {
            Reply::Value(Value::Array(results)) if results.len() == entries.len() => results,
            _ => return self.simulate(params, levels),
        };
        for (element, result) in entries.iter().zip(results) {
            if let Entry::Call { method, params } = Entry::new(element) {
                match multicall::entry_reply(result) {
                    Some(reply) => self.call(method, &params, &reply, levels),
                    None => self.accepted.certain = false,
                }
            }
        }
    }

    /// Runs the entries in the mirror, because the master's reply does not say how they went.
    fn simulate(&mut self, params: &[Value], levels: usize) {
        let before = self.accepted.calls.len();
        let mut model = self.mirror.clone();
        for (call, _) in &self.accepted.calls {
            model.apply(call);
        }
        self.run(&mut model, params, levels);
        if self.accepted.calls.len() > before {
            self.accepted.certain = false;
        }
    }

    fn run(&mut self, model: &mut Master, params: &[Value], levels: usize) {
        let Ok(entries) = multicall::entries(params) else {
            return;
        };
        for element in entries.iter() {
            match Entry::new(element) {
                Entry::Malformed(_) => return,
                Entry::Refused(_) => {}
                Entry::Call { method, params } if method == multicall::METHOD => {
                    if let Some(levels) = levels.checked_sub(1) {
                        self.run(model, &params, levels);
                    }
                }
                Entry::Call { method, params } => {
                    let Some(kind) = api::method(method).map(|method| method.kind) else {
                        continue;
                    };
                    if !kind.mutates() {
                        continue;
                    }
                    let call = Call::new(method, params.to_vec());
                    let reply = model.apply(&call).reply;
                    if executed(method, &reply) == Some(true) {
                        self.accepted.calls.push((call, reply));
                    }
                }
            }
        }
    }
}

/// Whether a mutating call has been executed, by its answer; none if it does not say.
///
/// rosmaster has changed its state and answers an error
///
/// * to `setParam`, when it fails in working out the callbacks (a struct with slashes in its keys),
/// * to `subscribeParam` of a nil, and of anything that holds a value that it cannot write.
fn executed(method: &str, reply: &Reply) -> Option<bool> {
    let answer = match reply {
        Reply::Value(Value::Array(answer)) => answer.as_slice(),
        Reply::Fault { text, .. } if method == "subscribeParam" && is_write_error(text) => {
            return Some(true);
        }
        _ => return None,
    };
    let [Value::Int(code), Value::String(message), _] = answer else {
        return None;
    };
    Some(match (code, method) {
        (1, _) => true,
        (_, "setParam") => {
            message.starts_with("Internal failure: ")
                || (message.starts_with("Error: invalid arguments: ")
                    && !message.contains("cannot set root of parameter tree"))
        }
        (_, "subscribeParam") => message == "Internal error (None value returned)",
        _ => false,
    })
}

/// Whether a fault is about writing the reply and not about reading the call.
pub(super) fn is_write_error(text: &str) -> bool {
    [
        "TypeError",
        "OverflowError",
        "RecursionError",
        "RuntimeError",
    ]
    .iter()
    .any(|class| {
        text.strip_prefix("<class '")
            .is_some_and(|text| text.starts_with(class))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::xmlrpc::Struct;

    fn set(key: &str, value: impl Into<Value>) -> Call {
        Call::new("setParam", vec!["/n".into(), key.into(), value.into()])
    }

    fn watched(keys: &[&str]) -> Master {
        let mut master = Master::default();
        for key in keys {
            let params = vec!["/n".into(), "http://n/".into(), (*key).into()];
            master.apply(&Call::new("subscribeParam", params));
        }
        master
    }

    /// What is accepted of `call`, by what the model itself answers.
    fn of(master: &Master, call: &Call) -> Accepted {
        let reply = master.clone().apply(call).reply;
        accepted(master, call, &reply)
    }

    #[test]
    fn a_refused_call_is_not_accepted_and_a_read_never() {
        let master = Master::default();
        assert_eq!(of(&master, &set("/a", 1)).calls.len(), 1);
        assert_eq!(of(&master, &set("/", 1)).calls, []);
        assert_eq!(of(&master, &set("/a", Value::Nil)).calls, []);
        let read = Call::new("getParamNames", vec!["/n".into()]);
        assert_eq!(
            of(&master, &Call::multicall([read.clone(), read])).calls,
            []
        );
    }

    #[test]
    fn entries_are_judged_one_by_one() {
        let inner = Call::multicall([set("/b", 2), set("/", 3)]);
        let call = Call::multicall([set("/a", 1), set("", 1), inner]);
        let found = of(&Master::default(), &call);
        let calls: Vec<_> = found.calls.into_iter().map(|(call, _)| call).collect();
        assert_eq!(calls, [set("/a", 1), set("/b", 2)]);
        assert!(found.certain);
    }

    #[test]
    fn what_came_before_a_malformed_entry_has_run() {
        let mut call = Call::multicall([set("/a", 1), set("/b", 2)]);
        if let Some(Value::Array(entries)) = call.params.first_mut() {
            entries.insert(1, Value::Int(0));
        }
        let found = of(&Master::default(), &call);
        assert_eq!(found.calls.len(), 1);
        assert!(!found.certain);
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
        assert_eq!(answer[..2], [0.into(), "Internal failure: 'x'".into()]);
        assert_ne!(master, after);
        assert_eq!(of(&master, &call).calls.len(), 1);
    }

    #[test]
    fn a_subscription_to_what_cannot_be_returned_has_run() {
        let mut master = Master::default();
        master.apply(&set("/p", Value::Array(vec![Value::Nil])));
        master.apply(&set(
            "/n",
            Value::Struct(Struct::from([("x".to_owned(), Value::Nil)])),
        ));
        for key in ["/p", "/n/x"] {
            let params = vec!["/n".into(), "http://n/".into(), key.into()];
            let found = of(&master, &Call::new("subscribeParam", params));
            assert_eq!((found.calls.len(), found.certain), (1, true), "{key}");
        }
    }
}
