//! Decides what a master that a roscore may have started is not given at once.
//!
//! A roscore sets its own `/run_id` when its master listens, and ends with an error if the master has another one. It
//! starts rosout only if no `/rosout` is registered, and does not ask whether that node lives (roslaunch,
//! `ROSLaunchRunner._check_and_set_run_id` and `_launch_core_nodes`).

use std::time::Duration;

use super::{TokenState, Treatment};
use ros1_master::master::{CALLER_ID, Master, Method, Request};
use ros1_master::xmlrpc::{Reply, Value};

const RUN_ID: &str = "/run_id";

/// The name of roscore's rosout.
pub const ROSOUT: &str = "/rosout";

/// How long to wait at most for a roscore that sets its own run id, before the master gets the old one. roscore sets it as
/// soon as its master listens, and asks ten times a second whether it does. It never looks at the run id again.
pub const RUN_ID_AFTER: Duration = Duration::from_secs(5);

/// Asks a master whether it has a run id.
pub fn has_run_id() -> Request {
    Request::new(Method::HasParam, [CALLER_ID, RUN_ID])
}

/// Whether `reply` to [`has_run_id`] says yes.
pub fn is_run_id_set(reply: &Reply) -> bool {
    let answer = match reply {
        Reply::Value(answer) => answer.as_array(),
        Reply::Fault { .. } => None,
    };
    answer.and_then(|answer| answer.get(2)) == Some(&Value::Bool(true))
}

/// The calls that remove the run id from `state` and set it again, if a new master must not get it at once: a roscore
/// may have started the master, and has not set a run id in `found` yet.
pub fn withheld_run_id(
    may_be_roscores: bool,
    treatment: Treatment,
    state: &Master,
    found: &Master,
) -> Option<(Request, Request)> {
    let withholds = may_be_roscores && treatment == Treatment::Inject;
    let value = state.param(RUN_ID)?;
    (withholds && found.param(RUN_ID).is_none()).then(|| {
        let remove = Request::new(Method::DeleteParam, [CALLER_ID, RUN_ID]);
        let set = [CALLER_ID.into(), RUN_ID.into(), value];
        (remove, Request::new(Method::SetParam, set))
    })
}

/// The address of the rosout in `state`, if rosout must be asked whether it lives before a new master gets the state. A
/// roscore ends its rosout when its master has ended, so a dead one must not be restored.
pub fn rosout_to_ask<'a>(
    may_be_roscores: bool,
    bears: TokenState,
    state: &'a Master,
    found: &Master,
) -> Option<&'a str> {
    let is_new = bears == TokenState::Nothing;
    let asks = may_be_roscores && is_new && found.api_of(ROSOUT).is_none();
    state.api_of(ROSOUT).filter(|_| asks)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_new_master_of_a_roscore_gets_its_run_id_later() {
        let of = |value: &str| {
            let mut master = Master::default();
            master.apply(&Request::new(Method::SetParam, ["/n", RUN_ID, value]));
            master
        };
        let (old, new, none) = (of("old"), of("new"), Master::default());
        let withheld = withheld_run_id;
        assert_eq!(withheld(false, Treatment::Inject, &old, &none), None);
        assert_eq!(withheld(true, Treatment::Inject, &old, &new), None);
        assert_eq!(withheld(true, Treatment::Inject, &none, &none), None);
        assert_eq!(withheld(true, Treatment::Replace, &old, &none), None);
        let calls = withheld(true, Treatment::Inject, &old, &none);
        let (remove, set) = calls.expect("the run id comes later");
        let mut master = old.clone();
        master.apply(&remove);
        for (state, says) in [(&master, false), (&old, true)] {
            let reply = state.clone().apply(&has_run_id()).reply;
            assert_eq!(is_run_id_set(&reply), says);
        }
        master.apply(&set);
        assert_eq!(master.params(), old.params());
    }

    #[test]
    fn a_new_master_of_a_roscore_gets_no_rosout_without_a_question() {
        let mut with = Master::default();
        let api = "http://robot:4711/";
        let call = [ROSOUT, "/rosout_agg", "rosgraph_msgs/Log", api];
        with.apply(&Request::new(Method::RegisterPublisher, call));
        let none = Master::default();
        assert_eq!(
            rosout_to_ask(true, TokenState::Nothing, &with, &none),
            Some(api)
        );
        assert_eq!(
            rosout_to_ask(false, TokenState::Nothing, &with, &none),
            None
        );
        assert_eq!(rosout_to_ask(true, TokenState::Present, &with, &none), None);
        assert_eq!(rosout_to_ask(true, TokenState::Nothing, &with, &with), None);
        assert_eq!(rosout_to_ask(true, TokenState::Nothing, &none, &none), None);
    }
}
