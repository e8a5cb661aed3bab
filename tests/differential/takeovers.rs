//! Compares the model, which never crashes, with several rosrescues on one etcd. Their leader is killed with all its
//! processes, or hands over.
//!
//! Each client calls its own computer, or another one while its own is dead. So calls reach the leader and its
//! followers.

use std::net::{Ipv4Addr, TcpListener};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use ros1_master::{
    master::{Kind, Master, Method, Request},
    xmlrpc::{Call, Reply, Value},
};
use rustix::process::Signal;
use serde_json::Value as Json;

use crate::NO_HANGS;
use crate::crashes::{self, Share, has_params, read_state, skipped};
use crate::dice::Dice;
use crate::nodes::{Node, patience};
use crate::real::{Wire, lost_callback};
use crate::script::{Script, Step};
use crate::stage::{CLIENTS, Failure, Stage, alike, excuse, undisturbed};
use crate::support::{
    Client, Rescue, Scratch, Servers, Setup, eventually, free_port, signal, try_status,
};

/// The time to live, in seconds. With a shorter one, a busy computer would lose the lead before etcd answers.
const TTL: &str = "1.5";
/// Maximum time from sending a call to the end of its leader, in microseconds. The call may have got to any point by
/// then.
const IN_FLIGHT_MICROS: u64 = 10_000;

/// A random sequence with this many takeovers.
pub(crate) fn script(seed: u64, calls: usize, takeovers: usize, nodes: usize) -> Script {
    let mut script = crashes::script(seed, calls, takeovers, nodes);
    let mut dice = Dice(!seed);
    for step in &mut script.steps {
        if let Step::Crash { in_flight } = *step
            && dice.once_in(2)
        {
            *step = Step::Handover { in_flight };
        }
    }
    script
}

/// The way in which a computer stops leading.
#[derive(Clone, Copy, Debug, PartialEq)]
enum End {
    /// The computer dies and is switched on again at once.
    Restart,
    /// The computer dies and stays dead.
    Death,
    Handover,
}

/// One computer: the processes that are killed together.
struct Computer {
    rescue: Rescue,
    uri: String,
    master_port: u16,
    /// How often the computer was started. `None` while it is dead.
    life: Option<u32>,
    lives: u32,
    scratch: Scratch,
}

impl Computer {
    fn start(index: usize, cluster: &str) -> Self {
        let scratch = Scratch::new();
        let master_port = free_port();
        let rescue = Setup::core(&scratch, master_port)
            .args(["--cluster", cluster, "--cluster-ttl", TTL])
            .args(["--cluster-name", &format!("pc{index}")])
            // A busy computer that is cut off for a moment must not answer writes by itself, because writes of other
            // computers would win over them. With a single master no write is lost.
            .args(["--alone", "refuse", "--hold", "60"])
            // Each computer would otherwise have its own rosout node.
            .arg("--no-rosout")
            .args(NO_HANGS)
            .guarded()
            .spawn();
        Self {
            uri: String::new(),
            rescue,
            master_port,
            life: Some(1),
            lives: 1,
            scratch,
        }
    }

    /// Kills rosrescue, its guardian, and its rosmaster with SIGKILL.
    fn kill(&mut self) {
        self.life = None;
        loop {
            let all = self.scratch.survivors();
            if all.is_empty() {
                break self.rescue.kill();
            }
            all.iter().for_each(|(pid, _)| signal(*pid, Signal::KILL));
            let _ = self.rescue.exited();
        }
        // A killed process loses its environment before its sockets are closed.
        let port = self.rescue.port();
        eventually("no process listens at the computer's port", || {
            TcpListener::bind((Ipv4Addr::UNSPECIFIED, port)).is_ok()
        });
    }

    fn revive(&mut self) {
        if self.life.is_none() {
            self.rescue.start_again();
            self.lives += 1;
            self.life = Some(self.lives);
        }
    }

    /// The content of `/status.json`. `None` if rosrescue does not answer.
    fn status(&self) -> Option<Json> {
        self.life?;
        try_status(&self.rescue.client())
    }

    fn wire(&self) -> Option<Wire> {
        self.life?;
        Wire::connect(self.rescue.port()).ok()
    }
}

struct Rig {
    computers: Vec<Computer>,
    /// The computer of each client, and the number of its starts at the time of the connection.
    at: [(usize, u32); CLIENTS],
    /// The one of these through which the last write was made.
    wrote: (usize, u32),
}

