//! rosrescue answers before its rosmaster is up. `tests/timing/first_start.rs` has how soon.

use crate::support::{FakeNode, Mode, Robot, State, eventually};

/// The checkpoint of a session that goes on.
#[test]
fn a_core_that_has_a_checkpoint_answers_from_it_before_its_master_is_up() {
    let mut robot = Robot::start_for_outages(Mode::Core);
    let node = FakeNode::start("/known");
    node.publish(&robot.client(), "/chatter", "std_msgs/String");
    robot.client().set_param("/gain", 7);
    let before = robot.settled_state();
    robot.kill_master();
    robot.rescue.kill();
    // The master that it had begun to start ends with the test.
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
    eventually("the master has it", || {
        State::try_read(&robot.bare()).is_ok_and(|state| {
            state.publishers_of("/chatter") == ["/known"]
                && state.subscribers_of("/chatter") == ["/late"]
        })
    });
}
