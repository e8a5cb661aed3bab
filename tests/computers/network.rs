//! A switch with three cables that can be cut or made worse.

use std::fs::File;
use std::os::fd::AsFd;
use std::process::Command;
use std::sync::atomic::{AtomicU32, Ordering};
use std::thread;

use rustix::thread::{LinkNameSpaceType, move_into_link_name_space};

use crate::support::{Process, ip};

pub(crate) const COUNT: usize = 3;

const BAD_NETWORK: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/tests/computers/bad_network.py"
);

/// The defects of a bad cable.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Quality {
    /// Delay in each direction, in milliseconds.
    pub(crate) delay: u32,
    /// Additional random delay of up to this many milliseconds.
    pub(crate) jitter: u32,
    /// Percentage of packets that are lost in each direction.
    pub(crate) loss: u32,
}

/// The address of a computer. Other tests may use the same one, because the switch has its own namespace.
pub(crate) fn address(computer: usize) -> String {
    format!("10.77.0.{}", computer + 1)
}

/// Network namespaces for three computers and the switch between them. They are removed on drop.
#[derive(Debug)]
pub(crate) struct Network {
    prefix: String,
}

impl Network {
    #[track_caller]
    pub(crate) fn new() -> Self {
        static NUMBER: AtomicU32 = AtomicU32::new(0);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let this = Self {
            prefix: format!("rosrescue-{}-switch{number}", std::process::id()),
        };
        let switch = &this.prefix;
        ip(&format!("netns add {switch}"));
        ip(&format!("-n {switch} link add switch type bridge"));
        ip(&format!("-n {switch} link set switch up"));
        for computer in 0..COUNT {
            let (name, address) = (this.namespace(computer), address(computer));
            ip(&format!("netns add {name}"));
            ip(&format!(
                "link add port{computer} netns {switch} type veth peer name eth0 netns {name}"
            ));
            ip(&format!(
                "-n {switch} link set port{computer} master switch up"
            ));
            ip(&format!("-n {name} link set lo up"));
            ip(&format!("-n {name} addr add {address}/24 dev eth0"));
            ip(&format!("-n {name} link set eth0 up"));
        }
        this
    }

    pub(crate) fn namespace(&self, computer: usize) -> String {
        format!("{}-{computer}", self.prefix)
    }

    /// Cuts the computer's cable.
    pub(crate) fn cut_cable(&self, computer: usize) {
        ip(&format!("-n {} link set port{computer} down", self.prefix));
    }

    pub(crate) fn mend_cable(&self, computer: usize) {
        ip(&format!("-n {} link set port{computer} up", self.prefix));
    }

    /// Drops all packets between two computers.
    pub(crate) fn cut_pair(&self, one: usize, other: usize) {
        self.cut_way(one, other);
        self.cut_way(other, one);
    }

    pub(crate) fn mend_pair(&self, one: usize, other: usize) {
        self.mend_way(one, other);
        self.mend_way(other, one);
    }

    /// Drops packets in one direction.
    pub(crate) fn cut_way(&self, from: usize, to: usize) {
        // A permanent entry for an Ethernet address that no device has.
        ip(&format!(
            "-n {} neigh replace {} lladdr 02:00:00:00:00:99 dev eth0 nud permanent",
            self.namespace(from),
            address(to)
        ));
    }

    pub(crate) fn mend_way(&self, from: usize, to: usize) {
        ip(&format!(
            "-n {} neigh del {} dev eth0",
            self.namespace(from),
            address(to)
        ));
    }

    /// Makes the computer's cable delay and lose packets, until the returned process is passed to
    /// [`Self::mend_quality`].
    #[track_caller]
    pub(crate) fn worsen(&self, computer: usize, quality: &Quality, seed: u64) -> Process {
        let switch = &self.prefix;
        let (inner, outer) = (format!("inner{computer}"), format!("outer{computer}"));
        ip(&format!(
            "-n {switch} link add {inner} type veth peer name {outer}"
        ));
        ip(&format!("-n {switch} link set {outer} up"));
        ip(&format!("-n {switch} link set port{computer} nomaster"));
        ip(&format!("-n {switch} link set {inner} master switch up"));
        let mut command = Command::new("ip");
        command.args(["netns", "exec", switch, "/usr/bin/python3", BAD_NETWORK]);
        command.args([format!("port{computer}"), outer]);
        let Quality {
            delay,
            jitter,
            loss,
        } = quality;
        command.args([delay, jitter, loss].map(u32::to_string));
        command.arg(seed.to_string());
        let mut bad = Process::start(format!("the cable of {computer}"), &mut command);
        bad.wait_line("`ready`", |line| line == "ready");
        bad
    }

    #[track_caller]
    pub(crate) fn mend_quality(&self, computer: usize, mut bad: Process) {
        assert!(
            bad.exited().is_none(),
            "the process of the bad cable has ended:\n{}",
            bad.log()
        );
        bad.kill();
        let switch = &self.prefix;
        ip(&format!("-n {switch} link del inner{computer}"));
        ip(&format!(
            "-n {switch} link set port{computer} master switch"
        ));
    }

    /// Drops packets from `port` of the server to the client. Other ports and the other direction work.
    pub(crate) fn cut_port(&self, client: usize, server: usize, port: u16) {
        ip(&self.rule("add", client, server, port));
    }

    pub(crate) fn mend_port(&self, client: usize, server: usize, port: u16) {
        ip(&self.rule("del", client, server, port));
    }

    fn rule(&self, verb: &str, client: usize, server: usize, port: u16) -> String {
        format!(
            "-n {} rule {verb} to {} ipproto tcp sport {port} blackhole",
            self.namespace(server),
            address(client)
        )
    }
}

impl Drop for Network {
    fn drop(&mut self) {
        for name in (0..COUNT)
            .map(|computer| self.namespace(computer))
            .chain([self.prefix.clone()])
        {
            let _ = Command::new("ip").args(["netns", "del", &name]).output();
        }
    }
}

/// Moves this thread to the computer's network: sockets are opened there from now on.
pub(crate) fn enter(namespace: &str) {
    let file = File::open(format!("/run/netns/{namespace}")).unwrap();
    move_into_link_name_space(file.as_fd(), Some(LinkNameSpaceType::Network)).unwrap();
}

/// Runs `work` in the computer's network.
#[track_caller]
pub(crate) fn within<T: Send>(namespace: &str, work: impl FnOnce() -> T + Send) -> T {
    let done = thread::scope(|scope| {
        let inside = scope.spawn(|| {
            enter(namespace);
            work()
        });
        inside.join()
    });
    done.unwrap_or_else(|panic| std::panic::resume_unwind(panic))
}