impl Rig {
    fn start(servers: &Servers, count: usize) -> Self {
        static ROBOTS: AtomicU32 = AtomicU32::new(0);
        let robot = ROBOTS.fetch_add(1, Ordering::Relaxed);
        let cluster = format!("{}/robot{robot}", servers.endpoints(0).join(","));
        let mut computers = Vec::new();
        for index in 0..count {
            computers.push(Computer::start(index, &cluster));
        }
        Self {
            computers,
            at: [(0, 0); CLIENTS],
            wrote: (0, 0),
        }
    }

    /// The state from which the sequence starts: three parameters.
    fn state(&mut self) -> Result<Master, Failure> {
        self.await_all()?;
        for computer in &mut self.computers {
            (_, computer.uri) = computer.wire().unwrap().identity();
        }
        let mut wire = self.computers[0].wire().unwrap();
        Ok(read_state(&mut wire, has_params))
    }

    /// Connects clients of dead computers to other computers, and clients of computers that are back to these.
    fn attach(&mut self, stage: &mut Stage<'_>) -> Result<(), Failure> {
        (0..CLIENTS).try_for_each(|client| self.attach_one(stage, client, None))
    }

    fn attach_one(
        &mut self,
        stage: &mut Stage<'_>,
        client: usize,
        but: Option<usize>,
    ) -> Result<(), Failure> {
        let count = self.computers.len();
        await_some("a computer that listens", || {
            let mut turn = (0..count).map(|step| (client + step) % count);
            turn.find_map(|index| {
                let computer = &self.computers[index];
                let place = (index, computer.life?);
                if but == Some(index) {
                    return None;
                }
                if self.at[client] != place {
                    stage.wires[client] = computer.wire()?;
                    self.at[client] = place;
                }
                Some(())
            })
        })
    }

    /// The leader and its status.
    fn leader(&self) -> Option<(usize, Json)> {
        let mut all = self.computers.iter().enumerate();
        all.find_map(|(index, computer)| {
            let status = computer.status()?;
            (status["cluster"]["role"] == "leading").then_some((index, status))
        })
    }

    /// Lets `stage` look at the leader's master, or see that no computer leads. Returns the leader.
    fn look(&self, stage: &mut Stage<'_>) -> Option<usize> {
        let Some((leader, status)) = self.leader() else {
            stage.look(&Json::Null, false);
            return None;
        };
        stage.look(&status, status["open"] == true);
        Some(leader)
    }

    /// Compares all callbacks so far.
    fn settle(&mut self, stage: &mut Stage<'_>) -> Result<(), Failure> {
        stage.settle()?;
        self.wrote = self.at[0];
        Ok(())
    }

    fn await_leader(&self) -> Result<usize, Failure> {
        await_some("a leader", || self.leader().map(|(index, _)| index))
    }

    /// Waits for a leader, with all computers switched on.
    fn await_leader_and_another(&mut self) -> Result<usize, Failure> {
        let leader = self.await_leader()?;
        self.computers.iter_mut().for_each(Computer::revive);
        Ok(leader)
    }

    fn await_open(&self) -> Result<usize, Failure> {
        await_some("a leader with a master", || {
            let (leader, status) = self.leader()?;
            (status["open"] == true).then_some(leader)
        })
    }

    /// Waits until one computer leads and all others have its whole state.
    fn await_all(&mut self) -> Result<usize, Failure> {
        self.computers.iter_mut().for_each(Computer::revive);
        let leader = self.await_open()?;
        for (index, computer) in self.computers.iter().enumerate() {
            await_some(&format!("computer {index}, which follows"), || {
                let cluster = computer.status()?["cluster"].clone();
                let follows = cluster["role"] == "following" && cluster["behind"] == 0;
                (index == leader || follows).then_some(())
            })?;
        }
        Ok(leader)
    }

    /// Ends the leadership of the present leader. If there was no leader, the same computer may lead again.
    fn end(&mut self, end: End) -> Result<(), Failure> {
        if end == End::Handover {
            return self.hand_over();
        }
        let leader = self.await_leader_and_another()?;
        self.computers[leader].kill();
        if end == End::Restart {
            self.computers[leader].revive();
        }
        Ok(())
    }

