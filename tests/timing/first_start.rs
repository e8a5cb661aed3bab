//! rosrescue answers before its rosmaster is up, at once.

use std::{
    fs,
    net::TcpStream,
    path::Path,
    thread::sleep,
    time::{Duration, Instant},
};

use crate::support::{
    Client, FakeNode, NODES, Scratch, Setup, State, eventually, eventually_some, free_port, params,
};

/// A first answer takes no longer, from the moment at which the port is open: roslaunch and nodes find their
/// master at once.
const AT_ONCE: Duration = Duration::from_millis(20);
/// Of so many starts the fastest has to keep to that, and half of them to [`BUSY`]: the computer has other
/// things to do.
const STARTS: usize = 5;
const BUSY: Duration = Duration::from_millis(100);

/// A core whose rosmaster waits until the file `away` is gone.
fn core(scratch: &Scratch, master_port: u16) -> Setup {
    fs::write(scratch.path("away"), "").unwrap();
    let waiting = Path::new(NODES).join("waiting_rosmaster.py");
    Setup::core(scratch, master_port)
        .arg("--rosmaster")
        .arg(waiting)
}

#[test]
fn a_core_answers_at_once_and_its_master_gets_all_of_it() {
    let _alone = crate::alone();
    let mut times = Vec::new();
    for _ in 0..STARTS {
        let scratch = Scratch::new();
        let master_port = free_port();
        let publisher = FakeNode::start("/early");
        let subscriber = FakeNode::start("/early_too");
        let mut rescue = core(&scratch, master_port).spawn();
        let client = rescue.client();
        let begin = Instant::now();
        while TcpStream::connect(("127.0.0.1", client.port())).is_err() {
            assert_eq!(rescue.exited(), None);
            assert!(begin.elapsed() < Duration::from_secs(60));
            sleep(Duration::from_micros(200));
        }
        let open = Instant::now();
        client.ok("getPid", params!["/test"]);
        let pid = open.elapsed();
        subscriber.subscribe(&client, "/chatter", "std_msgs/String");
        publisher.publish(&client, "/chatter", "std_msgs/String");
        client.set_param("/early/gain", 1.5);
        publisher.watch_param(&client, "/early/gain");
        publisher.offer(&client, "/early/service");
        let all = open.elapsed();
        times.push((pid, all));
        let bare = Client::new(master_port);
        assert!(bare.master_pid().is_none(), "there is no master yet");
        eventually("the subscriber is told", || {
            subscriber.updates("/chatter") == [[publisher.api.clone()]]
        });

        fs::remove_file(scratch.path("away")).unwrap();
        rescue.wait_serving();
        let state = eventually_some("rosout is at work", || {
            let state = State::try_read(&bare).ok()?;
            (state.subscribers_of("/rosout") == ["/rosout"]).then_some(state)
        });
        eventually("the mirror is equal to the master", || {
            State::read(&client) == State::read(&bare)
        });
        assert_eq!(state.publishers_of("/chatter"), ["/early"]);
        assert_eq!(state.subscribers_of("/chatter"), ["/early_too"]);
        assert_eq!(bare.param("/early/gain"), Some(1.5.into()));
        // The master knows the subscription of the parameter, which nobody can read.
        client.set_param("/early/gain", 2.5);
        eventually("the parameter's subscriber is told", || {
            // Twice if another node had not answered yet: rosrescue notifies beside the master then.
            let heard = publisher.heard("paramUpdate");
            heard.last().is_some_and(|update| update[2] == 2.5.into())
        });
        assert!(publisher.heard("shutdown").is_empty());
        assert!(subscriber.heard("shutdown").is_empty());
    }
    times.sort();
    println!("getPid, and five registrations after it, from the open port: {times:?}");
    assert!(times[0].0 < AT_ONCE, "{times:?}");
    assert!(times[STARTS / 2].1 < BUSY, "{times:?}");
}
