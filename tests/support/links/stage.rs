//! The masters at which the nodes start.

use std::fs;
use std::thread::sleep;
use std::time::Duration;

use rustix::process::Signal;

use super::super::patience::{eventually, eventually_some};
use super::super::process::signal;
use super::super::rescue::{Rescue, Setup};
use super::super::robot::{Mode, Robot};
use super::super::ros::Rosmaster;
use super::super::rpc::Client;
use super::super::scratch::{Scratch, free_port};
use super::super::servers::Servers;
use super::Dice;

/// Which master the nodes use.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Place {
    /// A rosmaster without rosrescue.
    Bare,
    /// `rosrescue core`.
    Core,
    /// `rosrescue proxy`.
    Proxy,
    /// `rosrescue proxy` whose master is dead while the nodes start, so that the mirror stands in.
    StandingIn,
    /// `rosrescue core` whose master and worker are killed while the nodes start.
    Kills,
    /// The follower of two computers that run `rosrescue core --cluster`.
    Follower,
}

/// A running master. The fields are in the order in which they must be dropped.
#[derive(Debug)]
pub(crate) enum Stage {
    Bare(Rosmaster, Scratch),
    Robot(Box<Robot>, Place),
    Kills(Box<Rescue>, u16, Scratch),
    Follower(Vec<Rescue>, usize, Servers),
}

impl Stage {
    #[track_caller]
    pub(super) fn start(place: Place) -> Self {
        match place {
            Place::Bare => {
                let scratch = Scratch::new();
                Self::Bare(Rosmaster::start(&scratch), scratch)
            }
            Place::Core => {
                let robot = Robot::start_with(Mode::Core, &["--no-rosout"]);
                Self::Robot(Box::new(robot), place)
            }
            Place::Proxy | Place::StandingIn => {
                Self::Robot(Box::new(Robot::start(Mode::Proxy)), place)
            }
            Place::Kills => {
                let (scratch, master_port) = (Scratch::new(), free_port());
                let setup = Setup::core(&scratch, master_port).arg("--no-rosout");
                Self::Kills(Box::new(setup.guarded().start()), master_port, scratch)
            }
            Place::Follower => Self::follower(),
        }
    }

    #[track_caller]
    fn follower() -> Self {
        let mut runtime = tokio::runtime::Builder::new_current_thread();
        let runtime = runtime.enable_all().build().unwrap();
        let servers = runtime.block_on(Servers::new(1));
        let cluster = format!("{}/robot", servers.endpoints(0).join(","));
        let start = |index: usize| {
            let setup = Setup::core(&servers.scratch, free_port());
            setup
                .args(["--cluster", &cluster, "--no-rosout"])
                // On a busy computer etcd is late, and the master would be killed again and again.
                .args(["--cluster-ttl", "60"])
                .args(["--cluster-name", &format!("pc{index}")])
                .at_checkpoint(servers.scratch.path(format!("pc{index}.yaml")))
                .spawn()
        };
        let computers: Vec<_> = (0..2).map(start).collect();
        let role = |computer: &Rescue| {
            let get = b"GET /status.json HTTP/1.1\r\nHost: localhost\r\n\r\n";
            let page = computer.client().exchange(get).ok()?;
            let status: serde_json::Value = serde_json::from_slice(&page.body).ok()?;
            let cluster = &status["cluster"];
            let follows = cluster["role"] == "following" && cluster["behind"] == 0;
            let leads = cluster["role"] == "leading" && status["open"] == true;
            (follows || leads).then_some(follows)
        };
        let follower = eventually_some("one leads and the other follows", || {
            let roles: Vec<_> = computers.iter().map(role).collect();
            let other = roles.contains(&Some(false));
            roles
                .iter()
                .position(|role| *role == Some(true))
                .filter(|_| other)
        });
        Self::Follower(computers, follower, servers)
    }

    pub(super) fn scratch(&self) -> &Scratch {
        match self {
            Self::Bare(_, scratch) | Self::Kills(_, _, scratch) => scratch,
            Self::Robot(robot, _) => &robot.scratch,
            Self::Follower(_, _, servers) => &servers.scratch,
        }
    }

    /// The output of each rosrescue.
    pub(super) fn log(&self) -> String {
        match self {
            Self::Bare(..) => String::new(),
            Self::Robot(robot, _) => robot.rescue.log(),
            Self::Kills(rescue, ..) => rescue.log(),
            Self::Follower(computers, ..) => computers.iter().map(|it| it.log()).collect(),
        }
    }

    /// The port that nodes use.
    pub(super) fn port(&self) -> u16 {
        match self {
            Self::Bare(master, _) => master.port,
            Self::Robot(robot, _) => robot.port(),
            Self::Kills(rescue, ..) => rescue.port(),
            Self::Follower(computers, follower, _) => computers[*follower].port(),
        }
    }

    pub(super) fn client(&self) -> Client {
        Client::new(self.port())
    }

    /// Prepares the master before the nodes begin.
    #[track_caller]
    pub(super) fn set(&mut self) {
        if let Self::Robot(robot, Place::StandingIn) = self {
            robot.take_master_away();
        }
    }

    /// Disturbs the master while the nodes start.
    pub(super) fn disturb(&self, dice: &mut Dice) {
        let Self::Kills(rescue, master_port, _) = self else {
            return;
        };
        for _ in 0..=dice.below(3) {
            sleep(Duration::from_millis(50 + dice.below(600)));
            let victim = match dice.below(2) {
                0 => worker_of(rescue.pid()),
                _ => Client::new(*master_port).master_pid(),
            };
            if let Some(pid) = victim {
                signal(pid, Signal::KILL);
            }
        }
        eventually("calls pass again", || {
            let client = self.client();
            client.master_pid().is_some()
        });
    }
}

/// The child of `guardian` that runs the same program.
fn worker_of(guardian: u32) -> Option<u32> {
    let program = |pid: u32| fs::read_link(format!("/proc/{pid}/exe")).ok();
    let children = fs::read_to_string(format!("/proc/{guardian}/task/{guardian}/children")).ok()?;
    let mut children = children
        .split_whitespace()
        .filter_map(|pid| pid.parse().ok());
    children.find(|pid| program(*pid).is_some() && program(*pid) == program(guardian))
}
