//! A master on another computer: neither dead connections to it nor a failing name server delay calls for
//! long.

use std::process::Command;
use std::thread;
use std::time::Duration;

use ros1_master::xmlrpc::Value;

use crate::support::{
    Client, NameServer, Netns, Process, Rosmaster, Scratch, Setup, eventually, find_program,
    free_port, holds, params, status, within,
};

/// The address of the master on the other side.
const HOST: u8 = 2;
/// Options that end a connection after three seconds without an answer.
const PROBES: [&str; 6] = [
    "--probe-interval",
    "100",
    "--probe-timeout",
    "1000",
    "--probe-count",
    "2",
];
/// The time limit of three seconds, with a reserve for a busy computer. TCP's own limits are longer.
const SILENCE: Duration = Duration::from_secs(10);
const SOON: Duration = Duration::from_secs(4);

/// A rosmaster on the other side of `net` that answers calls.
#[track_caller]
fn rosmaster(scratch: &Scratch, net: &Netns, port: u16) -> (Process, Client) {
    let mut command = Command::new(find_program("rosmaster"));
    scratch.prepare(&mut command);
    command.args(["--core", "-p"]).arg(port.to_string());
    command.env("ROS_IP", net.far(HOST));
    let process = Process::start("the far rosmaster", &mut net.inside(&command));
    let client = Client::at(&net.far(HOST), port);
    eventually("the far rosmaster answers", || {
        client.master_pid() == Some(process.pid())
    });
    (process, client)
}

/// A rosrescue in front of the master at `host`.
fn proxy(scratch: &Scratch, host: &str, master_port: u16) -> Setup {
    let port = free_port();
    let master = format!("http://{host}:{master_port}");
    let listen = format!("127.0.0.1:{port}");
    let arguments = ["proxy", "--master", &master, "--listen", &listen];
    let setup = Setup::bare(scratch, arguments).at_port(port);
    setup.args(["--hold", "60", "--verbose"]).args(PROBES)
}

fn is_open(client: &Client) -> bool {
    status(client)["open"] == true
}

/// Calls that were under way when the link was cut are answered by the mirror, and delivered to the master as
/// soon as the link is back, without waiting for TCP's next attempt.
#[test]
fn the_mirror_stands_in_while_the_link_is_cut_and_writes_pass_as_soon_as_it_is_back() {
    let net = Netns::new();
    let scratch = Scratch::new();
    let port = free_port();
    let (_master, far) = rosmaster(&scratch, &net, port);
    let rescue = proxy(&scratch, &net.far(HOST), port).start();
    let client = rescue.client();
    client.set_param("/before", 1);
    net.cut(HOST);
    within(SILENCE, "the verdict", || client.set_param("/flying", 1));
    within(SOON, "a write and a read", || {
        client.set_param("/without", 1);
        assert_eq!(client.param("/flying"), Some(Value::Int(1)));
    });
    // TCP sends again after 0.2, 0.6, 1.4, 3, 6.2, 12.6 and 25.4 s.
    assert!(holds(Duration::from_secs(14), || !is_open(&client)));
    net.mend(HOST);
    within(SILENCE, "the return of the link", || {
        eventually("the gate is open", || is_open(&client));
    });
    within(SOON, "a write", || client.set_param("/after", 1));
    for key in ["/before", "/flying", "/without", "/after"] {
        assert_eq!(far.param(key), Some(Value::Int(1)), "{key}");
    }
}

/// All existing connections die without notice; new connections work.
#[test]
fn a_change_of_our_own_address_causes_one_short_delay() {
    let net = Netns::new();
    let scratch = Scratch::new();
    let port = free_port();
    let (_master, far) = rosmaster(&scratch, &net, port);
    let rescue = proxy(&scratch, &net.far(HOST), port).start();
    let client = rescue.client();
    client.set_param("/before", 1);
    assert_eq!(client.param("/before"), Some(Value::Int(1)));
    net.move_near();
    within(SILENCE, "a write and a read", || {
        let writing = thread::spawn({
            let client = client.clone();
            move || client.set_param("/after", 1)
        });
        assert_eq!(client.param("/before"), Some(Value::Int(1)));
        writing.join().unwrap();
    });
    within(SOON, "a later write", || client.set_param("/later", 1));
    eventually("the gate is open", || is_open(&client));
    for key in ["/after", "/later"] {
        assert_eq!(far.param(key), Some(Value::Int(1)), "{key}");
    }
}

/// rosrescue looks the master's name up for each connection. If that fails, it uses the last known address.
#[test]
fn a_failing_name_server_does_not_disconnect_the_master() {
    let net = Netns::new();
    let scratch = Scratch::new();
    let names = NameServer::silent(&scratch);
    names.say(net.far(HOST).parse().unwrap(), Duration::ZERO);
    let port = free_port();
    let (mut master, _) = rosmaster(&scratch, &net, port);
    let setup = proxy(&scratch, "master.test", port);
    let rescue = setup.wrapped(|own| names.serving(own)).start();
    let client = rescue.client();
    client.set_param("/kept", 1);
    names.fall_silent();
    let mut number = 0;
    let all_is_well = || {
        number += 1;
        client.set_param("/number", number);
        is_open(&client)
    };
    assert!(holds(Duration::from_secs(5), all_is_well));
    // A failing name server does not prevent a recovery at the same address either.
    master.kill();
    let (_master, far) = rosmaster(&scratch, &net, port);
    eventually("the master is restored", || {
        far.param("/kept") == Some(Value::Int(1)) && is_open(&client)
    });
    // A master at another address is found, even if the name server answers too late for every probe.
    net.cut(HOST);
    eventually("the gate is shut", || !is_open(&client));
    names.say(
        net.far(HOST + 1).parse().unwrap(),
        Duration::from_millis(600),
    );
    eventually("the gate is open", || is_open(&client));
    client.set_param("/elsewhere", 1);
}

#[test]
fn stopping_does_not_wait_for_the_lookup_of_the_masters_name() {
    let scratch = Scratch::new();
    let names = NameServer::silent(&scratch);
    let setup = proxy(&scratch, "master.test", free_port());
    let mut rescue = setup.wrapped(|own| names.serving(own)).spawn();
    rescue.wait_line("the log says that it waits for the master", |line| {
        line.contains("cannot reach")
    });
    let status = within(SOON, "a stop", || rescue.terminate());
    assert_eq!(status.code(), Some(0));
}

/// After a reboot rosrescue asks whether nodes of the session are alive on other computers.
#[test]
fn stopping_does_not_wait_for_the_lookup_of_node_names() {
    let scratch = Scratch::new();
    let names = NameServer::silent(&scratch);
    let port = free_port();
    let _master = Rosmaster::start_at(&scratch, port);
    let setup = Setup::proxy(&scratch, port);
    let mut rescue = setup.wrapped(|own| names.serving(own)).start();
    let api = "http://node.test:4711/";
    let params = params!["/node", "/topic", "std_msgs/String", api];
    rescue.client().ok("registerPublisher", params);
    rescue.kill();
    let boot_id = scratch.path("boot_id");
    std::fs::write(&boot_id, "another boot").unwrap();
    rescue.start_after_reboot(&boot_id);
    rescue.wait_serving();
    let status = within(SOON, "a stop", || rescue.terminate());
    assert_eq!(status.code(), Some(0));
}
