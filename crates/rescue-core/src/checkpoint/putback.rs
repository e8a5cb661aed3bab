//! What it takes to bring a running master nearer to a checkpoint, by calls that anybody may make.

use crate::{
    checkpoint::compare::plain,
    master::{self, Master, Method, Request},
    xmlrpc::{Struct, Value},
};

/// Parameters that belong to the start of the present session. roslaunch compares `/run_id` with its own, and has its
/// addresses below `/roslaunch`.
pub const OF_THE_SESSION: [&str; 2] = ["/run_id", "/roslaunch"];

/// Something of the checkpoint that stays out, and why.
pub type LeftOut = (String, String);

/// The changes of parameters.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Params {
    /// Name, value in the master, if any, and value in the checkpoint.
    pub set: Vec<(String, Option<Value>, Value)>,
    /// Names that the checkpoint does not have.
    pub delete: Vec<String>,
    pub left_out: Vec<LeftOut>,
}

/// What is to be set so that `live` has all parameters of `file`, one by one; with `exact` also what is to be
/// deleted so that it has no others.
pub fn params(file: &Struct, live: &Struct, exact: bool) -> Params {
    let mut found = Params::default();
    found.below("", file, live, exact);
    found
}

impl Params {
    fn below(&mut self, path: &str, file: &Struct, live: &Struct, exact: bool) {
        for (key, value) in file {
            let name = format!("{path}/{key}");
            if OF_THE_SESSION.contains(&name.as_str()) {
                if live.get(key) != Some(value) {
                    self.leave(name, "it belongs to the session that runs now");
                }
                continue;
            }
            match (value, live.get(key)) {
                (value, Some(there)) if value == there => {}
                // To set it would delete what is in it.
                (Value::Struct(none), Some(Value::Struct(_))) if none.is_empty() && !exact => {}
                _ if !is_plain(key) => self.leave(name, "no call can name it alone"),
                (Value::Struct(members), there) if is_namespace(members) => {
                    let none = Struct::new();
                    let there = there.and_then(Value::as_struct).unwrap_or(&none);
                    self.below(&name, members, there, exact);
                }
                (value, _) if !master::is_readable(value) => {
                    self.leave(name, "rosmaster could take it but never return it");
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

    fn leave(&mut self, name: String, why: &str) {
        self.left_out
            .push((format!("parameter {name}"), why.to_owned()));
    }
}

/// Whether `key` alone can be a part of a name.
fn is_plain(key: &str) -> bool {
    !key.is_empty() && !key.contains('/')
}

/// Whether each member can be set by a call of its own.
fn is_namespace(members: &Struct) -> bool {
    !members.is_empty() && members.keys().all(|key| is_plain(key))
}

/// A registration of a node.
#[derive(Clone, Debug, PartialEq)]
pub struct Registration {
    /// As in `/talker publishes /chatter`.
    pub text: String,
    /// The service and its address, for a service.
    pub service: Option<(String, String)>,
    pub call: Request,
}

/// A node of a checkpoint, with what a master lacks of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Absent {
    pub node: String,
    pub api: String,
    /// In the order in which they are to be made.
    pub registrations: Vec<Registration>,
}

/// The nodes of `file` that `live` does not know, or knows at the same address with fewer registrations. A node that
/// is at another address now is left out: rosmaster would shut it down.
pub fn absent(file: &Master, live: &Master) -> (Vec<Absent>, Vec<LeftOut>) {
    let (mut absent, mut left_out) = (Vec::new(), Vec::new());
    for (node, api) in file.nodes() {
        let there = live.api_of(node);
        if let Some(now) = there.filter(|now| *now != api) {
            let why = format!("it is registered at {now} now, and was at {api}");
            left_out.push((format!("node {node}"), why));
            continue;
        }
        let registrations = missing(file, live, node, api, &mut left_out);
        if !registrations.is_empty() {
            absent.push(Absent {
                node: node.to_owned(),
                api: api.to_owned(),
                registrations,
            });
        }
    }
    (absent, left_out)
}

fn missing(
    file: &Master,
    live: &Master,
    node: &str,
    api: &str,
    left_out: &mut Vec<LeftOut>,
) -> Vec<Registration> {
    let mut found = Vec::new();
    let mut add =
        |text: String, service, name: Option<String>, call: &dyn Fn(&str) -> Request| match name {
            Some(name) => found.push(Registration {
                text,
                service,
                call: call(&name),
            }),
            None => left_out.push((text, "no name leads to it".to_owned())),
        };
    let named = |key: &str| master::name_for(key, node);
    for (verb, method, held, there) in [
        (
            "publishes",
            Method::RegisterPublisher,
            file.publications(node).collect::<Vec<_>>(),
            live.publications(node).collect::<Vec<_>>(),
        ),
        (
            "subscribes",
            Method::RegisterSubscriber,
            file.subscriptions(node).collect(),
            live.subscriptions(node).collect(),
        ),
    ] {
        for topic in held.into_iter().filter(|topic| !there.contains(topic)) {
            let topic_type = file.type_of(topic).unwrap_or("*");
            add(
                format!("{node} {verb} {topic}"),
                None,
                named(topic),
                &|name| Request::new(method.clone(), [node, name, topic_type, api]),
            );
        }
    }
    // Whether a node that is known subscribes parameters cannot be read.
    let watched = file.param_subscriptions(node);
    for key in watched.filter(|_| live.api_of(node).is_none()) {
        let text = format!("{node} watches the parameter {}", plain(key));
        add(text, None, master::param_name_for(key, node), &|name| {
            Request::new(Method::SubscribeParam, [node, api, name])
        });
    }
    let mut taken = Vec::new();
    for (service, at) in file.services_of(node) {
        let text = format!("{node} provides {service}");
        match live.provider_of(service) {
            Some(now) if now == node => {}
            Some(now) => taken.push((text, format!("{now} provides it now"))),
            None => add(
                text,
                Some((service.to_owned(), at.to_owned())),
                named(service),
                &|name| Request::new(Method::RegisterService, [node, name, at, api]),
            ),
        }
    }
    left_out.extend(taken);
    found
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
    fn only_what_differs_is_set_and_only_if_it_must_be_exact_is_anything_deleted() {
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
            ("other", 1.into()),
            ("emptied", space(&[("x", 1.into())])),
        ]);
        let plan = params(&file, &live, false);
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
        let exact = params(&file, &live, true);
        assert_eq!(exact.delete, ["/a/new", "/other"]);
        assert_eq!(exact.set.len(), plan.set.len() + 1);
        assert_eq!(exact.set[3].0, "/emptied");
    }

    fn call(method: Method, params: &[&str]) -> Request {
        Request::new(method, params.iter().copied())
    }

    fn master(calls: &[Request]) -> Master {
        let mut master = Master::default();
        for call in calls {
            master.apply(call);
        }
        master
    }

    #[test]
    fn what_a_master_lacks_of_a_node_is_put_back_where_the_node_is() {
        let publish = call(
            Method::RegisterPublisher,
            &["/p", "/t", "x/Y", "http://p:1/"],
        );
        let serve = call(
            Method::RegisterService,
            &["/p", "/s", "rosrpc://p:2", "http://p:1/"],
        );
        let taken = call(
            Method::RegisterService,
            &["/p", "/u", "rosrpc://p:2", "http://p:1/"],
        );
        let watch = call(Method::SubscribeParam, &["/p", "http://p:1/", "/k"]);
        let moved = call(
            Method::RegisterPublisher,
            &["/m", "/t", "x/Y", "http://m:1/"],
        );
        let all = [publish.clone(), serve.clone(), taken, watch.clone(), moved];
        let file = master(&all);
        let live = master(&[
            call(
                Method::RegisterSubscriber,
                &["/m", "/t", "x/Y", "http://m:9/"],
            ),
            call(
                Method::RegisterService,
                &["/v", "/u", "rosrpc://v:2", "http://v:1/"],
            ),
        ]);
        let (found, left_out) = absent(&file, &live);
        assert_eq!(found.len(), 1);
        let texts: Vec<_> = found[0]
            .registrations
            .iter()
            .map(|one| one.text.as_str())
            .collect();
        assert_eq!(
            texts,
            [
                "/p publishes /t",
                "/p watches the parameter /k",
                "/p provides /s"
            ]
        );
        let calls: Vec<_> = found[0]
            .registrations
            .iter()
            .map(|one| one.call.clone())
            .collect();
        assert_eq!(calls, [publish, watch, serve]);
        let left: Vec<_> = left_out.iter().map(|(what, _)| what).collect();
        assert_eq!(left, ["/p provides /u", "node /m"]);
        // With all of it nothing is left to do, and what cannot be read is not done again.
        let (found, _) = absent(&file, &file);
        assert_eq!(found, []);
    }
}
