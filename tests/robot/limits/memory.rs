//! However often the master of a large robot dies, rosrescue needs little memory.

use ros1_master::xmlrpc::{Call, Reply, Struct, Value, decode_call};

use crate::support::{Client, FakeMaster, Mode, Robot, eventually, params};

/// Number of nodes, each with two publishers and two subscribers.
const NODES: usize = 1_000;
const PARAMS: usize = 2_000;
/// Maximum memory use at any time, in KiB.
const LIMIT: u64 = 64 << 10;

/// A server that answers for all nodes: they count as alive, but report no publications.
fn nodes_server() -> FakeMaster {
    FakeMaster::start(|body| {
        let call = decode_call(body).expect("a call");
        let code = i32::from(call.method == "getPid");
        FakeMaster::proper(&Reply::Value(params![code, "", 4_711].into()))
    })
}

/// Registers the nodes, all publishers first, so that no subscriber is notified.
fn register(client: &Client, port: u16) {
    let call = |method: &str, node: usize, topic: String| {
        // The nodes have one port and differ in the path.
        let api = format!("http://127.0.0.1:{port}/{node}/");
        let name = format!("/robot/node_{node:04}");
        Call::new(method, params![name, topic, "std_msgs/String", api])
    };
    let topic = |node: usize, number| format!("/robot/node_{:04}/topic_{number}", node % NODES);
    let publishers = (0..2 * NODES).map(|i| call("registerPublisher", i / 2, topic(i / 2, i % 2)));
    let subscribers =
        (0..2 * NODES).map(|i| call("registerSubscriber", i / 2, topic(i / 2 + 1, i % 2)));
    let calls: Vec<_> = publishers.chain(subscribers).collect();
    client.call_all(&calls);
    let text = |number| Value::from(format!("the value of parameter {number}"));
    let params = (0..PARAMS).map(|number| (format!("param_{number:04}"), text(number)));
    client.set_param("/robot", Value::Struct(Struct::from_iter(params)));
}

#[test]
fn a_thousand_nodes_take_less_than_64_mib_through_three_recoveries() {
    let server = nodes_server();
    let mut robot = Robot::start(Mode::Core);
    let client = robot.client();
    register(&client, server.port());
    // The maximum memory use so far.
    let peak = |robot: &Robot| robot.rescue.kib("VmHWM");
    let mut peaks = vec![peak(&robot)];
    for _ in 0..3 {
        robot.crash_master();
        eventually("the health check has finished", || {
            let status = robot.status().expect("a status page");
            status["last_recovery"]["health_check_ms"].is_number()
        });
        let status = robot.status().expect("a status page");
        let (report, state) = (&status["last_recovery"], &status["state"]);
        assert_eq!(report["outcome"], "injected");
        assert_eq!(report["removed"].as_array().map(Vec::len), Some(0));
        // rosout is one more node, with one publisher and one subscriber.
        for (what, count) in [("nodes", NODES), ("publishers", 2 * NODES)] {
            assert_eq!(state[what].as_u64(), Some(count as u64 + 1), "{what}");
        }
        peaks.push(peak(&robot));
    }
    println!("maximum KiB at first and after each recovery: {peaks:?}");
    assert!(peaks.iter().all(|peak| *peak < LIMIT), "{peaks:?}");
}
