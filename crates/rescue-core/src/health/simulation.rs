//! Nodes that are killed, stopped, cut off and started again at random, and ports that other programs get. No living
//! node may be unregistered, and no innocent one shut down.

use std::{
    collections::{BTreeMap, BTreeSet},
    net::IpAddr,
    time::Instant,
};

use super::{
    Death, Eviction, Evidence, LocalName, Moving, Owner, Process, Reach, Reap, Registrants,
    mutant::WrongRule, port_of,
};
use ros1_master::master::{Master, Method, Request};
use test_support::dice::Dice;

/// Few names, ports and process ids, so that all are reused often.
const NAMES: u64 = 6;
const PORTS: u64 = 7;
const PIDS: u64 = 24;
/// Events of one robot. With many robots, each seed can be repeated alone.
const EVENTS: usize = 500;

/// How the kernel of this computer sees a program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Setup {
    Plain,
    /// In a container with the host's network: the program sees another process id.
    OwnPids,
    /// In a container whose port another program forwards, which may be started again.
    Forwarded,
    /// On another computer, or in a container with a network of its own, under an address that means this computer here,
    /// such as `localhost`.
    OtherNetwork,
    /// The process belongs to another user.
    Hidden,
    /// On another computer, so that this kernel shows nothing of it.
    Elsewhere,
}

/// A program that listens at a port and may be a node.
#[derive(Clone, Debug)]
struct Program {
    setup: Setup,
    port: u64,
    process: Process,
    own_pid: i32,
    runs: bool,
    /// The program has closed its port. A child may hold a socket that the program had.
    closed: bool,
    names: BTreeSet<String>,
}

#[derive(Debug)]
struct Socket {
    port: u64,
    owner: Owner,
    hidden: bool,
    program: usize,
}

struct World {
    reap: Reap,
    dice: Dice,
    clock: u64,
    programs: Vec<Program>,
    /// The kernel's table, by inode.
    sockets: BTreeMap<u64, Socket>,
    running: BTreeSet<u32>,
    started: BTreeMap<u32, u64>,
    mirror: Master,
    registrations: u64,
    registered: BTreeMap<String, u64>,
    /// The process id that each name has answered, and its registration then.
    said: BTreeMap<String, (u64, i32)>,
    /// The program that registered each name last.
    holder: BTreeMap<String, usize>,
    /// Nodes, each with the process of another registered node that has listened at the same port.
    clashes: BTreeSet<(String, Process)>,
    known: Registrants,
    looking: bool,
    now: Instant,
    counts: Counts,
}

#[derive(Debug, Default)]
struct Counts {
    events: u64,
    reused_ports: u64,
    reaped: u64,
    /// Nodes that lost their port to another one, or whose port refused connections.
    evicted: u64,
    known: u64,
    prevented: u64,
    displaced: u64,
    unproved: u64,
}

impl World {
    fn new(seed: u64, reap: Reap) -> Self {
        Self {
            reap,
            dice: Dice(seed),
            clock: 0,
            programs: Vec::new(),
            sockets: BTreeMap::new(),
            running: BTreeSet::new(),
            started: BTreeMap::new(),
            mirror: Master::default(),
            registrations: 0,
            registered: BTreeMap::new(),
            said: BTreeMap::new(),
            holder: BTreeMap::new(),
            clashes: BTreeSet::new(),
            known: Registrants::default(),
            looking: false,
            now: Instant::now(),
            counts: Counts::default(),
        }
    }

