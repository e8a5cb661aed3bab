//! rosrescue answers calls before its rosmaster has started.

use std::fs;
use std::net::TcpStream;
use std::path::Path;

use crate::support::{
    Client, FakeNode, Mode, NODES, Robot, Scratch, Setup, State, eventually, eventually_some,
    free_port, params,
};

/// A core whose rosmaster waits until the file `away` is removed.
fn core(scratch: &Scratch, master_port: u16) -> Setup {
    fs::write(scratch.path("away"), "").unwrap();
    let waiting = Path::new(NODES).join("waiting_rosmaster.py");
    Setup::core(scratch, master_port)
        .arg("--rosmaster")
        .arg(waiting)
}

#[test]
fn a_core_answers_at_once_and_gives_its_master_all_writes_later() {
    for _ in 0..3 {
        let scratch = Scratch::new();
        let master_port = free_port();
        let publisher = FakeNode::start("/early");
        let subscriber = FakeNode::start("/early_too");
        let mut rescue = core(&scratch, master_port).spawn();
        let client = rescue.client();
        eventually("the port is open", || {
            assert_eq!(rescue.exited(), None);
            TcpStream::connect(("127.0.0.1", client.port())).is_ok()
        });
        client.ok("getPid", params!["/test"]);
        subscriber.subscribe(&client, "/chatter", "std_msgs/String");
        publisher.publish(&client, "/chatter", "std_msgs/String");
        client.set_param("/early/gain", 1.5);
        publisher.watch_param(&client, "/early/gain");
        publisher.offer(&client, "/early/service");
        let bare = Client::new(master_port);
        assert!(bare.master_pid().is_none(), "there is no master yet");
        eventually("the subscriber is told", || {
            // Twice, if its answer took long.
            let updates = subscriber.updates("/chatter");
            updates
                .last()
                .is_some_and(|list| *list == [publisher.api.clone()])
        });

        fs::remove_file(scratch.path("away")).unwrap();
        rescue.wait_serving();
        let state = eventually_some("rosout is running", || {
            let state = State::try_read(&bare).ok()?;
            (state.subscribers_of("/rosout") == ["/rosout"]).then_some(state)
        });
        eventually("the mirror is equal to the master", || {
            State::read(&client) == State::read(&bare)
        });
        assert_eq!(state.publishers_of("/chatter"), ["/early"]);
        assert_eq!(state.subscribers_of("/chatter"), ["/early_too"]);
        assert_eq!(bare.param("/early/gain"), Some(1.5.into()));
        // The master also has the parameter subscription, which rosrescue cannot read from a master.
        client.set_param("/early/gain", 2.5);
        eventually("the parameter's subscriber is notified", || {
            // The node gets the value twice if another node had not answered yet, because then rosrescue notifies nodes
            // too.
            let heard = publisher.received("paramUpdate");
            heard.last().is_some_and(|update| update[2] == 2.5.into())
        });
        assert!(publisher.received("shutdown").is_empty());
        assert!(subscriber.received("shutdown").is_empty());
    }
}

/// The checkpoint belongs to a session that continues.
#[test]
fn a_core_answers_from_its_checkpoint_before_its_master_has_started() {
    let mut robot = Robot::start_for_outages(Mode::Core);
    let node = FakeNode::start("/known");
    node.publish(&robot.client(), "/chatter", "std_msgs/String");
    robot.client().set_param("/gain", 7);
    let before = robot.settled_state();
    robot.kill_master();
    robot.rescue.kill();
    // The master that is being started ends with the test.
    robot.rescue.start_again();
    let client = robot.client();
    eventually("rosrescue answers", || client.param("/gain").is_some());
    assert!(
        robot.bare().master_pid().is_none(),
        "there is no master yet"
    );
    let late = FakeNode::start("/late");
    late.subscribe(&client, "/chatter", "std_msgs/String");
    let mirror = State::read(&client);
    let known = mirror.without_node("/late");
    assert_eq!(known.nodes, before.nodes);
    assert_eq!(known.publishers, before.publishers);
    robot.revive_master();
    eventually("the master has the state", || {
        State::try_read(&robot.bare()).is_ok_and(|state| {
            state.publishers_of("/chatter") == ["/known"]
                && state.subscribers_of("/chatter") == ["/late"]
        })
    });
}
