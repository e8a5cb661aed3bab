//! A mark left in a master, by which this very process is known again.

use crate::xmlrpc::{Call, Reply};

/// The namespace of marks. Without a leading slash no node's name and no parameter that
/// `getParam('/')` shows can be in it.
const NAMESPACE: &str = "rosrescue/";

/// The caller id of registrations that are undone at once.
pub(super) const HELPER: &str = "rosrescue/injection";

/// An address that rosmaster takes and never connects to: `xmlrpc.client` refuses its scheme.
pub(super) const NO_API: &str = "rosrpc://rosrescue:0";

/// A parameter subscription by a caller id that nobody else has.
///
/// It makes a node reference that `lookupNode` finds and no other read shows: no registration, no
/// parameter, no topic type. The subscribed key is outside the tree that starts at `/`, so no
/// `setParam` or `deleteParam` below `/`, not even one of `/` itself, ever queues a callback to it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Mark {
    name: String,
}

impl Mark {
    /// The mark of `id`. Characters of `id` other than ASCII letters, digits, `-` and `_` become
    /// `_`.
    pub fn new(id: &str) -> Self {
        let safe = |c: char| {
            if c.is_ascii_alphanumeric() || c == '-' {
                c
            } else {
                '_'
            }
        };
        let id: String = id.chars().map(safe).collect();
        Self {
            name: format!("{NAMESPACE}{id}"),
        }
    }

    /// The caller id.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The call that leaves the mark.
    pub fn call(&self) -> Call {
        let params = vec![self.name().into(), NO_API.into(), "~".into()];
        Call::new("subscribeParam", params)
    }

    /// The call that looks for it: answered with code 1 if it is there.
    pub fn lookup(&self) -> Call {
        Call::new("lookupNode", vec![self.name().into(), "~".into()])
    }

    /// Whether the reply to [`Mark::lookup`] says that the mark is there.
    pub fn is_found(reply: &Reply) -> bool {
        super::is_success(reply)
    }

    /// Whether a caller id is that of a mark.
    pub fn is_ours(caller_id: &str) -> bool {
        caller_id.starts_with(NAMESPACE)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{master::Master, xmlrpc::Value};

    fn reads() -> Vec<Call> {
        let none = ["getSystemState", "getTopicTypes", "getParamNames"];
        let mut calls: Vec<Call> = none.map(|name| Call::new(name, vec!["/x".into()])).into();
        calls.push(Call::new("getParam", vec!["/x".into(), "/".into()]));
        calls.push(Call::new(
            "getPublishedTopics",
            vec!["/x".into(), "".into()],
        ));
        calls
    }

    #[test]
    fn only_its_own_lookup_finds_a_mark() {
        let mark = Mark::new("boot 7/3");
        let mut master = Master::default();
        let before: Vec<_> = reads().iter().map(|call| master.apply(call)).collect();
        assert!(!Mark::is_found(&master.apply(&mark.lookup()).reply));
        master.apply(&mark.call());
        let after: Vec<_> = reads().iter().map(|call| master.apply(call)).collect();
        assert_eq!(before, after);
        assert!(Mark::is_found(&master.apply(&mark.lookup()).reply));
        assert!(!Mark::is_found(
            &master.apply(&Mark::new("other").lookup()).reply
        ));
    }

    #[test]
    fn no_parameter_below_the_root_calls_a_mark_back() {
        let mut master = Master::default();
        master.apply(&Mark::new("a").call());
        let tree = Value::Struct([("rosrescue".to_owned(), Value::Int(1))].into());
        for (key, value) in [
            ("/", tree),
            ("/rosrescue/a", 1.into()),
            ("rosrescue/a/b", 1.into()),
        ] {
            let outcome =
                master.apply(&Call::new("setParam", vec!["/x".into(), key.into(), value]));
            assert_eq!(outcome.notices, []);
        }
        let outcome = master.apply(&Call::new(
            "deleteParam",
            vec!["/x".into(), "/rosrescue".into()],
        ));
        assert_eq!(outcome.notices, []);
    }
}