    fn host(program: &Program) -> &'static str {
        match program.setup {
            Setup::Elsewhere => "far",
            _ => "here",
        }
    }

    fn api(program: &Program) -> String {
        format!("http://{}:{}/", Self::host(program), program.port)
    }

    /// The computer from which a program registers; `None` for this one.
    fn from(program: &Program) -> Option<IpAddr> {
        match program.setup {
            Setup::OtherNetwork => Some([10, 0, 0, 9].into()),
            Setup::Elsewhere => Some([10, 0, 0, 8].into()),
            _ => None,
        }
    }

    /// What the address of a registered name proves.
    fn reach(&self, name: &str) -> Reach {
        let from = self.mirror.registered_from(name);
        let api = self.mirror.api_of(name).unwrap_or_default();
        let at: IpAddr = match api.contains("here") {
            true => [127, 0, 0, 1].into(),
            false => [10, 0, 0, 8].into(),
        };
        Reach::classify(from, &[at], |address| address.is_loopback())
    }

    /// A random program that fits.
    fn random_program(&mut self, fits: impl Fn(&Program) -> bool) -> Option<usize> {
        let fitting = self.programs.iter().enumerate();
        let fitting: Vec<_> = fitting.filter(|(_, it)| fits(it)).map(|it| it.0).collect();
        match fitting.len() {
            0 => None,
            count => fitting.get(self.dice.below(count as u64) as usize).copied(),
        }
    }

    fn new_process(&mut self) -> Option<Process> {
        let pid = self.dice.below(PIDS) as u32;
        self.clock += 1;
        self.running.insert(pid).then(|| {
            self.started.insert(pid, self.clock);
            Process {
                pid,
                started: self.clock,
            }
        })
    }

    fn end_process(&mut self, process: Process) {
        if !self.has_ended(process) {
            self.running.remove(&process.pid);
        }
    }

    fn has_ended(&self, process: Process) -> bool {
        !self.running.contains(&process.pid)
            || self.started.get(&process.pid) != Some(&process.started)
    }

    /// The inodes of the sockets that listen at `port` of this computer.
    fn sockets_at(&self, port: u64) -> Vec<u64> {
        let sockets = self.sockets.iter();
        let here = sockets.filter(|(_, socket)| socket.port == port);
        here.map(|(inode, _)| *inode).collect()
    }

    fn listen(&mut self, index: usize, owner: Owner) {
        self.clock += 1;
        let program = &self.programs[index];
        let socket = Socket {
            port: program.port,
            owner,
            hidden: program.setup == Setup::Hidden,
            program: index,
        };
        self.sockets.insert(self.clock, socket);
    }

    fn start(&mut self) {
        let port = self.dice.below(PORTS);
        let setup = match self.dice.below(10) {
            0 => Setup::OwnPids,
            1 => Setup::Forwarded,
            2 => Setup::Hidden,
            3 => Setup::Elsewhere,
            4 => Setup::OtherNetwork,
            _ => Setup::Plain,
        };
        let is_free = match setup {
            Setup::OtherNetwork => true,
            Setup::Elsewhere => !self
                .programs
                .iter()
                .any(|it| it.runs && it.setup == setup && it.port == port),
            _ => self.sockets_at(port).is_empty(),
        };
        if !is_free {
            return;
        }
        let Some(process) = self.new_process() else {
            return;
        };
        let own_pid = match setup {
            Setup::OwnPids | Setup::Forwarded | Setup::OtherNetwork => {
                100 + self.dice.below(3) as i32
            }
            _ => process.pid as i32,
        };
        let index = self.programs.len();
        self.programs.push(Program {
            setup,
            port,
            process,
            own_pid,
            runs: true,
            closed: false,
            names: BTreeSet::new(),
        });
        let api = Self::api(&self.programs[index]);
        if self.mirror.nodes().any(|(_, held)| held == api) {
            self.counts.reused_ports += 1;
        }
        match setup {
            Setup::Elsewhere | Setup::OtherNetwork => {}
            Setup::Forwarded => self.forward(index),
            _ => self.listen(index, Owner { process, own_pid }),
        }
        if self.dice.below(4) > 0 {
            self.register(index);
        }
    }

    /// Starts a program that forwards a container's port.
    fn forward(&mut self, index: usize) {
        if let Some(process) = self.new_process() {
            let own_pid = process.pid as i32;
            self.listen(index, Owner { process, own_pid });
        }
    }

    /// A program registers a name, and rosrescue judges the call.
    fn register(&mut self, index: usize) {
        let name = format!("/n{}", self.dice.below(NAMES));
        let api = Self::api(&self.programs[index]);
        let from = Self::from(&self.programs[index]);
        let params = [name.as_str(), "/t", "x/Y", api.as_str()];
        let call = Request::new(Method::RegisterPublisher, params);
        let mut gone = BTreeSet::new();
        for moving in Moving::caused_by(&self.mirror, &call) {
            let evidence = self.evidence(&moving.node, &moving.from);
            if moving.is_unregistered_first(self.reap, evidence) {
                self.counts.prevented += u64::from(moving.hits_another(evidence));
                gone.insert(moving.node);
            } else {
                self.shut_down(&moving);
            }
        }
        if let Some(eviction) = Eviction::for_nodes(&self.mirror, gone) {
            self.mirror.apply(&eviction.call);
        }
        self.mirror.apply(&call);
        self.mirror.note_origin(&call, from);
        self.registrations += 1;
        self.registered.insert(name.clone(), self.registrations);
        self.clashes.retain(|(clashing, _)| *clashing != name);
        self.programs[index].names.insert(name.clone());
        if let Some(before) = self.holder.insert(name.clone(), index)
            && before != index
        {
            self.programs[before].names.remove(&name);
        }
        // rosrescue looks at once, before the kernel gives a port to another program.
        self.check_sockets(false);
    }

    /// The master tells what listens at the old address to shut down.
    fn shut_down(&mut self, moving: &Moving) {
        let was = self.holder.get(&moving.node).copied();
        let hit = self.listener(&moving.from);
        let Some(hit) = hit else { return };
        let program = &self.programs[hit];
        if was == Some(hit) {
            self.counts.displaced += 1;
            if self.dice.one_in(2) {
                self.kill(hit);
            }
            return;
        }
        // Nothing shows what listens on another computer, or behind a forwarded port, before it registers.
        let holder = was.map(|was| self.programs[was].setup);
        let is_hidden = |setup| matches!(setup, Setup::Elsewhere | Setup::Forwarded);
        let excused = program.names.is_empty() && holder.is_some_and(is_hidden);
        assert!(excused, "an innocent node is shut down: {moving:?}");
        self.counts.unproved += 1;
    }

    /// The program that a call to `api` reaches.
    fn listener(&self, api: &str) -> Option<usize> {
        let far = self.programs.iter().position(|it| {
            it.runs && it.setup == Setup::Elsewhere && port_of(&Self::api(it)) == port_of(api)
        });
        let mut sockets = self.sockets.values();
        let near = sockets
            .find(|socket| port_of(&Self::api(&self.programs[socket.program])) == port_of(api));
        let near = near.map(|socket| socket.program);
        near.filter(|it| self.programs[*it].runs).or(far)
    }

    fn kill(&mut self, index: usize) {
        let program = &mut self.programs[index];
        if !std::mem::take(&mut program.runs) {
            return;
        }
        let (process, setup) = (program.process, program.setup);
        self.end_process(process);
        // A forwarder goes on, and sometimes a child holds the socket for a while.
        if setup != Setup::Forwarded && !self.dice.one_in(8) {
            self.sockets.retain(|_, socket| socket.program != index);
        }
    }

    /// The next look finds a dead node, if the kernel has watched its process and nothing listens at its port.
    fn assert_known(&mut self, index: usize) {
        let program = &self.programs[index];
        let (api, process) = (Self::api(program), program.process);
        let is_open = !self.sockets_at(program.port).is_empty();
        let watched = |name: &&String| self.known.process(name, port_of(&api)) == Some(process);
        let dead: Vec<_> = program.names.iter().filter(watched).cloned().collect();
        if is_open || self.looking {
            return;
        }
        self.check_sockets(false);
        for name in dead {
            assert_ne!(self.mirror.api_of(&name), Some(api.as_str()), "{name}");
            self.counts.known += 1;
        }
    }

    /// Asks the node of a name for its process id.
    fn ask(&mut self, name: &str) {
        let Some(api) = self.mirror.api_of(name) else {
            return;
        };
        if !self.reach(name).answer_counts() {
            return;
        }
        if let Some(listener) = self.listener(api) {
            let said = (self.registered[name], self.programs[listener].own_pid);
            self.said.insert(name.to_owned(), said);
        } else if self.reap == Reap::All {
            self.refused(api.to_owned());
        }
    }

    /// The port of `api` refuses connections. Anything may happen until its nodes are unregistered.
    fn refused(&mut self, api: String) {
        let nodes = self.mirror.nodes().filter(|(_, at)| *at == api);
        let nodes = nodes.filter(|(name, _)| self.reach(name).answer_counts());
        let asked: Vec<_> = nodes
            .map(|(name, _)| (name.to_owned(), self.registered[name]))
            .collect();
        if !self.looking && self.dice.one_in(2) {
            self.event();
        }
        for (name, registered) in asked {
            if self.registered[&name] != registered || self.mirror.api_of(&name) != Some(&api) {
                continue;
            }
            let holder = &mut self.programs[self.holder[&name]];
            // A forwarder may be started again.
            let far = holder.setup == Setup::Forwarded;
            let lives = holder.runs && !holder.closed;
            assert!(
                !lives || far,
                "a living node is unregistered: {name} {holder:?}"
            );
            self.counts.unproved += u64::from(lives);
            holder.names.remove(&name);
            let calls = self.mirror.unregister_calls(&name);
            self.mirror.apply(&Request::multicall(calls));
            self.counts.evicted += 1;
        }
    }

    fn event(&mut self) {
        self.counts.events += 1;
        match self.dice.below(12) {
            0..=2 => self.start(),
            3 => {
                if let Some(index) = self.random_program(|it| it.runs && !it.closed) {
                    self.register(index);
                }
            }
            4 | 5 => {
                if let Some(index) = self.random_program(|it| it.runs) {
                    self.kill(index);
                    if self.dice.one_in(4) {
                        self.assert_known(index);
                    }
                }
            }
            // A node closes its port and runs on, or opens it again.
            6 => {
                if let Some(index) =
                    self.random_program(|it| it.runs && it.setup != Setup::Elsewhere)
                {
                    self.programs[index].closed = true;
                    self.sockets.retain(|_, socket| socket.program != index);
                }
            }
            // A forwarder is started again, and the node behind it lives.
            7 => {
                if let Some(index) =
                    self.random_program(|it| it.runs && it.setup == Setup::Forwarded)
                {
                    let mut owners = self.sockets.values();
                    let owner = owners.find(|socket| socket.program == index);
                    if let Some(owner) = owner.map(|socket| socket.owner) {
                        self.end_process(owner.process);
                    }
                    self.sockets.retain(|_, socket| socket.program != index);
                    if self.dice.one_in(2) && self.sockets_at(self.programs[index].port).is_empty()
                    {
                        self.forward(index);
                    }
                }
            }
            // Children end, and release the sockets that they have inherited.
            8 => {
                let programs = &self.programs;
                self.sockets.retain(|_, socket| {
                    let program = &programs[socket.program];
                    program.runs || program.setup == Setup::Forwarded
                });
            }
            _ => {
                let name = format!("/n{}", self.dice.below(NAMES));
                // A node that is stopped (SIGSTOP) or cut off does not answer.
                if !self.dice.one_in(3) {
                    self.ask(&name);
                }
            }
        }
    }

    /// Judges all nodes by their sockets. If `slow`, something else may happen between two steps of that, as between real
    /// reads of the kernel's tables.
    fn check_sockets(&mut self, slow: bool) {
        if std::mem::replace(&mut self.looking, true) {
            return;
        }
        let registrations = self.registrations;
        let mut event_at = match slow {
            true => self.dice.below(9),
            false => u64::MAX,
        };
        let names = self.mirror.nodes();
        let names = names.filter(|(name, _)| self.reach(name).answer_counts());
        let names: Vec<_> = names
            .map(|(name, api)| (name.to_owned(), api.to_owned()))
            .collect();
        let registered = self.registered.clone();
        let said = self.said.clone();
        if event_at == 0 {
            self.event();
        }
        event_at = event_at.wrapping_sub(1);
        let sockets = self.table(&names);
        for (name, api) in &names {
            let listener = self.listener(api).map(|it| &self.programs[it]);
            if let Some(it) = listener.filter(|it| !it.names.is_empty()) {
                self.clashes.insert((name.clone(), it.process));
            }
        }
        let ports: Vec<_> = names.iter().map(|(_, api)| port_of(api)).collect();
        let of = |index: usize| {
            let name = &names[index].0;
            LocalName {
                node: name,
                port: ports[index],
                registered: registered[name],
                answered_pid: said
                    .get(name)
                    .filter(|said| said.0 == registered[name])
                    .map(|said| said.1),
            }
        };
        let local: Vec<_> = (0..names.len()).map(of).collect();
        self.known
            .update(&local, |port| sockets.get(port).map(Vec::as_slice));
        if event_at == 0 {
            self.event();
        }
        event_at = event_at.wrapping_sub(1);
        for inode in self.known.unowned() {
            let owner = self.sockets.get(&inode);
            let owner = owner.filter(|it| !it.hidden).map(|it| it.owner);
            // The shell searches only running processes.
            let owner = owner.filter(|owner| !self.has_ended(owner.process));
            self.known.set_owner(inode, owner);
        }
        let mut dead = Vec::new();
        for (name, api) in &names {
            let port = port_of(api);
            let Some(sockets) = sockets.get(port) else {
                continue;
            };
            let (running, started) = (&self.running, &self.started);
            let ended = |process: Process| {
                !running.contains(&process.pid) || started[&process.pid] != process.started
            };
            let evidence = self.known.evidence(name, port, sockets, ended, self.now);
            if let Evidence::Ended(death) = evidence {
                dead.push((name.clone(), api.clone(), death));
            }
        }
        if event_at == 0 {
            self.event();
        }
        for (name, api, death) in dead {
            self.reap(&name, &api, death);
        }
        self.looking = false;
        if self.registrations > registrations {
            self.check_sockets(false);
        }
    }

    /// The sockets at each port of this computer that has names.
    fn table(&self, names: &[(String, String)]) -> BTreeMap<String, Vec<u64>> {
        let here = names.iter().filter(|(_, api)| api.contains("here"));
        let at = |api: &str| {
            let port = port_of(api).rsplit(':').next().unwrap();
            self.sockets_at(port.parse().unwrap())
        };
        here.map(|(_, api)| (port_of(api).to_owned(), at(api)))
            .collect()
    }

    fn evidence(&mut self, name: &str, api: &str) -> Evidence {
        let table = self.table(&[(name.to_owned(), api.to_owned())]);
        let Some(sockets) = table.get(port_of(api)) else {
            return Evidence::Unknown;
        };
        let elsewhere = Moving::evidence_elsewhere(self.reach(name), !sockets.is_empty());
        if let Some(evidence) = elsewhere {
            return evidence;
        }
        let (running, started) = (&self.running, &self.started);
        let ended = |process: Process| {
            !running.contains(&process.pid) || started[&process.pid] != process.started
        };
        self.known
            .evidence(name, port_of(api), sockets, ended, self.now)
    }

    fn reap(&mut self, name: &str, api: &str, death: Death) {
        let is_same = self.mirror.api_of(name) == Some(api);
        let is_other = |(other, at): (&str, &str)| other != name && at == api;
        let others = self.mirror.nodes().any(is_other);
        if !is_same || !death.is_certain(others) || self.registered[name] != death.registered {
            return;
        }
        let holder = &self.programs[self.holder[name]];
        // A program that never registers may listen at a port that is forwarded later.
        let clash = (name.to_owned(), death.process);
        let is_program = self.programs.iter().any(|it| it.process == death.process);
        let is_elsewhere = holder.setup == Setup::Forwarded && is_program;
        let excused = is_elsewhere && !self.clashes.contains(&clash);
        assert!(
            !holder.runs || excused,
            "a living node is unregistered: {name} {holder:?}"
        );
        self.counts.unproved += u64::from(holder.runs);
        let calls = self.mirror.unregister_calls(name);
        self.mirror.apply(&Request::multicall(calls));
        self.counts.reaped += 1;
    }
}

