//! A switch with three cables, and what can be wrong with them.

use std::fs::File;
use std::os::fd::AsFd;
use std::sync::atomic::{AtomicU32, Ordering};
use std::thread;

use rustix::thread::{LinkNameSpaceType, move_into_link_name_space};

use crate::support::ip;

pub(crate) const COUNT: usize = 3;

/// The address of a computer. No other test sees it: the switch has a namespace of its own, too.
pub(crate) fn address(computer: usize) -> String {
    format!("10.77.0.{}", computer + 1)
}

/// Namespaces for three computers and the switch between them. They go on drop.
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

    /// The computer's cable is pulled.
    pub(crate) fn cut_cable(&self, computer: usize) {
        ip(&format!("-n {} link set port{computer} down", self.prefix));
    }

    pub(crate) fn mend_cable(&self, computer: usize) {
        ip(&format!("-n {} link set port{computer} up", self.prefix));
    }

    /// Packets between these two vanish.
    pub(crate) fn cut_pair(&self, one: usize, other: usize) {
        for (from, to) in [(one, other), (other, one)] {
            // A permanent entry for an Ethernet address that nobody has.
            ip(&format!(
                "-n {} neigh replace {} lladdr 02:00:00:00:00:99 dev eth0 nud permanent",
                self.namespace(from),
                address(to)
            ));
        }
    }

    pub(crate) fn mend_pair(&self, one: usize, other: usize) {
        for (from, to) in [(one, other), (other, one)] {
            ip(&format!(
                "-n {} neigh del {} dev eth0",
                self.namespace(from),
                address(to)
            ));
        }
    }

    /// What the server answers to this client vanishes; other ports and the other direction work.
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
            let _ = std::process::Command::new("ip")
                .args(["netns", "del", &name])
                .output();
        }
    }
}

/// From now on this thread opens its sockets on that computer.
pub(crate) fn enter(namespace: &str) {
    let file = File::open(format!("/run/netns/{namespace}")).unwrap();
    move_into_link_name_space(file.as_fd(), Some(LinkNameSpaceType::Network)).unwrap();
}

/// Does `work` with the sockets of that computer.
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
