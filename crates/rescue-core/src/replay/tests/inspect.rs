use super::*;
use crate::replay::{Inspection, NotAMaster, Token, TokenState, difference};

/// Reads the state of `master` as rosrescue does over the network.
fn read_back(master: &mut Master, previous: &Master) -> Master {
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
fn an_inspection_reads_everything_that_a_master_shows() {
    let mut master = busy();
    let found = read_back(&mut master.clone(), &Master::default());
    let mut blind = master.snapshot();
    blind.param_subscribers = Default::default();
    blind.nodes.remove("/w");
    blind.nodes.remove("/gone");
    let node = blind.nodes.get_mut("/p").unwrap();
    node.taken_over_services.clear();
    assert_eq!(found.snapshot().publishers, blind.publishers);
    assert_eq!(
        difference(&Master::from_snapshot(blind).unwrap(), &found),
        Vec::<String>::new()
    );
    let previous = master.clone();
    assert_eq!(read_back(&mut master, &previous), previous);
}

#[test]
fn an_inspection_believes_the_master_about_changes() {
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
    let found = read_back(&mut master.clone(), &previous);
    // `/s` is another process now, which does not have the old one's subscriptions.
    assert_eq!(found, master);
}

#[test]
fn an_empty_master_shows_no_state_and_no_token() {
    let token = Token::new("m", 1);
    let mut master = Master::default();
    master.set_identity(42, "http://h/".to_owned());
    let inspect = |master: &mut Master| {
        Inspection::decode(&master.apply(&Inspection::call(&token)).reply, &token).unwrap()
    };
    let first = inspect(&mut master);
    assert_eq!(
        (first.pid(), first.bears(), first.is_empty()),
        (42, TokenState::Nothing, true)
    );
    assert_eq!(first.second_call(&Master::default()), None);
    for (call, bears) in token
        .set_calls()
        .iter()
        .zip([TokenState::Earlier, TokenState::Present])
    {
        master.apply(call);
        let next = inspect(&mut master);
        assert_eq!((next.bears(), next.is_empty()), (bears, true));
    }
    master.apply(&set("/a", 1));
    assert!(!inspect(&mut master).is_empty());
    // A later number is found even if the master also has an earlier one.
    let [session, _] = Token::new("m", 12).set_calls();
    master.apply(&session);
    assert_eq!(inspect(&mut master).bears(), TokenState::Later(12));
    let [session, _] = Token::new("m", 0).set_calls();
    master.apply(&session);
    master.apply(&token.remove());
    assert_eq!(inspect(&mut master).bears(), TokenState::Earlier);
}

#[test]
fn parameters_that_the_master_cannot_return_come_from_the_previous_state() {
    let mut master = busy();
    master.apply(&set("/bad", vec![Value::Nil]));
    let previous = master.clone();
    assert_eq!(read_back(&mut master, &previous), previous);
}

#[test]
fn parameters_that_change_while_they_are_read_are_not_taken_for_unreadable_ones() {
    let refused = |text: &str| {
        let text = text.to_owned();
        let fault = Reply::Fault { code: 1, text };
        Inspection::decode(&fault, &Token::new("m", 1)).unwrap_err()
    };
    for text in [
        "<class 'RuntimeError'>:dictionary changed size during iteration",
        "<class 'RuntimeError'>:dictionary keys changed during iteration",
    ] {
        let error = refused(text);
        assert!(
            matches!(error, NotAMaster::ParamsChanging { .. }),
            "{error}"
        );
    }
    // A parameter that is nested too deep, on Python 2.
    let error = refused("<type 'exceptions.RuntimeError'>:maximum recursion depth exceeded");
    assert!(
        matches!(error, NotAMaster::ParamsUnreadable { .. }),
        "{error}"
    );
}

#[test]
fn a_node_that_vanishes_during_an_inspection_is_left_out() {
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
fn a_server_that_is_not_a_master_is_reported_as_such() {
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
