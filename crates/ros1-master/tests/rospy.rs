//! Runs the example as a master for real rospy nodes. Needs rospy, std_msgs and std_srvs for `/usr/bin/python3`.

#![allow(
    clippy::disallowed_methods,
    clippy::disallowed_types,
    clippy::unwrap_used,
    reason = "a test that starts processes"
)]

use std::{
    env,
    io::{BufRead, BufReader},
    net::TcpListener,
    process::{Child, Command, Stdio},
};

/// A node that prints that it is ready, then what it has received, the new value of a parameter, and a service's
/// answer.
const LISTENER: &str = "
import rospy, std_msgs.msg, std_srvs.srv, threading
heard = threading.Event()
rospy.init_node('listener')
rospy.set_param('/gain', 2)
rospy.Subscriber('/chatter', std_msgs.msg.String, lambda message: (print('heard', message.data, flush=True), heard.set()))
print('ready', flush=True)
assert heard.wait(60)
rospy.wait_for_service('/reset', 60)
print('reset', rospy.ServiceProxy('/reset', std_srvs.srv.Trigger)().message, flush=True)
print('gain', rospy.get_param('/gain'), flush=True)
";

/// A node that starts after the listener. The listener finds this node only through a notification.
const TALKER: &str = "
import rospy, std_msgs.msg, std_srvs.srv
rospy.init_node('talker')
rospy.set_param('/gain', rospy.get_param('/gain') + 1)
rospy.Service('/reset', std_srvs.srv.Trigger, lambda request: std_srvs.srv.TriggerResponse(True, 'done'))
rospy.Publisher('/chatter', std_msgs.msg.String, latch=True, queue_size=1).publish('hello')
rospy.spin()
";

/// A process that is killed at the end of the test.
struct Process(Child);

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn node(script: &str, port: u16, home: &str) -> Process {
    let mut command = Command::new("/usr/bin/python3");
    command
        .args(["-c", script])
        .env("ROS_MASTER_URI", format!("http://127.0.0.1:{port}"))
        .env("ROS_IP", "127.0.0.1")
        .env("ROS_HOME", home)
        .stdout(Stdio::piped());
    Process(command.spawn().unwrap())
}

#[test]
fn the_example_is_a_master_for_rospy() {
    // The folder of the examples is next to the test program's folder.
    let own = env::current_exe().unwrap();
    let example = own.ancestors().nth(2).unwrap().join("examples/master");
    let port = TcpListener::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap()
        .port();
    let mut command = Command::new(example);
    let _master = Process(command.arg(port.to_string()).spawn().unwrap());
    let home = env!("CARGO_TARGET_TMPDIR");
    let mut listener = node(LISTENER, port, home);
    let said = BufReader::new(listener.0.stdout.take().unwrap());
    let mut lines = said.lines().map(Result::unwrap);
    assert_eq!(lines.next().as_deref(), Some("ready"));
    let _talker = node(TALKER, port, home);
    let rest: Vec<_> = lines.collect();
    assert_eq!(rest, ["heard hello", "reset done", "gain 3"]);
    assert!(listener.0.wait().unwrap().success());
}
