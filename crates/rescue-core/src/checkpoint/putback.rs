//! Computes the changes that give a running master the parameters of a checkpoint.

use ros1_master::{
    master,
    xmlrpc::{Struct, Value},
};

/// Parameters that belong to the present session, so their values in a checkpoint are not used. roslaunch compares
/// `/run_id` with its own, and stores its addresses below `/roslaunch`. A roscore sets `/rosdistro` and `/rosversion` when
/// it starts.
pub const OF_THE_SESSION: [&str; 4] = ["/run_id", "/roslaunch", "/rosdistro", "/rosversion"];

/// A parameter of the checkpoint that is left out, and the reason.
pub type LeftOut = (String, String);

/// The parameters to change.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ParamChanges {
    /// Name, present value in the master, and value in the checkpoint.
    pub set: Vec<(String, Option<Value>, Value)>,
    /// Names of parameters that the checkpoint lacks.
    pub delete: Vec<String>,
    pub left_out: Vec<LeftOut>,
}

impl ParamChanges {
    /// The changes that give `live` every parameter of `file`. With `exact` they also delete all others.
    pub fn between(file: &Struct, live: &Struct, exact: bool) -> Self {
        let mut found = Self::default();
        found.below("", file, live, exact);
        found
    }

    /// Leaves out all parameters but those with one of these `names` and those below one. No names leave out none.
    pub fn retain(&mut self, names: &[String]) {
        let wanted = |of: &str| names.is_empty() || names.iter().any(|name| is_in(of, name));
        self.set.retain(|(name, ..)| wanted(name));
        self.delete.retain(|name| wanted(name));
        self.left_out
            .retain(|(what, _)| wanted(what.trim_start_matches("parameter ")));
    }

    /// Whether there is nothing to change.
    pub fn is_empty(&self) -> bool {
        self.set.is_empty() && self.delete.is_empty()
    }

    fn below(&mut self, path: &str, file: &Struct, live: &Struct, exact: bool) {
        for (key, value) in file {
            let name = format!("{path}/{key}");
            if OF_THE_SESSION.contains(&name.as_str()) {
                if live.get(key) != Some(value) {
                    self.leave_out(name, "it belongs to the running session");
                }
                continue;
            }
            match (value, live.get(key)) {
                (value, Some(there)) if value == there => {}
                // Setting an empty namespace would delete everything in it.
                (Value::Struct(none), Some(Value::Struct(_))) if none.is_empty() && !exact => {}
                _ if !is_plain(key) => self.leave_out(
                    name,
                    "its name is empty or has a slash, so no call can set it alone",
                ),
                (Value::Struct(members), there) if is_namespace(members) => {
                    let none = Struct::new();
                    let there = there.and_then(Value::as_struct).unwrap_or(&none);
                    self.below(&name, members, there, exact);
                }
                (value, _) if !master::is_readable(value) => {
                    self.leave_out(name, "rosmaster could store it but never return it");
                }
                (value, there) => self.set.push((name, there.cloned(), value.clone())),
            }
        }
        let surplus = live.keys().filter(|key| exact && !file.contains_key(*key));
        for key in surplus {
            let name = format!("{path}/{key}");
            if is_plain(key) && !OF_THE_SESSION.contains(&name.as_str()) {
                self.delete.push(name);
            }
        }
    }

    fn leave_out(&mut self, name: String, why: &str) {
        self.left_out
            .push((format!("parameter {name}"), why.to_owned()));
    }
}

/// Whether the parameter `name` has the name `space`, or is in that namespace. `space` needs no slash at its start.
pub fn is_in(name: &str, space: &str) -> bool {
    let space = space.trim_matches('/');
    let rest = name.trim_start_matches('/').strip_prefix(space);
    space.is_empty() || rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
}

/// Whether `key` can be one part of a parameter's name.
fn is_plain(key: &str) -> bool {
    !key.is_empty() && !key.contains('/')
}

/// Whether each member can be set by a separate call.
fn is_namespace(members: &Struct) -> bool {
    !members.is_empty() && members.keys().all(|key| is_plain(key))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tree(members: &[(&str, Value)]) -> Struct {
        members.into()
    }

    fn space(members: &[(&str, Value)]) -> Value {
        Value::Struct(tree(members))
    }

    #[test]
    fn only_differing_parameters_are_set_and_others_are_deleted_only_if_asked_to() {
        let file = tree(&[
            ("same", 1.into()),
            ("a", space(&[("x", 1.into()), ("y", 2.into())])),
            ("was_value", space(&[("z", 3.into())])),
            ("run_id", "old".into()),
            ("odd", space(&[("p/q", 1.into())])),
            ("never", Value::Nil),
            ("emptied", space(&[])),
        ]);
        let live = tree(&[
            ("same", 1.into()),
            (
                "a",
                space(&[("x", 1.into()), ("y", 5.into()), ("new", 6.into())]),
            ),
            ("was_value", 7.into()),
            ("run_id", "new".into()),
            ("roslaunch", space(&[("uris", 1.into())])),
            ("rosdistro", "noetic".into()),
            ("other", 1.into()),
            ("emptied", space(&[("x", 1.into())])),
        ]);
        let plan = ParamChanges::between(&file, &live, false);
        let set = [
            ("/a/y", Some(5.into()), 2.into()),
            ("/was_value/z", None, 3.into()),
            ("/odd", None, space(&[("p/q", 1.into())])),
        ];
        let set = set.map(|(name, was, is)| (name.to_owned(), was, is));
        assert_eq!(plan.set, set);
        assert_eq!(plan.delete, [""; 0]);
        let left: Vec<_> = plan.left_out.iter().map(|(what, _)| what).collect();
        assert_eq!(left, ["parameter /run_id", "parameter /never"]);
        let exact = ParamChanges::between(&file, &live, true);
        assert_eq!(exact.delete, ["/a/new", "/other"]);
        assert_eq!(exact.set.len(), plan.set.len() + 1);
        assert_eq!(exact.set[3].0, "/emptied");
    }
}
