//! A disk that does not answer, such as a dying SD card or an NFS server that is away. Reads continue, writes
//! wait for a limited time, and recording resumes when the disk answers.

use std::thread;
use std::time::Duration;

use crate::support::{
    Client, FailingDisk, FakeNode, Rescue, Rosmaster, Scratch, Setup, State, Trouble, eventually,
    free_port, holds, params, signal, status, within,
};
use rustix::process::Signal;

/// Maximum time for a call that does not wait for the disk. Calls that do wait for 5 s.
const SOON: Duration = Duration::from_secs(4);
/// Maximum time for a write on a disk that hangs. rosrescue gives up after 5 s.
const LATE: Duration = Duration::from_secs(30);

fn unprotected(client: &Client) -> Option<String> {
    let reason = status(client)["unprotected"].clone();
    reason.as_str().map(str::to_owned)
}

/// Makes all kinds of reads while `write` is under way on a disk that hangs.
#[track_caller]
fn assert_reads_go_on<T: Send + 'static>(
    client: &Client,
    write: impl FnOnce() -> T + Send + 'static,
) -> T {
    let write = thread::spawn(write);
    let mut rounds = 0;
    within(LATE, "a write", || {
        loop {
            let over = write.is_finished();
            within(SOON, "a parameter", || client.param("/before").unwrap());
            within(SOON, "the state", || State::read(client));
            within(SOON, "the status", || status(client));
            rounds += 1;
            if over {
                break;
            }
            thread::sleep(Duration::from_millis(20));
        }
    });
    assert!(rounds > 1, "no read is answered during the write");
    write.join().unwrap()
}

/// Kills rosrescue and the master, and checks that the state is `wanted` afterwards.
#[track_caller]
fn assert_survives(rescue: &mut Rescue, wanted: &State) {
    let client = rescue.client();
    let master = client.master_pid().unwrap();
    rescue.kill();
    signal(master, Signal::KILL);
    rescue.start_again();
    rescue.wait_serving();
    let found = State::read(&client);
    assert_eq!(found.params, wanted.params);
    assert_eq!(found.publishers_of("/topic"), ["/node"]);
}

#[test]
fn on_a_hung_disk_reads_continue_and_writes_wait_for_a_limited_time() {
    let scratch = Scratch::new();
    let disk = FailingDisk::new(&scratch);
    let setup = Setup::core(&scratch, free_port()).arg("--no-rosout");
    let mut rescue = disk.under(setup).start();
    let client = rescue.client();
    client.set_param("/before", 1);
    let node = FakeNode::start("/node");

    disk.begin(Trouble::Hangs);
    assert_reads_go_on(&client, {
        let client = client.clone();
        move || client.set_param("/during", 1)
    });
    let reason = unprotected(&client).expect("rosrescue must be unprotected");
    assert!(reason.contains("has not answered"), "{reason}");
    rescue.wait_line("that", |line| {
        line.contains("unprotected") && line.contains("has not answered")
    });
    // Nodes continue without the disk.
    within(SOON, "the next write", || client.set_param("/during", 2));
    node.publish(&client, "/topic", "std_msgs/String");
    let dead = client.master_pid().unwrap();
    signal(dead, Signal::KILL);
    eventually("another master answers", || {
        client.master_pid().is_some_and(|pid| pid != dead) && status(&client)["open"] == true
    });
    assert_eq!(client.param("/during"), Some(2.into()));

    disk.heal();
    eventually("rosrescue is protected again", || {
        unprotected(&client).is_none()
    });
    rescue.wait_line("that", |line| line.contains("protected again"));
    client.set_param("/after", 1);
    let wanted = State::read(&client);
    assert_survives(&mut rescue, &wanted);
}

/// The write that finds the disk silent is not answered by the mirror as one that changes nothing.
#[test]
fn a_deletion_waits_for_a_hung_disk_for_a_limited_time() {
    let scratch = Scratch::new();
    let disk = FailingDisk::new(&scratch);
    let setup = Setup::core(&scratch, free_port()).arg("--no-rosout");
    let rescue = disk.under(setup).start();
    let client = rescue.client();
    let node = FakeNode::start("/node");
    node.publish(&client, "/topic", "std_msgs/String");
    client.set_param("/x", 1);
    disk.begin(Trouble::Hangs);
    within(LATE, "a deletion", || {
        client.ok("deleteParam", params!["/node", "/x"])
    });
    node.unpublish(&client, "/topic");
    disk.heal();
}

/// The disk hangs again before the whole checkpoint that follows the first hang has been written.
#[test]
fn writes_between_two_hangs_of_the_disk_are_not_lost() {
    let scratch = Scratch::new();
    let disk = FailingDisk::new(&scratch);
    let setup = Setup::core(&scratch, free_port()).arg("--no-rosout");
    let mut rescue = disk.under(setup).start();
    let client = rescue.client();
    let node = FakeNode::start("/node");
    node.publish(&client, "/topic", "std_msgs/String");
    for round in 0..3 {
        disk.begin(Trouble::Hangs);
        within(LATE, "a write", || client.set_param("/round", round));
        assert!(unprotected(&client).is_some());
        client.set_param("/withheld", round);
        disk.begin(Trouble::Slow);
        client.set_param("/slow", round);
    }
    disk.heal();
    eventually("rosrescue is protected again", || {
        unprotected(&client).is_none()
    });
    let wanted = State::read(&client);
    assert_survives(&mut rescue, &wanted);
}

