//! Classifies calls: read, write, or known only to the master.

use super::multicall::{self, Entry};
use super::{api, names, python};
use crate::xmlrpc::{Call, Value};

/// What a call may do, by its method's name alone; for a multicall, by its entries.
///
/// ```text
///            Shutdown
///               |
///             Mutate
///             /    \
///     Unregister   Unknown
///             \    /
///              Read
///               |
///            Identity
/// ```
///
/// A multicall is the least kind that is above all its entries, nested ones too: a call that
/// unregisters and also does something unknown must be recorded and must go to the master, so it is
/// a `Mutate`. Entries behind a malformed one never run and count all the same.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Kind {
    /// `getPid`, `getUri`: answers about the master's process.
    Identity,
    /// Changes nothing.
    Read,
    /// `unregister*`, `unsubscribeParam`: takes something away that the caller registered.
    Unregister,
    /// A method that the Master API does not have, or a multicall that cannot run.
    Unknown,
    /// `register*`, `setParam`, `deleteParam`, `subscribeParam`: changes state.
    Mutate,
    /// Ends the master.
    Shutdown,
}

impl Kind {
    /// Whether the call may change the master's state, and so has to be recorded.
    pub fn mutates(self) -> bool {
        matches!(self, Self::Unregister | Self::Mutate)
    }

    /// The least kind above both.
    #[must_use]
    pub fn join(self, other: Self) -> Self {
        match (self, other) {
            (Self::Unregister, Self::Unknown) | (Self::Unknown, Self::Unregister) => Self::Mutate,
            _ if self.rank() >= other.rank() => self,
            _ => other,
        }
    }

    fn rank(self) -> u8 {
        match self {
            Self::Identity => 0,
            Self::Read => 1,
            Self::Unregister | Self::Unknown => 2,
            Self::Mutate => 3,
            Self::Shutdown => 4,
        }
    }
}

/// What sort of call this is.
pub fn kind(call: &Call) -> Kind {
    kind_within(&call.method, &call.params, multicall::DEEPEST)
}

fn kind_within(method: &str, params: &[Value], levels: usize) -> Kind {
    if method != multicall::METHOD {
        return api::method(method).map_or(Kind::Unknown, |method| method.kind);
    }
    let (Ok(entries), Some(levels)) = (multicall::entries(params), levels.checked_sub(1)) else {
        return Kind::Unknown;
    };
    let mut kind = Kind::Identity;
    for (index, element) in entries.iter().enumerate() {
        kind = kind.join(match Entry::new(element) {
            Entry::Call { method, params } => kind_within(method, &params, levels),
            Entry::Refused(_) => Kind::Unknown,
            // What came before it has run, and the reply does not say how it went.
            Entry::Malformed(_) if index > 0 => Kind::Mutate,
            Entry::Malformed(_) => Kind::Unknown,
        });
    }
    if entries.is_empty() { Kind::Read } else { kind }
}

/// Whether the mirror may answer the call alone: it, and every entry of a multicall, is one of the
/// Master API, well formed and no `shutdown`, so that the model answers it as any master does; and a
/// master can be brought to what it leads to, which one cannot to a parameter that it could not return.
pub fn is_answerable(call: &Call) -> bool {
    is_answerable_within(&call.method, &call.params, multicall::DEEPEST)
}

fn is_answerable_within(method: &str, params: &[Value], levels: usize) -> bool {
    if method != multicall::METHOD {
        let known = api::method(method).is_some_and(|method| method.kind != Kind::Shutdown);
        return known && (method != "setParam" || is_restorable(params));
    }
    let (Ok(entries), Some(levels)) = (multicall::entries(params), levels.checked_sub(1)) else {
        return false;
    };
    entries.iter().all(|element| match Entry::new(element) {
        Entry::Call { method, params } => is_answerable_within(method, &params, levels),
        Entry::Refused(_) | Entry::Malformed(_) => false,
    })
}

