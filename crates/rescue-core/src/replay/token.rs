//! The token that rosrescue leaves in a master to recognise that process later. An *incarnation* is one life of a
//! master process. rosrescue numbers the incarnations.

use ros1_master::{
    master::{self, Method, Request},
    xmlrpc::Reply,
};

/// The namespace of tokens. It has no leading slash, so it contains no node name and no parameter below `/`.
const NAMESPACE: &str = "rosrescue/";
/// The caller id for registrations that are undone at once.
pub(super) const HELPER: &str = "rosrescue/injection";
/// An address that rosmaster accepts but never connects to, because `xmlrpc.client` refuses its scheme.
pub(super) const NO_API: &str = "rosrpc://rosrescue:0";

/// Identifies an *incarnation* of a master, which is one life of a master process.
///
/// In the master, a token is two parameter subscriptions with unique caller ids. The first caller id contains the id of
/// the session. The second contains the id and the number of the incarnation. The address of the first subscription
/// ends in the number too, so that a rosrescue with an older checkpoint can read the number. A master with a lower
/// number is an earlier incarnation. A master with a higher number is newer than the checkpoint.
///
/// Each subscription makes a reference to a node that only `lookupNode` finds: this node has no registration, parameter
/// or topic type that another read could show. The key of the subscription is outside the tree that starts at `/`, so
/// no `setParam` or `deleteParam` of `/` or below ever queues a callback to it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Token {
    session: String,
    name: String,
    number: u64,
}

/// The token that a master has, compared with the latest [`Token`] that rosrescue knows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TokenState {
    /// The latest token that rosrescue knows, so this master has got the whole state.
    Present,
    /// An earlier token of this session.
    Earlier,
    /// A later token of this session, with its number.
    Later(u64),
    /// The master has no token of this session.
    Nothing,
}

impl Token {
    /// Creates the token of the master process with this `number` in the session `id`. Characters of `id` other than
    /// ASCII letters, digits and `-` are replaced by `_`.
    pub fn new(id: &str, number: u64) -> Self {
        let safe = |c: char| {
            if c.is_ascii_alphanumeric() || c == '-' {
                c
            } else {
                '_'
            }
        };
        let id: String = id.chars().map(safe).collect();
        Self {
            name: format!("{NAMESPACE}{id}/{number}"),
            session: format!("{NAMESPACE}{id}"),
            number,
        }
    }

    /// The calls that set the token in a master. The one with the master's number in its caller id comes last.
    pub fn set_calls(&self) -> [Request; 2] {
        let session_api = format!("{NO_API}/{}", self.number);
        [(&self.session, session_api.as_str()), (&self.name, NO_API)]
            .map(|(name, api)| subscription(Method::SubscribeParam, name, api))
    }

    /// The call that removes the part of the token with the number from a master.
    pub fn remove(&self) -> Request {
        subscription(Method::UnsubscribeParam, &self.name, NO_API)
    }

    /// The call that looks up the part of the token with the number. The answer has code 1 if the master has that part.
    pub fn lookup(&self) -> Request {
        lookup(&self.name)
    }

    /// The call that looks up the session's part of the token.
    pub(super) fn lookup_session(&self) -> Request {
        lookup(&self.session)
    }

    /// The token that a master has. `number` says whether [`Self::lookup`] found the number, and `session` is the
    /// address that [`Self::lookup_session`] returned. An address without a number is not that of a later token.
    pub(super) fn state_in_master(&self, number: bool, session: Option<&str>) -> TokenState {
        let later = session
            .and_then(|api| api.strip_prefix(NO_API)?.strip_prefix('/')?.parse().ok())
            .filter(|later| *later > self.number);
        match (later, number, session) {
            (Some(later), _, _) => TokenState::Later(later),
            (None, true, _) => TokenState::Present,
            (None, false, Some(_)) => TokenState::Earlier,
            (None, false, None) => TokenState::Nothing,
        }
    }

    /// Whether this reply to [`Self::lookup`] says that the master has the token.
    pub fn is_found(reply: &Reply) -> bool {
        master::is_success(reply)
    }

    /// Whether a caller id belongs to a token.
    pub fn is_ours(caller_id: &str) -> bool {
        caller_id.starts_with(NAMESPACE)
    }
}

fn subscription(method: Method, name: &str, api: &str) -> Request {
    Request::new(method, [name, api, "~"])
}

fn lookup(name: &str) -> Request {
    Request::new(Method::LookupNode, [name, "~"])
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros1_master::{master::Master, xmlrpc::Value};

    fn reads() -> Vec<Request> {
        let none = ["getSystemState", "getTopicTypes", "getParamNames"];
        let mut calls: Vec<Request> = none
            .map(|name| Request::new(Method::named(name), [Value::from("/x")]))
            .into();
        calls.push(Request::new(
            Method::GetParam,
            [Value::from("/x"), "/".into()],
        ));
        calls.push(Request::new(
            Method::GetPublishedTopics,
            [Value::from("/x"), "".into()],
        ));
        calls
    }

    #[test]
    fn only_its_own_lookup_finds_a_token() {
        let token = Token::new("boot 7/3", 2);
        let mut master = Master::default();
        let before: Vec<_> = reads().iter().map(|call| master.apply(call)).collect();
        assert!(!Token::is_found(&master.apply(&token.lookup()).reply));
        for call in token.set_calls() {
            master.apply(&call);
        }
        let after: Vec<_> = reads().iter().map(|call| master.apply(call)).collect();
        assert_eq!(before, after);
        assert!(Token::is_found(&master.apply(&token.lookup()).reply));
        for other in [Token::new("other", 2), Token::new("boot 7/3", 1)] {
            assert!(!Token::is_found(&master.apply(&other.lookup()).reply));
        }
        assert!(Token::is_found(
            &master.apply(&token.lookup_session()).reply
        ));
        master.apply(&token.remove());
        assert!(!Token::is_found(&master.apply(&token.lookup()).reply));
        assert!(Token::is_found(
            &master.apply(&token.lookup_session()).reply
        ));
    }

    #[test]
    fn no_parameter_change_sends_a_callback_to_a_token() {
        let mut master = Master::default();
        for call in Token::new("a", 1).set_calls() {
            master.apply(&call);
        }
        let tree = Value::Struct([("rosrescue".to_owned(), Value::Int(1))].into());
        for (key, value) in [
            ("/", tree),
            ("/rosrescue/a", 1.into()),
            ("rosrescue/a/b", 1.into()),
        ] {
            let outcome = master.apply(&Request::new(
                Method::SetParam,
                [Value::from("/x"), key.into(), value],
            ));
            assert_eq!(outcome.notices, []);
        }
        let outcome = master.apply(&Request::new(
            Method::DeleteParam,
            [Value::from("/x"), "/rosrescue".into()],
        ));
        assert_eq!(outcome.notices, []);
    }
}