#[test]
fn rosrescue_can_be_stopped_on_a_hung_disk_and_reports_it() {
    let scratch = Scratch::new();
    let disk = FailingDisk::new(&scratch);
    let setup = Setup::core(&scratch, free_port());
    let mut rescue = disk.under(setup).start();
    let client = rescue.client();
    client.set_param("/before", 1);
    disk.begin(Trouble::Hangs);
    let status = within(LATE, "the stop", || rescue.terminate());
    assert_eq!(status.code(), Some(0));
    rescue.wait_line("the log says why there is no closing checkpoint", |line| {
        line.contains("stopped without a closing checkpoint")
    });
    assert_eq!(scratch.survivors(), vec![]);
    // The next start treats this as a crash and restores the state.
    disk.heal();
    rescue.start_again();
    rescue.wait_serving();
    assert_eq!(rescue.client().param("/before"), Some(1.into()));
}

/// rosrescue cannot write the first generation of the checkpoint.
#[test]
fn rosrescue_serves_calls_when_it_starts_on_a_hung_disk() {
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    let disk = FailingDisk::new(&scratch);
    let mut rescue = disk.under(Setup::proxy(&scratch, master.port)).start();
    rescue.client().set_param("/before", 1);
    rescue.kill();
    disk.begin(Trouble::Slow);
    rescue.start_again();
    let client = rescue.client();
    eventually("rosrescue answers", || client.param("/before").is_some());
    disk.begin(Trouble::Hangs);
    within(LATE, "a write", || client.set_param("/during", 1));
    disk.heal();
    eventually("rosrescue is protected", || unprotected(&client).is_none());
}

/// The promise of `--sync always` holds again as soon as the disk answers.
/// The PID file of the last master could not be written either.
#[test]
fn a_master_that_was_started_on_a_hung_disk_is_used_after_a_death_of_rosrescue() {
    let scratch = Scratch::new();
    let disk = FailingDisk::new(&scratch);
    let port = free_port();
    let mut rescue = disk
        .under(Setup::core(&scratch, port).arg("--no-rosout"))
        .start();
    let client = rescue.client();
    let node = FakeNode::start("/node");
    node.publish(&client, "/topic", "std_msgs/String");
    disk.begin(Trouble::Hangs);
    client.set_param("/during", 1);
    let dead = client.master_pid().unwrap();
    signal(dead, Signal::KILL);
    eventually("another master answers", || {
        client.master_pid().is_some_and(|pid| pid != dead) && status(&client)["open"] == true
    });
    let master = client.master_pid();
    let wanted = State::read(&client);

    rescue.kill();
    rescue.start_again();
    rescue.wait_line("the disk is silent", |line| {
        line.contains("the disk has not opened the checkpoint")
    });
    rescue.wait_serving();
    assert_eq!(Client::new(port).master_pid(), master);
    wanted.assert_same(&State::read(&client), "after the death of rosrescue");
    disk.heal();
    eventually("rosrescue is protected again", || {
        unprotected(&client).is_none()
    });
    assert_survives(&mut rescue, &wanted);
}

/// A `core` whose answers wait until the disk has them, with the parameter and the node of [`assert_survives`].
fn core_that_syncs(scratch: &Scratch, disk: &FailingDisk) -> (Rescue, FakeNode) {
    let setup = Setup::core(scratch, free_port()).args(["--no-rosout", "--sync", "always"]);
    let rescue = disk.under(setup).start();
    let client = rescue.client();
    client.set_param("/before", 1);
    let node = FakeNode::start("/node");
    node.publish(&client, "/topic", "std_msgs/String");
    (rescue, node)
}

/// A memory card may take seconds for a whole checkpoint. Meanwhile the present file has all writes.
#[test]
fn no_write_waits_for_a_whole_checkpoint() {
    let scratch = Scratch::new();
    let disk = FailingDisk::new(&scratch);
    let (mut rescue, _node) = core_that_syncs(&scratch, &disk);
    let client = rescue.client();
    disk.begin(Trouble::HangsOnNewFile);
    let folder = rescue.checkpoint().parent().unwrap().to_owned();
    eventually("a new checkpoint is being written", || {
        let files = std::fs::read_dir(&folder).unwrap();
        let mut names = files.map(|file| file.unwrap().file_name());
        names.any(|name| name.to_string_lossy().contains(".new-"))
    });
    within(SOON, "a write", || client.set_param("/during", 1));
    assert_eq!(unprotected(&client), None);
    disk.heal();
    let wanted = State::read(&client);
    assert_survives(&mut rescue, &wanted);
}

#[test]
fn answers_wait_for_the_disk_again_as_soon_as_it_syncs() {
    let scratch = Scratch::new();
    let disk = FailingDisk::new(&scratch);
    let (mut rescue, _node) = core_that_syncs(&scratch, &disk);
    let client = rescue.client();
    disk.begin(Trouble::Hangs);
    assert_reads_go_on(&client, {
        let client = client.clone();
        move || client.set_param("/during", 1)
    });
    assert!(unprotected(&client).is_some());
    disk.heal();
    eventually("rosrescue is protected again", || {
        unprotected(&client).is_none()
    });
    disk.begin(Trouble::Hangs);
    let write = thread::spawn({
        let client = client.clone();
        move || client.set_param("/waits", 1)
    });
    let waits = holds(Duration::from_millis(700), || !write.is_finished());
    disk.heal();
    assert!(waits, "the answer did not wait for the disk");
    write.join().unwrap();
    let wanted = State::read(&client);
    assert_survives(&mut rescue, &wanted);
}
