//! A DHCP server takes this computer's address away, gives it back or gives another one, and an interface is renamed.
//! Real nodes on both sides of the cable must be connected again afterwards.
//!
//! `ROSRESCUE_ROUNDS=34 cargo test --test robot dhcp -- --nocapture` plays 102 rounds and prints how long all took.

use std::fs;
use std::net::{IpAddr, UdpSocket};
use std::os::unix::fs::PermissionsExt;
use std::process::Command;
use std::time::{Duration, Instant};

use rustix::process::Signal;

use crate::support::{
    Library, Netns, Node, Process, Rescue, Scratch, Setup, eventually, free_port, holds, ip, names,
    signal, status,
};

/// Sets what `udhcpc` has got or lost.
const SCRIPT: &str = r#"#!/bin/sh
case $1 in
deconfig) ip -4 addr flush dev "$interface"; ip link set "$interface" up ;;
bound | renew) ip addr replace "$ip/24" dev "$interface" ;;
esac
"#;
/// The least time without the address after it is reported. TCP repeats a packet ever more rarely, so a link takes up to
/// as long to come back as the address was away.
const AWAY: [Duration; 3] = [
    Duration::ZERO,
    Duration::from_millis(700),
    Duration::from_millis(3000),
];

fn is_here(address: &str) -> bool {
    let address: IpAddr = address.parse().unwrap();
    UdpSocket::bind((address, 0)).is_ok()
}

/// A DHCP server on the other side of the cable, and a DHCP client on this side.
struct Dhcp<'a> {
    net: &'a Netns,
    scratch: &'a Scratch,
    device: String,
    server: Process,
    client: Process,
}

impl<'a> Dhcp<'a> {
    /// Starts both, and waits for the address.
    fn start(net: &'a Netns, scratch: &'a Scratch) -> Self {
        net.lose_near();
        let script = scratch.path("udhcpc.sh");
        fs::write(&script, SCRIPT).unwrap();
        fs::set_permissions(&script, fs::Permissions::from_mode(0o755)).unwrap();
        let (server, device) = (server(net, scratch, &net.near()), net.near_device());
        let client = client(scratch, &device);
        let this = Self {
            net,
            scratch,
            device,
            server,
            client,
        };
        this.await_address(&net.near());
        this
    }

    fn await_address(&self, address: &str) -> Instant {
        eventually("the address is here", || is_here(address));
        Instant::now()
    }

    /// Gives the lease back, and with it the address.
    fn release(&self) {
        signal(self.client.pid(), Signal::USR2);
        let near = self.net.near();
        eventually("the address is gone", || !is_here(&near));
    }

    /// Asks for a lease.
    fn renew(&self) {
        signal(self.client.pid(), Signal::USR1);
    }

    /// From now on the server has only this address to give.
    fn offer(&mut self, address: &str) {
        self.server.kill();
        self.server = server(self.net, self.scratch, address);
    }

    /// Gives the interface another name, for which the client has to be started again.
    fn rename(&mut self) {
        self.client.kill();
        let before = self.device.clone();
        self.device = match before.strip_suffix('x') {
            Some(name) => name.to_owned(),
            None => format!("{before}x"),
        };
        ip(&format!("link set {before} down"));
        ip(&format!("link set {before} name {}", self.device));
        ip(&format!("link set {} up", self.device));
        ip(&format!("-4 addr flush dev {}", self.device));
    }
}

fn server(net: &Netns, scratch: &Scratch, address: &str) -> Process {
    let [config, leases, pid] =
        ["udhcpd.conf", "udhcpd.leases", "udhcpd.pid"].map(|it| scratch.path(it));
    fs::write(&leases, "").unwrap();
    let (leases, pid, device) = (leases.display(), pid.display(), net.far_device());
    let text = format!(
        "start {address}\nend {address}\ninterface {device}\nlease_file {leases}\npidfile {pid}\n\
         opt subnet 255.255.255.0\nopt lease 3600\n"
    );
    fs::write(&config, text).unwrap();
    let mut command = Command::new("busybox");
    command.args(["udhcpd", "-f", "-a50"]).arg(config);
    scratch.prepare(&mut command);
    Process::start("udhcpd", &mut net.inside(&command))
}

fn client(scratch: &Scratch, device: &str) -> Process {
    let mut command = Command::new("busybox");
    command.args(["udhcpc", "-f", "-i", device, "-t", "60", "-T", "1", "-s"]);
    command.arg(scratch.path("udhcpc.sh"));
    scratch.prepare(&mut command);
    Process::start("udhcpc", &mut command)
}