/// Whether a `setParam` with these parameters sets what a master can return.
fn is_restorable(params: &[Value]) -> bool {
    let [Value::String(caller_id), Value::String(key), value] = params else {
        // It is refused.
        return true;
    };
    let key = names::resolve(key, caller_id);
    python::is_readable_at(names::parts(&key).count(), value)
}

/// The writes in `call`, taken out of multicalls, in order.
pub fn writes(call: &Call) -> Vec<Call> {
    let mut found = Vec::new();
    collect_writes(&call.method, &call.params, multicall::DEEPEST, &mut found);
    found
}

fn collect_writes(method: &str, params: &[Value], levels: usize, found: &mut Vec<Call>) {
    if method != multicall::METHOD {
        if api::method(method).is_some_and(|method| method.kind.mutates()) {
            found.push(Call::new(method, params.to_vec()));
        }
        return;
    }
    if let (Ok(entries), Some(levels)) = (multicall::entries(params), levels.checked_sub(1)) {
        for element in entries.iter() {
            if let Entry::Call { method, params } = Entry::new(element) {
                collect_writes(method, &params, levels, found);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn call(method: &str) -> Call {
        Call::new(method, vec!["/n".into()])
    }

    fn of(methods: &[&str]) -> Kind {
        kind(&Call::multicall(methods.iter().map(|method| call(method))))
    }

    #[test]
    fn a_multicall_is_the_least_kind_above_its_entries() {
        assert_eq!(of(&[]), Kind::Read);
        assert_eq!(of(&["getPid"]), Kind::Identity);
        assert_eq!(of(&["getPid", "getParam"]), Kind::Read);
        assert_eq!(of(&["getParam", "unregisterPublisher"]), Kind::Unregister);
        assert_eq!(of(&["getParam", "nonsense"]), Kind::Unknown);
        assert_eq!(of(&["unregisterService", "nonsense"]), Kind::Mutate);
        assert_eq!(of(&["unregisterService", "setParam"]), Kind::Mutate);
        assert_eq!(of(&["setParam", "shutdown", "nonsense"]), Kind::Shutdown);
        let nested = Call::multicall([Call::multicall([call("subscribeParam")]), call("getPid")]);
        assert_eq!(kind(&nested), Kind::Mutate);
    }

    #[test]
    fn what_only_a_master_could_know_is_told_apart() {
        for method in ["registerService", "getPid", "unsubscribeParam"] {
            assert!(is_answerable(&call(method)), "{method}");
        }
        for method in ["shutdown", "nonsense", "system.listMethods"] {
            assert!(!is_answerable(&call(method)), "{method}");
            let inner = Call::multicall([call("setParam"), call(method)]);
            assert!(!is_answerable(&Call::multicall([inner])), "{method}");
        }
        let inner = Call::multicall([call("setParam"), call("getParam")]);
        assert!(is_answerable(&Call::multicall([inner])));
        let malformed = vec![Value::Array(vec![Value::Int(1)])];
        assert!(!is_answerable(&Call::new(multicall::METHOD, malformed)));
        let set = |value| Call::new("setParam", vec!["/n".into(), "/a".into(), value]);
        assert!(is_answerable(&set(1.into())) && !is_answerable(&set(vec![Value::Nil].into())));
    }

    #[test]
    fn a_malformed_multicall_with_anything_before_the_fault_may_have_changed_state() {
        let good = Value::Struct(crate::xmlrpc::Struct::from([
            ("methodName".to_owned(), "getPid".into()),
            ("params".to_owned(), Value::Array(Vec::new())),
        ]));
        let multicall = |list| kind(&Call::new(multicall::METHOD, vec![Value::Array(list)]));
        assert_eq!(multicall(vec![Value::Int(1), good.clone()]), Kind::Unknown);
        assert_eq!(multicall(vec![good, Value::Int(1)]), Kind::Mutate);
        assert_eq!(kind(&Call::new(multicall::METHOD, vec![])), Kind::Unknown);
    }
}
