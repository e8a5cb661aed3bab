//! What a call may cost: no more than a master that answers it, however it is made.

use super::*;
use crate::master::multicall::{self, Entry};
use crate::master::{Kind, NoticeSink, kind};

/// Whom a value goes to, and where it lies in memory.
#[derive(Default)]
struct Lent(Vec<(usize, String, *const Value)>);

impl NoticeSink for Lent {
    fn param_update(&mut self, to: &[String], key: &str, value: &Value) {
        self.0.push((to.len(), key.to_owned(), value));
    }
}

#[test]
fn the_value_of_a_parameter_is_not_copied_for_its_subscribers() {
    let watched = |key: &'static str| (0..5000).map(move |node| watch(&format!("/n{node}"), key));
    let mut master = after(watched("/k").chain(watched("/k/x/y")));
    let inner = tree([("y", "text".into())]);
    let call = set("/k", tree([("x", inner)]));
    let value = &call.params[2];
    let text = &value.as_struct().unwrap()["x"].as_struct().unwrap()["y"];
    let mut lent = Lent::default();
    master.apply_telling(&call, &mut lent);
    let expected = [
        (5000, "/k/".to_owned(), std::ptr::from_ref(value)),
        (5000, "/k/x/y/".to_owned(), std::ptr::from_ref(text)),
    ];
    assert_eq!(lent.0, expected);
}

#[test]
fn of_a_text_for_a_list_only_as_much_is_taken_as_matters() {
    let text = Value::String("x".repeat(1 << 20));
    let params = [text.clone()];
    assert_eq!(multicall::entries(&params).unwrap().len(), 1);
    let call = Call::new(multicall::METHOD, params.to_vec());
    assert_eq!(kind(&call), Kind::Unknown);
    let fault = |text: &str| Reply::Fault {
        code: 1,
        text: text.to_owned(),
    };
    assert_eq!(
        Master::default().apply(&call).reply,
        fault("<class 'TypeError'>:string indices must be integers, not 'str'")
    );
    let entry = |method: &str| tree([("methodName", method.into()), ("params", text.clone())]);
    match Entry::new(&entry("getParam")) {
        Entry::Call { params, .. } => assert!(params.len() < 10),
        _ => panic!("no call"),
    }
    for (method, answer) in [
        (
            multicall::METHOD,
            "<class 'TypeError'>:SimpleXMLRPCDispatcher.system_multicall() takes 2 positional arguments but 1048577 were given",
        ),
        (
            "param_update_task",
            "<class 'TypeError'>:ROSMasterHandler.param_update_task() takes 5 positional arguments but 1048577 were given",
        ),
        (
            "none",
            "<class 'Exception'>:method \"none\" is not supported",
        ),
    ] {
        match Entry::new(&entry(method)) {
            Entry::Refused(text) => assert_eq!(text, answer),
            _ => panic!("{method} is no refusal"),
        }
    }
    let list = Value::Array(vec![entry("getParam")]);
    let results = Master::default().apply(&Call::new(multicall::METHOD, vec![list]));
    let refusal: Value = vec![(-1).into(), "Error: bad call arity".into(), Value::Int(0)].into();
    let results_are = Reply::Value(Value::Array(vec![Value::Array(vec![refusal])]));
    assert_eq!(results.reply, results_are);
}

/// The keys of all members together would take 100 GB.
#[test]
fn a_long_name_is_not_repeated_for_every_member_in_it() {
    let name = "x".repeat(1_000_000);
    let members = (0..100_000).map(|index| (index.to_string(), Value::Int(index)));
    let members = Value::Struct(members.collect());
    let value = Value::Struct(Struct::from([
        (name, members),
        ("a".to_owned(), tree([("b", 1.into())])),
        ("/b/a".to_owned(), tree([("b", 2.into())])),
    ]));
    let mut master = after([watch("/above", "/"), watch("/in", "/b/a/b")]);
    let mut lent = Lent::default();
    master.apply_telling(&set("/b", value), &mut lent);
    let told: Vec<_> = lent
        .0
        .iter()
        .map(|(to, key, _)| (*to, key.as_str()))
        .collect();
    assert_eq!(told, [(1, "/b/"), (1, "/b/a/b/"), (1, "/b/a/b/")]);
}
