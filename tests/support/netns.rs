//! Another computer at the end of a cable: a network namespace, with a way to make packets to it or from it
//! vanish. Needs root and iproute2.

use std::io::Write;
use std::net::Ipv6Addr;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU8, Ordering};

use super::namespace::isolate;
use super::process::behind;

/// A network namespace with a veth to this one. Both are removed on drop.
#[derive(Debug)]
pub(crate) struct Netns {
    name: String,
    near: String,
    net: String,
}

/// Runs `ip`. Panics with its output if it fails.
#[track_caller]
pub(crate) fn ip(words: &str) {
    let output = Command::new("ip").args(words.split(' ')).output();
    let output = output.expect("`ip` is missing: tests/run.sh installs iproute2");
    assert!(
        output.status.success(),
        "ip {words}: {}(network namespaces need root)",
        String::from_utf8_lossy(&output.stderr)
    );
}

/// Runs one `ip` with many commands, one per line, in the namespace `name`. Panics with its output if it fails.
#[track_caller]
fn ip_batch(name: &str, commands: &str) {
    let mut ip = Command::new("ip")
        .args(["-n", name, "-batch", "-"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut input = ip.stdin.take().unwrap();
    input.write_all(commands.as_bytes()).unwrap();
    drop(input);
    let output = ip.wait_with_output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "ip -batch: {errors}\n{commands}");
}

impl Netns {
    #[track_caller]
    pub(crate) fn new() -> Self {
        isolate();
        static COUNT: AtomicU8 = AtomicU8::new(0);
        let number = COUNT.fetch_add(1, Ordering::Relaxed);
        let pid = std::process::id();
        // 32 networks for each of the 1,024 test processes that may run at the same time.
        let net = (pid % 1024) * 32 + u32::from(number) % 32;
        let net = format!("10.{}.{}", 64 + (net >> 8), net & 255);
        let near = format!("rr{pid}n{number}");
        let far = format!("rr{pid}f{number}");
        let name = format!("rosrescue-{pid}-{number}");
        let this = Self {
            name: name.clone(),
            near: near.clone(),
            net: net.clone(),
        };
        ip(&format!("netns add {name}"));
        ip(&format!(
            "link add {near} type veth peer name {far} netns {name}"
        ));
        ip(&format!("addr add {net}.1/24 dev {near}"));
        ip(&format!("link set {near} up"));
        ip(&format!("-n {name} link set lo up"));
        let addresses = (2..40).map(|host| format!("addr add {net}.{host}/24 dev {far}\n"));
        let up = format!("link set {far} up\n");
        let commands: String = addresses.chain([up]).collect();
        ip_batch(&name, &commands);
        this
    }

    /// The address of this side, as the other side sees it.
    pub(crate) fn near(&self) -> String {
        format!("{}.1", self.net)
    }

    /// The address of this side after [`Self::move_near`].
    pub(crate) fn moved(&self) -> String {
        format!("{}.100", self.net)
    }

    /// The network interface of this side.
    pub(crate) fn near_device(&self) -> String {
        self.near.clone()
    }

    /// The network interface of the other side.
    pub(crate) fn far_device(&self) -> String {
        self.near.replacen('n', "f", 1)
    }

    /// An address of the other side. `host` is from 2 to 39.
    pub(crate) fn far(&self, host: u8) -> String {
        format!("{}.{host}", self.net)
    }

    /// Gives both sides IPv6 addresses as well: [`Self::near6`], and [`Self::far6`] from 2 to 5.
    pub(crate) fn add_ipv6(&self) {
        let Self { name, near, .. } = self;
        // `nodad`: usable at once, without a search for duplicates.
        ip(&format!("addr add {}/64 dev {near} nodad", self.near6()));
        let far = self.far_device();
        for host in 2..6 {
            ip(&format!(
                "-n {name} addr add {}/64 dev {far} nodad",
                self.far6(host)
            ));
        }
    }

    /// The IPv6 address of this side.
    pub(crate) fn near6(&self) -> String {
        self.far6(1)
    }

    /// An IPv6 address of the other side, in the form in which programs print it.
    pub(crate) fn far6(&self, host: u8) -> String {
        let net = self.net.replace('.', ":");
        let address: Ipv6Addr = format!("fd00:{net}::{host}").parse().unwrap();
        address.to_string()
    }

    /// Makes packets to that address vanish.
    pub(crate) fn cut(&self, host: u8) {
        let Self { near, net, .. } = self;
        // A permanent entry for an Ethernet address that no device has.
        ip(&format!(
            "neigh replace {net}.{host} lladdr 02:00:00:00:00:99 dev {near} nud permanent"
        ));
    }

    /// Lets packets to that address arrive again.
    pub(crate) fn mend(&self, host: u8) {
        ip(&format!("neigh del {}.{host} dev {}", self.net, self.near));
    }

    /// Changes the address of this side, as DHCP may do. Connections from [`near`](Self::near) are lost without notice.
    pub(crate) fn move_near(&self) {
        let Self { near, net, .. } = self;
        ip(&format!("addr del {net}.1/24 dev {near}"));
        ip(&format!("addr add {net}.100/24 dev {near}"));
    }

    /// Takes the address of this side away.
    pub(crate) fn lose_near(&self) {
        let Self { near, net, .. } = self;
        ip(&format!("addr del {net}.1/24 dev {near}"));
    }

    /// Gives this side its address back.
    pub(crate) fn return_near(&self) {
        let Self { near, net, .. } = self;
        ip(&format!("addr add {net}.1/24 dev {near}"));
    }

    /// Gives [`near`](Self::near) to the other side, and this side another address.
    pub(crate) fn give_near_away(&self) {
        self.move_near();
        self.far_side("add");
    }

    /// Takes back what [`Self::give_near_away`] gave.
    pub(crate) fn take_near_back(&self) {
        self.far_side("del");
        ip(&format!("addr del {}/24 dev {}", self.moved(), self.near));
        self.return_near();
    }

    /// Adds or deletes [`near`](Self::near) on the other side.
    fn far_side(&self, verb: &str) {
        let (name, near, far) = (&self.name, self.near(), self.far_device());
        ip(&format!("-n {name} addr {verb} {near}/24 dev {far}"));
    }

    /// Wraps `command` so that it runs on the other side.
    pub(crate) fn inside(&self, command: &Command) -> Command {
        let mut inside = Command::new("ip");
        inside.args(["netns", "exec", &self.name]);
        behind(inside, command)
    }
}

impl Drop for Netns {
    fn drop(&mut self) {
        // The veth vanishes with the namespace, after its last process has ended. Deleting it by name is
        // immediate.
        let _ = Command::new("ip")
            .args(["link", "del", &self.near])
            .output();
        let _ = Command::new("ip")
            .args(["netns", "del", &self.name])
            .output();
    }
}
