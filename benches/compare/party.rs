//! The parties to compare, each with its own rosmaster, all started in the same way.

use std::{fmt, path::PathBuf, process::Command, sync::OnceLock};

use serde::{Serialize, Serializer};

use crate::{
    relays,
    shared::{
        cpu::family,
        second::SecondMaster,
        support::{Client, Process, Rescue, Scratch, Setup, eventually, free_port},
    },
};

/// The program of the earlier rosrescue, for [`Kind::CoreBefore`] and [`Kind::ProxyBefore`].
pub(crate) static BEFORE: OnceLock<PathBuf> = OnceLock::new();

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// A rosmaster without anything in front of it.
    Bare,
    /// `rosrescue core`.
    Core,
    /// `rosrescue proxy`.
    Proxy,
    Haproxy,
    Nginx,
    /// `rosrescue core` of an earlier version.
    CoreBefore,
    /// `rosrescue proxy` of an earlier version.
    ProxyBefore,
}

impl Kind {
    pub(crate) const ALL: [Self; 5] = [
        Self::Bare,
        Self::Core,
        Self::Proxy,
        Self::Haproxy,
        Self::Nginx,
    ];
    /// The parties that are compared by real clients.
    pub(crate) const OURS: [Self; 3] = [Self::Bare, Self::Core, Self::Proxy];
    /// The kinds that compare this version with an earlier one.
    pub(crate) const VERSIONS: [Self; 5] = [
        Self::Bare,
        Self::CoreBefore,
        Self::Core,
        Self::ProxyBefore,
        Self::Proxy,
    ];
}

impl Kind {
    /// Makes `setup` run the rosrescue of this kind.
    fn program(self, setup: Setup) -> Setup {
        if !matches!(self, Self::CoreBefore | Self::ProxyBefore) {
            return setup;
        }
        setup.wrapped(|own| {
            let mut command = Command::new(BEFORE.get().expect("--before"));
            command.args(own.get_args());
            for (key, value) in own.get_envs() {
                command.env(key, value.unwrap_or_default());
            }
            command
        })
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Bare => "bare rosmaster",
            Self::Core => "rosrescue core",
            Self::Proxy => "rosrescue proxy",
            Self::Haproxy => "HAProxy",
            Self::Nginx => "nginx",
            Self::CoreBefore => "core before",
            Self::ProxyBefore => "proxy before",
        })
    }
}

impl Serialize for Kind {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

#[derive(Debug)]
enum Before {
    Nothing,
    Rescue(Box<Rescue>),
    Relay(Process),
}

/// A rosmaster, and the program in front of it.
#[derive(Debug)]
pub(crate) struct Party {
    pub(crate) kind: Kind,
    /// A client of the port that nodes use.
    pub(crate) client: Client,
    pub(crate) master_pid: u32,
    // Fields are dropped in this order.
    before: Before,
    _master: Option<SecondMaster>,
    _scratch: Scratch,
}

impl Party {
    /// Starts a party that starts its own master.
    fn core(kind: Kind) -> Self {
        let scratch = Scratch::new();
        let setup = Setup::core(&scratch, free_port()).arg("--no-rosout");
        let rescue = kind.program(setup).guarded().start();
        let client = rescue.client();
        eventually("roscore's parameters are set", || {
            client.param("/rosdistro").is_some()
        });
        Self {
            kind,
            master_pid: client.master_pid().expect("the master's process id"),
            client,
            before: Before::Rescue(Box::new(rescue)),
            _master: None,
            _scratch: scratch,
        }
    }

    /// Starts a party whose master is started like the one with process id `like`.
    fn start(kind: Kind, like: u32) -> Self {
        let scratch = Scratch::new();
        let master_port = free_port();
        let mut command = SecondMaster::command(like, master_port, &scratch.log_dir());
        let master = SecondMaster::spawn(&mut command);
        let client = Client::new(master_port);
        eventually("the master answers", || client.master_pid().is_some());
        let master_pid = client
            .master_pid()
            .expect("the master does not report its process id");
        let (client, before) = match kind {
            Kind::Core | Kind::CoreBefore => panic!("`core` starts its own master"),
            Kind::Bare => (client, Before::Nothing),
            Kind::Proxy | Kind::ProxyBefore => {
                let setup = Setup::proxy(&scratch, master_port);
                let rescue = kind.program(setup).guarded().start();
                (rescue.client(), Before::Rescue(Box::new(rescue)))
            }
            Kind::Haproxy | Kind::Nginx => {
                let port = free_port();
                let relay = relays::start(kind, &scratch, port, master_port);
                (Client::new(port), Before::Relay(relay))
            }
        };
        eventually("calls pass", || client.master_pid() == Some(master_pid));
        // As roscore does, because roslaunch waits for it.
        client.set_param("/run_id", "3b1f2f3e-c77e-11f0-8b0e-000000000000");
        Self {
            kind,
            client,
            master_pid,
            before,
            _master: Some(master),
            _scratch: scratch,
        }
    }

    /// The processes between client and master.
    pub(crate) fn own(&self) -> Vec<u32> {
        match &self.before {
            Before::Nothing => Vec::new(),
            Before::Rescue(rescue) => family(rescue.pid()),
            Before::Relay(relay) => family(relay.pid()),
        }
    }
}

/// Starts one party of each of `kinds`, in that order. `core` must be one of them.
pub(crate) fn start(kinds: &[Kind]) -> Vec<Party> {
    let core = Party::core(Kind::Core);
    let like = core.master_pid;
    let mut core = Some(core);
    let of = |kind: &Kind| match kind {
        Kind::Core => core.take().expect("one `core`"),
        Kind::CoreBefore => Party::core(*kind),
        kind => Party::start(*kind, like),
    };
    kinds.iter().map(of).collect()
}
