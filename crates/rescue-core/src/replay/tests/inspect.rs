use super::*;
use crate::replay::{Bears, Inspection, NotAMaster, Token, difference};

/// Looks at `master` as rosrescue does over the wire.
fn look(master: &mut Master, previous: &Master) -> Master {
    let token = Token::new("m", 1);
    let reply = master.apply(&Inspection::call(&token)).reply;
    let look = match Inspection::decode(&reply, &token) {
        Err(NotAMaster::ParamsUnreadable { .. }) => {
            let reply = master.apply(&Inspection::call_without_params(&token)).reply;
            Inspection::decode(&reply, &token).unwrap()
        }
        look => look.unwrap(),
    };
    let second = look
        .second_call(previous)
        .map(|call| master.apply(&call).reply);
    look.into_master(second.as_ref(), previous).unwrap()
}

fn busy() -> Master {
    after([
        publish("/p", "/t", "a/B"),
        publish("/q", "/t", "a/B"),
        subscribe("/s", "/t", "a/B"),
        subscribe("plain", "/u", "*"),
        provide("/p", "/srv"),
        provide("/p", "/lost"),
        provide("/q", "/lost"),
        provide("/gone", "/srv2"),
        provide("/q", "/srv2"),
        watch("/w", "/k"),
        watch("/s", "/k"),
        set("/k/x", 1),
    ])
}

#[test]
fn a_look_shows_everything_but_what_only_the_previous_state_knows() {
    let mut master = busy();
    let found = look(&mut master.clone(), &Master::default());
    let mut blind = master.snapshot();
    blind.param_subscribers.clear();
    blind.nodes.shift_remove("/w");
    blind.nodes.shift_remove("/gone");
    blind.nodes["/p"].taken_over_services.clear();
    assert_eq!(found.snapshot().publishers, blind.publishers);
    assert_eq!(
        difference(&Master::from_snapshot(blind).unwrap(), &found),
        Vec::<String>::new()
    );
    let previous = master.clone();
    assert_eq!(look(&mut master, &previous), previous);
}

#[test]
fn what_changed_since_is_believed_to_the_master() {
    let previous = busy();
    let mut master = busy();
    for call in [
        watch("/w", "/k"),
        call(
            "registerPublisher",
            &["/s", "/t", "a/B", "http://restarted"],
        ),
        provide("/x", "/new"),
        set("/k/x", 2),
    ] {
        master.apply(&call);
    }
    let found = look(&mut master.clone(), &previous);
    // `/s` is another process now: its subscriptions of old are not its own.
    assert_eq!(found, master);
}

#[test]
fn an_empty_master_is_empty_and_bears_no_token() {
    let token = Token::new("m", 1);
    let mut master = Master::default();
    master.set_identity(42, "http://h/".to_owned());
    let look = |master: &mut Master| {
        Inspection::decode(&master.apply(&Inspection::call(&token)).reply, &token).unwrap()
    };
    let first = look(&mut master);
    assert_eq!(
        (first.pid(), first.bears(), first.is_empty()),
        (42, Bears::Nothing, true)
    );
    assert_eq!(first.second_call(&Master::default()), None);
    for (call, bears) in token.leave().iter().zip([Bears::Earlier, Bears::Present]) {
        master.apply(call);
        let next = look(&mut master);
        assert_eq!((next.bears(), next.is_empty()), (bears, true));
    }
    master.apply(&set("/a", 1));
    assert!(!look(&mut master).is_empty());
    // Also while it bears an earlier number.
    let [session, _] = Token::new("m", 12).leave();
    master.apply(&session);
    assert_eq!(look(&mut master).bears(), Bears::Later(12));
    let [session, _] = Token::new("m", 0).leave();
    master.apply(&session);
    master.apply(&token.remove());
    assert_eq!(look(&mut master).bears(), Bears::Earlier);
}

#[test]
fn poisoned_params_come_from_the_previous_state() {
    let mut master = busy();
    master.apply(&set("/bad", vec![Value::Nil]));
    let previous = master.clone();
    assert_eq!(look(&mut master, &previous), previous);
}

#[test]
fn what_vanishes_between_the_looks_is_left_out() {
    let mut master = busy();
    let token = Token::new("m", 1);
    let first = Inspection::decode(&master.apply(&Inspection::call(&token)).reply, &token).unwrap();
    for call in master.unregister_calls("/q") {
        master.apply(&call);
    }
    let second = first.second_call(&Master::default()).unwrap();
    let reply = master.apply(&second).reply;
    let found = first.into_master(Some(&reply), &Master::default()).unwrap();
    assert_eq!(found.api_of("/q"), None);
    assert_eq!(found.publishers_of("/t"), [api("/p")]);
}

#[test]
fn what_is_no_master_is_said_to_be_none() {
    let form = |reply| Inspection::decode(&reply, &Token::new("m", 1)).unwrap_err();
    assert!(matches!(
        form(Reply::Value(1.into())),
        NotAMaster::Form { .. }
    ));
    assert!(matches!(
        form(Reply::Value(Value::Array(vec![]))),
        NotAMaster::Form { .. }
    ));
    let text = "<class 'Exception'>:method \"system.multicall\" is not supported".to_owned();
    let fault = Reply::Fault { code: 1, text };
    assert!(matches!(form(fault), NotAMaster::Fault { .. }));
}