/// Talkers and listeners of both libraries on both sides.
struct Nodes {
    listeners: Vec<Node>,
    /// Kept alive.
    _talkers: Vec<Node>,
}

const TALKERS: [&str; 4] = ["/near_rospy", "/near_roscpp", "/far_rospy", "/far_roscpp"];

impl Nodes {
    fn start(net: &Netns, scratch: &Scratch, port: u16) -> Self {
        let run = |node: &str, index: usize, library: Library| {
            let host = if index < 2 {
                net.near()
            } else {
                net.far(index as u8)
            };
            let mut command = library.command(scratch, port, node);
            command
                .arg(format!("__name:={}{node}", &TALKERS[index][1..]))
                .args((node == "talker").then_some("20"))
                .env("ROS_IP", &host);
            if index < 2 {
                return Node::run(&mut command);
            }
            command.env("ROS_MASTER_URI", format!("http://{}:{port}", net.near()));
            Node::run(&mut net.inside(&command))
        };
        let libraries = [Library::Rospy, Library::Roscpp];
        let all = |node| {
            let nodes = (0..4).map(|index| run(node, index, libraries[index % 2]));
            nodes.collect::<Vec<_>>()
        };
        Self {
            listeners: all("listener"),
            _talkers: all("talker"),
        }
    }

    /// The number of messages that each listener has from each talker.
    fn counts(&self) -> Vec<usize> {
        let talkers = TALKERS.map(|name| format!("{name}talker"));
        let of = |node: &Node| talkers.each_ref().map(|name| node.messages(name).len());
        self.listeners.iter().flat_map(of).collect()
    }

    /// Waits until each listener has more messages of each talker than now.
    fn await_messages(&self) {
        let before = self.counts();
        eventually("each listener hears each talker", || {
            let now = self.counts();
            now.iter().zip(&before).all(|(now, before)| now > before)
        });
    }
}

fn lost(rescue: &Rescue) -> Vec<String> {
    names(&status(&rescue.client())["lost_addresses"][0]["nodes"])
}

#[test]
fn nodes_are_connected_again_when_dhcp_gives_their_address_back() {
    let rounds = std::env::var("ROSRESCUE_ROUNDS").map_or(1, |rounds| rounds.parse().unwrap());
    let net = Netns::new();
    let scratch = Scratch::new();
    let mut dhcp = Dhcp::start(&net, &scratch);
    let setup = Setup::core(&scratch, free_port()).arg("--no-rosout");
    let rescue = setup.env("ROS_IP", net.near()).start();
    let nodes = Nodes::start(&net, &scratch, rescue.port());
    nodes.await_messages();
    let mut slowest = [Duration::ZERO; 3];
    for round in 0..3 * rounds {
        let begun = Instant::now();
        let kind = ["lost", "changed", "renamed"][round % 3];
        match kind {
            "lost" => dhcp.release(),
            "changed" => {
                dhcp.offer(&net.moved());
                dhcp.release();
                dhcp.renew();
                dhcp.await_address(&net.moved());
            }
            _ => dhcp.rename(),
        }
        eventually("the lost address is reported", || lost(&rescue).len() == 4);
        let reported = begun.elapsed();
        let still = holds(AWAY[round / 3 % 3], || lost(&rescue).len() == 4);
        assert!(
            still,
            "the address is still away: {}",
            status(&rescue.client())
        );
        match kind {
            "lost" => dhcp.renew(),
            "changed" => {
                dhcp.offer(&net.near());
                signal(dhcp.client.pid(), Signal::USR2);
                eventually("the other address is gone", || !is_here(&net.moved()));
                dhcp.renew();
            }
            _ => dhcp.client = client(&scratch, &dhcp.device),
        }
        let back = dhcp.await_address(&net.near());
        let heard = std::thread::scope(|scope| {
            let heard = scope.spawn(|| {
                nodes.await_messages();
                back.elapsed()
            });
            eventually("no address is lost", || lost(&rescue).is_empty());
            slowest[1] = slowest[1].max(back.elapsed());
            heard.join().unwrap()
        });
        println!("{kind}: reported after {reported:.2?}, messages {heard:.2?} after the return");
        slowest[0] = slowest[0].max(reported);
        slowest[2] = slowest[2].max(heard);
    }
    println!(
        "{} rounds: reported, known to be back, connected again after {slowest:.2?} at most",
        3 * rounds
    );
}
