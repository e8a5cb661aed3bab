//! Tests that no call costs more than it would cost a master.

use super::*;
use ros1_master::master::NoticeSink;

/// Records the receivers of a value, and the value's address in memory.
#[derive(Default)]
struct Lent(Vec<(usize, String, *const Value)>);

impl NoticeSink for Lent {
    fn param_update(&mut self, to: &[String], key: &str, value: &Value) {
        self.0.push((to.len(), key.to_owned(), value));
    }
}

#[test]
fn a_parameter_value_is_not_copied_for_each_subscriber() {
    let watched = |key: &'static str| (0..5000).map(move |node| watch(&format!("/n{node}"), key));
    let mut master = after(watched("/k").chain(watched("/k/x/y")));
    let inner = tree([("y", "text".into())]);
    let call = set("/k", tree([("x", inner)]));
    let value = &call.params()[2];
    let text = &value.as_struct().unwrap()["x"].as_struct().unwrap()["y"];
    let mut lent = Lent::default();
    master.apply_telling(&call, &mut lent);
    let expected = [
        (5000, "/k/".to_owned(), std::ptr::from_ref(value)),
        (5000, "/k/x/y/".to_owned(), std::ptr::from_ref(text)),
    ];
    assert_eq!(lent.0, expected);
}

/// The keys of all members together would take 100 GB.
#[test]
fn the_name_of_a_namespace_is_not_repeated_for_each_member() {
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