/// Plays one robot.
fn play(seed: u64, events: usize, reap: Reap) -> Counts {
    let mut world = World::new(seed, reap);
    for _ in 0..events {
        world.event();
        if world.dice.one_in(4) {
            world.check_sockets(true);
        }
    }
    world.counts
}

#[test]
fn no_living_node_is_unregistered_and_no_innocent_one_is_shut_down() {
    let seed = std::env::var("ROSRESCUE_SEED").ok();
    let first: u64 = seed.map_or(1, |seed| seed.parse().unwrap());
    let rounds = std::env::var("ROSRESCUE_ROUNDS").ok();
    let rounds: u64 = rounds.map_or(200, |rounds| rounds.parse().unwrap());
    for reap in [Reap::Local, Reap::All] {
        let mut sum = Counts::default();
        for seed in first..first + rounds {
            let played = std::panic::catch_unwind(|| play(seed, EVENTS, reap));
            let again = |_| panic!("{reap:?}: repeat it with ROSRESCUE_SEED={seed}");
            let counts = played.unwrap_or_else(again);
            sum.events += counts.events;
            sum.reused_ports += counts.reused_ports;
            sum.reaped += counts.reaped;
            sum.evicted += counts.evicted;
            sum.known += counts.known;
            sum.prevented += counts.prevented;
            sum.displaced += counts.displaced;
            sum.unproved += counts.unproved;
        }
        let last = first + rounds - 1;
        println!("{reap:?}, seeds {first} to {last}: {sum:?}");
        assert!(sum.events >= 500 * rounds);
        assert_eq!(sum.evicted > 0, reap == Reap::All);
        for count in [
            sum.reused_ports,
            sum.reaped,
            sum.known,
            sum.prevented,
            sum.displaced,
        ] {
            assert!(count >= rounds / 4, "{sum:?}");
        }
    }
}

#[test]
fn the_simulation_finds_each_wrong_rule() {
    for rule in [
        WrongRule::ClosedPortIsDeath,
        WrongRule::TrustsForwarders,
        WrongRule::SharedSocketProves,
        WrongRule::MovesUnjudged,
        WrongRule::OnlyNamesCount,
    ] {
        WrongRule::put(Some(rule));
        let found = (1..200)
            .find(|seed| std::panic::catch_unwind(|| play(*seed, EVENTS, Reap::Local)).is_err());
        WrongRule::put(None);
        println!("{rule:?} is found with seed {found:?}");
        assert!(found.is_some(), "{rule:?}");
    }
}