    /// Asks any computer for a handover; it need not be the leader.
    fn hand_over(&self) -> Result<(), Failure> {
        let leader = self.await_leader()?;
        let others = (0..self.computers.len()).rev();
        let mut asked = others.filter(|index| self.computers[*index].wire().is_some());
        let asked = &self.computers[asked.next().unwrap_or(leader)];
        let call = Call::new("rosrescue/handover", vec!["/test".into(), "".into()]);
        await_some("a handover", || {
            let reply = asked.wire()?.call(&call).ok()?;
            match &reply {
                Reply::Value(Value::Array(answer)) if answer.first() == Some(&1.into()) => Some(()),
                // The other computer has not reported yet, or the next leader does not lead yet.
                _ => None,
            }
        })
    }
}

/// Whether the next leader has the same state. It lacks values that a master cannot return, and sets roscore's three
/// parameters if they were deleted.
fn survives(model: &Master) -> bool {
    skipped(model).is_empty() && has_params(model)
}

fn await_some<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> Result<T, Failure> {
    let deadline = Instant::now() + patience();
    loop {
        if let Some(found) = look() {
            return Ok(found);
        }
        if Instant::now() > deadline {
            return Err(format!("there is never {what}"));
        }
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// The totals of a run.
#[derive(Debug, Default)]
pub(crate) struct Tally {
    pub(crate) deaths: Share,
    pub(crate) handovers: Share,
}

/// Plays a sequence through `count` computers.
pub(crate) fn run(
    script: &Script,
    nodes: &[Node],
    servers: &Servers,
    count: usize,
    tally: &mut Tally,
) -> Result<(), Failure> {
    undisturbed(|| {
        let mut rig = Rig::start(servers, count);
        let model = match rig.state() {
            Ok(model) => model,
            Err(why) => return (Err(why), None),
        };
        let wires = (0..CLIENTS).map(|_| rig.computers[0].wire().unwrap());
        let mut stage = Stage::new(nodes, wires.collect(), model);
        stage.allow_repeats();
        stage.callbacks = !script.unreturnable;
        let result = steps(script, &mut rig, &mut stage, tally);
        if result.is_ok() {
            return (result, None);
        }
        rig.look(&mut stage);
        if !crate::nodes::HURRIED.get() {
            for computer in &rig.computers {
                eprintln!("{}", computer.rescue.log());
            }
        }
        let mut computers = rig.computers.iter();
        let lost = || computers.find_map(|computer| lost_callback(&computer.scratch));
        let disturbance = stage.disturbance.or_else(lost);
        // A state that does not survive is lost with its master.
        let excuse = match survives(&stage.model) {
            true => excuse(&result, disturbance),
            false => disturbance,
        };
        (result, excuse)
    })
}

fn steps(
    script: &Script,
    rig: &mut Rig,
    stage: &mut Stage<'_>,
    tally: &mut Tally,
) -> Result<(), Failure> {
    let mut next_end = None;
    for (nth, step) in script.steps.iter().enumerate() {
        let (end, in_flight) = match step {
            Step::Call { by, call } => {
                play(rig, stage, by % CLIENTS, call, next_end.take(), nth)
                    .map_err(|why| format!("step {nth}, {step:?}: {why}"))?;
                continue;
            }
            Step::Crash { in_flight } => (End::Restart, *in_flight),
            Step::Handover { in_flight } => (End::Handover, *in_flight),
            Step::Away => (End::Death, false),
            Step::Back => {
                rig.computers.iter_mut().for_each(Computer::revive);
                continue;
            }
            Step::Successor(_) => continue,
        };
        let share = match end {
            End::Handover => &mut tally.handovers,
            End::Restart | End::Death => &mut tally.deaths,
        };
        share.asked += 1;
        let mut after = stage.model.clone();
        if let (true, Some(Step::Call { call, .. })) = (in_flight, script.steps.get(nth + 1)) {
            after.apply(&stage.real(call).into());
        }
        if next_end.is_some() || ![&stage.model, &after].into_iter().all(survives) {
            continue;
        }
        share.happened += 1;
        let ended = rig.attach(stage).and_then(|()| {
            match step {
                // The last callbacks may be lost with the leader, and are replaced later.
                Step::Crash { .. } => stage.risk(),
                _ => rig.settle(stage)?,
            }
            let repeats = stage.repeats.get_or_insert_default();
            match step {
                Step::Crash { .. } => repeats.crash_unjudged(&stage.model),
                _ => repeats.crash(&stage.model),
            }
            stage.away = true;
            next_end = in_flight.then_some(end);
            if in_flight { Ok(()) } else { rig.end(end) }
        });
        ended.map_err(|why| format!("step {nth}, {step:?}: {why}"))?;
    }
    let end = finish(rig, stage);
    end.map_err(|why| format!("at the end: {why}"))
}

/// Makes a call. With `end`, the leader ends while the call is running.
fn play(
    rig: &mut Rig,
    stage: &mut Stage<'_>,
    by: usize,
    call: &Call,
    end: Option<End>,
    nth: usize,
) -> Result<(), Failure> {
    let call = stage.real(call);
    let leader = rig.look(stage);
    let request = Request::from(call.clone());
    let mut after = stage.model.clone();
    after.apply(&request);
    if stage.away && !survives(&after) {
        // Only a running master can return what a successor could not get.
        rig.await_open()?;
    }
    rig.attach(stage)?;
    if let Some(End::Restart | End::Death) = end {
        // A call to a computer that dies gets no answer.
        let leader = rig.await_leader_and_another()?;
        rig.attach_one(stage, by, Some(leader))?;
    }
    let (index, _) = rig.at[by];
    stage
        .model
        .set_identity(1, rig.computers[index].uri.clone());
    stage.wires[by].send(&call)?;
    if let Some(end) = end {
        let micros = Dice(nth as u64).next() % IN_FLIGHT_MICROS;
        std::thread::sleep(Duration::from_micros(micros));
        stage.away = true;
        rig.end(end)?;
    }
    let mut reply = stage.wires[by].receive()?;
    // If the leader is late, or no computer leads, the mirror of this computer answers these.
    let subscribes = *request.method() == Method::SubscribeParam;
    if request.kind() == Kind::Read || subscribes && !stage.model.would_change(&request) {
        // Another computer may see a write some milliseconds later. The leader and the one that made it see it.
        if rig.at[by] != rig.wrote && leader != Some(index) {
            reply = latest(&stage.model, &mut stage.wires[by], &call, reply)?;
        }
    } else if request.kind().mutates() {
        rig.wrote = rig.at[by];
    }
    stage.answered(&call, &reply, end.is_some())?;
    if let (Some(_), Some(repeats)) = (end, &mut stage.repeats) {
        repeats.ran_again();
    }
    Ok(())
}

/// Repeats a call that changes nothing until its reply is the model's.
fn latest(
    model: &Master,
    wire: &mut Wire,
    call: &Call,
    mut reply: Reply,
) -> Result<Reply, Failure> {
    let expected = model.clone().apply(&call.clone().into()).reply;
    let deadline = Instant::now() + patience();
    while !alike(&expected, &reply) && Instant::now() < deadline {
        std::thread::sleep(Duration::from_millis(2));
        reply = wire.call(call)?;
    }
    Ok(reply)
}

/// Compares the state at each computer, and again after the leader's death, when it comes from the journal.
fn finish(rig: &mut Rig, stage: &mut Stage<'_>) -> Result<(), Failure> {
    let leader = rig.await_all()?;
    rig.look(stage);
    rig.attach(stage)?;
    rig.settle(stage)?;
    for (index, computer) in rig.computers.iter().enumerate() {
        let status = computer.status().ok_or("no status")?;
        let counters = [
            &status["counters"]["divergences"],
            &status["cluster"]["lost_writes"],
        ];
        if counters.iter().any(|counter| **counter != 0) {
            return Err(format!(
                "divergences and lost writes of computer {index}: {counters:?}"
            ));
        }
        let mut wire = computer.wire().ok_or("it is not listening")?;
        // This shows each write of the comparison above. Later reads at this computer never go back.
        let read = Call::new("getSystemState", vec!["/test".into()]);
        let reply = wire.call(&read)?;
        latest(&stage.model, &mut wire, &read, reply)?;
        stage
            .same_reads(&mut wire)
            .map_err(|why| format!("computer {index}: {why}"))?;
    }
    let behind = Client::new(rig.computers[leader].master_port);
    let mut behind = Wire::connect(behind.port()).map_err(|error| error.to_string())?;
    stage
        .same_reads(&mut behind)
        .map_err(|why| format!("the master behind: {why}"))?;
    if !survives(&stage.model) {
        return Ok(());
    }
    stage.away = true;
    rig.end(End::Death)?;
    rig.attach(stage)?;
    let (index, _) = rig.at[0];
    let mut wire = rig.computers[index].wire().ok_or("it is not listening")?;
    stage
        .same_reads(&mut wire)
        .map_err(|why| format!("after the last leader's death: {why}"))
}
