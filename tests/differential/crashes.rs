//! Compares the model, which never crashes, with rosrescue in front of a rosmaster that crashes.

use std::time::{Duration, Instant};

use checkpoint_store::change_log;
use rescue_core::{
    checkpoint::{change_log::moment, compare::compare},
    replay::{Inspection, Plan, Skipped, Token},
};
use ros1_master::{
    master::{Kind, Master, Request},
    xmlrpc::{Call, encode_call},
};
use rosrescue::clock;
use rustix::process::Signal;
use serde_json::Value as Json;

use crate::NO_HANGS;
use crate::dice::{Cast, Dice};
use crate::nodes::{Node, patience};
use crate::real::{Rosmaster, Wire, lost_callback};
use crate::script::{Script, Step, node_api};
use crate::stage::{CLIENTS, Failure, Stage, excuse, undisturbed};
use crate::support::{
    Client, Rescue, Scratch, Setup, free_port, http_request, signal, status, try_status, unordered,
};

/// A random sequence with this many crashes.
pub(crate) fn script(seed: u64, calls: usize, crashes: usize, nodes: usize) -> Script {
    let mut dice = Dice(seed);
    let mut cast = Cast {
        apis: (0..nodes).map(node_api).collect(),
        // A successor cannot get a value that no master can return. While there is such a value, no crash happens.
        // Before and after it, crashes do happen.
        unreturnable: dice.once_in(4),
        errors: !dice.once_in(4),
        // Each master has a different process id.
        process: false,
    };
    cast.apis.push("rosrpc://h:1".to_owned());
    let mut steps: Vec<_> = (0..calls)
        .map(|_| Step::Call {
            by: dice.below(CLIENTS),
            call: dice.call(&cast, 2),
        })
        .collect();
    for _ in 0..crashes {
        let at = dice.below(steps.len() + 1);
        if dice.once_in(3) {
            let end = (at + 1 + dice.below(calls / 4 + 1)).min(steps.len());
            steps.insert(end, Step::Back);
            steps.insert(at, Step::Away);
        } else {
            let in_flight = dice.once_in(2);
            steps.insert(at, Step::Crash { in_flight });
        }
    }
    let unreturnable = cast.unreturnable;
    Script {
        unreturnable,
        steps,
    }
}

/// rosrescue and the master behind it.
struct Rig {
    /// Whether rosrescue runs the master.
    supervised: bool,
    master: Option<Rosmaster>,
    master_port: u16,
    /// Process id of the master that was killed.
    killed: i32,
    rescue: Rescue,
    scratch: Scratch,
}

impl Rig {
    /// Starts rosrescue. With `core`, it runs the master and rosout itself. `reads` says whether the master or the
    /// mirror answers reads.
    fn start(core: bool, reads: &str) -> Self {
        let scratch = Scratch::new();
        let master_port = free_port();
        let (setup, master) = match core {
            true => (Setup::core(&scratch, master_port), None),
            false => {
                let mut master = Rosmaster::start_at(master_port);
                drop(master.ready());
                (Setup::proxy(&scratch, master_port), Some(master))
            }
        };
        // Calls that only a master can answer wait long enough for a busy computer.
        let setup = setup.args(["--hold", "60", "--reads", reads]);
        let rescue = setup.args(NO_HANGS).start();
        Self {
            supervised: core,
            master,
            master_port,
            killed: 0,
            rescue,
            scratch,
        }
    }

    fn wire(&self) -> Wire {
        Wire::connect(self.rescue.port()).expect("rosrescue listens all the time")
    }

    /// The state from which the sequence starts. A core's state contains rosout and three parameters.
    fn state(&self) -> Master {
        read_state(&mut self.wire(), |model| {
            !self.supervised || is_complete(model)
        })
    }

    /// Whether rosrescue answers a read with the same bytes as the master behind it.
    fn same_bytes(&self, read: &Call, parsed: &Request) -> Result<(), Failure> {
        let mut calls = parsed.calls().into_iter();
        if calls.any(|call| call.kind() == Kind::Identity) {
            // The address is that of rosrescue.
            return Ok(());
        }
        let request = http_request(&encode_call(read));
        let deadline = Instant::now() + patience();
        for look in 0.. {
            let [ours, theirs] = [self.rescue.port(), self.master_port].map(|port| {
                let response = Client::new(port).exchange(&request);
                response.map(|response| response.text())
            });
            match (ours, theirs) {
                (Ok(ours), Ok(theirs)) if ours == theirs => return Ok(()),
                // On a busy computer the mirror answers for a late master, in other words if it refuses, and in another
                // order if the master's dictionaries are unordered.
                (Ok(_), Ok(_)) if look == 0 || unordered() && Instant::now() < deadline => {}
                (ours, theirs) => return Err(format!("{ours:?}\ninstead of\n{theirs:?}")),
            }
        }
        unreachable!("the loop ends with a result")
    }

    /// Kills the master with SIGKILL, and starts the next one.
    fn crash(&mut self) -> Result<(), Failure> {
        self.kill()?;
        self.revive();
        Ok(())
    }

    /// Kills the master with SIGKILL. A core starts the next one by itself.
    fn kill(&mut self) -> Result<(), Failure> {
        let deadline = Instant::now() + patience();
        let mut wire = self.wire();
        loop {
            let (pid, _) = wire.identity();
            if pid != self.killed {
                self.killed = pid;
                match &mut self.master {
                    Some(master) => master.kill(),
                    None => signal(u32::try_from(pid).unwrap(), Signal::KILL),
                }
                self.master = None;
                return Ok(());
            }
            if Instant::now() > deadline {
                return Err("there is no other master".to_owned());
            }
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    fn revive(&mut self) {
        if !self.supervised && self.master.is_none() {
            self.master = Some(Rosmaster::start_at(self.master_port));
        }
    }

    /// Whether calls pass to a living master, according to this status.
    fn is_open(&self, status: &Json) -> bool {
        status["open"] == true && status["last_recovery"]["master_pid"] != self.killed
    }

    /// Lets `stage` look at the master, if rosrescue lives.
    fn look(&self, stage: &mut Stage<'_>) {
        if let Some(status) = try_status(&self.rescue.client()) {
            stage.look(&status, self.is_open(&status));
        }
    }

    /// Whether the log has the state of each instant.
    fn had_states(&self, instants: &[(u64, Master)]) -> Result<(), Failure> {
        let name = format!("latest-chkpt-{}.yaml", self.rescue.port());
        let path = self.scratch.log_dir().join(name);
        let files = change_log::files(&path).map_err(|error| error.to_string())?;
        let texts: Vec<_> = files.iter().filter_map(|file| file.read().ok()).collect();
        let nothing_hidden = "".parse()?;
        for (time, expected) in instants {
            let found = texts
                .iter()
                .rev()
                .find_map(|text| moment(text, *time).ok()?);
            let found = found.ok_or_else(|| format!("there is no state of {time}"))?;
            let differences = compare(expected, &found.rebuilt.mirror, &nothing_hidden);
            if !differences.is_empty() {
                let seq = found.seq;
                return Err(format!("at {time}, after record {seq}: {differences:?}"));
            }
        }
        Ok(())
    }

    /// Waits until calls pass to a master, or until they no longer do.
    fn await_gate(&self, open: bool) -> Result<(), Failure> {
        let deadline = Instant::now() + patience();
        while self.is_open(&status(&self.rescue.client())) != open {
            if Instant::now() > deadline {
                return Err(format!("the gate never becomes open: {open}"));
            }
            std::thread::sleep(Duration::from_millis(2));
        }
        Ok(())
    }
}

/// One instant is checked for about this many steps.
const INSTANT_EACH: usize = 4;

/// The present time and state. Waits for the next millisecond, so that no later call has the same time.
fn instant(model: &Master) -> (u64, Master) {
    let now = clock::wall_millis();
    while clock::wall_millis() == now {
        std::thread::yield_now();
    }
    (now, model.clone())
}

/// The state at the other end once it is `complete`.
pub(crate) fn read_state(wire: &mut Wire, complete: impl Fn(&Master) -> bool) -> Master {
    let deadline = Instant::now() + Duration::from_secs(60);
    let mut model = Master::default();
    while !complete(&model) {
        assert!(Instant::now() < deadline, "core is never complete");
        let token = Token::new("none", 1);
        let look = wire.ask(&Inspection::call(&token)).unwrap();
        let look = Inspection::decode(&look, &token).unwrap();
        let nothing = Master::default();
        let second = look
            .second_call(&nothing)
            .map(|call| wire.ask(&call).unwrap());
        // The next read sees a rosout that registers between the two requests.
        model = look
            .into_master(second.as_ref(), &nothing)
            .unwrap_or_default();
        std::thread::sleep(Duration::from_millis(5));
    }
    wire.identify(&mut model);
    model
}

/// Whether core has set the parameters that roscore sets.
pub(crate) fn has_params(model: &Master) -> bool {
    let keys = ["run_id", "rosversion", "rosdistro"];
    keys.iter().all(|key| model.params().contains_key(*key))
}

/// Whether core has done everything that roscore does.
fn is_complete(model: &Master) -> bool {
    has_params(model)
        && model.counts().services == 2
        && !model.publishers_of("/rosout_agg").is_empty()
        && !model.subscribers_of("/rosout").is_empty()
}

/// How many cases happened, of those that were requested.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Share {
    pub(crate) happened: usize,
    pub(crate) asked: usize,
}

/// The totals of a run.
#[derive(Default)]
pub(crate) struct Tally {
    /// Crashes that happened and that were requested, in sequences of values that a master can return.
    pub(crate) sound: Share,
    /// The same for sequences with values that a master cannot return.
    pub(crate) with_unreturnable: Share,
    /// The values that prevented crashes, because a successor could not have got them.
    pub(crate) spared: Vec<Skipped>,
}

/// Plays a sequence through rosrescue.
pub(crate) fn run(
    script: &Script,
    nodes: &[Node],
    core: bool,
    reads: &str,
    tally: &mut Tally,
) -> Result<(), Failure> {
    undisturbed(|| {
        let mut rig = Rig::start(core, reads);
        let model = rig.state();
        let wires = (0..CLIENTS).map(|_| rig.wire()).collect();
        let mut stage = Stage::new(nodes, wires, model);
        stage.allow_repeats();
        stage.callbacks = !script.unreturnable;
        let result = steps(script, &mut rig, &mut stage, tally);
        if result.is_ok() {
            return (result, None);
        }
        rig.look(&mut stage);
        if !crate::nodes::HURRIED.get() {
            eprintln!("{}", rig.rescue.log());
        }
        let scratch = rig.master.as_ref().map(|master| &master.scratch);
        let lost = || lost_callback(scratch.unwrap_or(&rig.scratch));
        let excuse = excuse(&result, stage.disturbance.or_else(lost));
        (result, excuse)
    })
}

fn steps(
    script: &Script,
    rig: &mut Rig,
    stage: &mut Stage<'_>,
    tally: &mut Tally,
) -> Result<(), Failure> {
    let mut in_flight = false;
    let mut instants = Vec::new();
    for (nth, step) in script.steps.iter().enumerate() {
        let done = match step {
            Step::Call { by, call } => {
                let call = stage.real(call);
                let by = by % CLIENTS;
                let mut after = stage.model.clone();
                let request = Request::from(call.clone());
                after.apply(&request);
                if stage.away && !request.is_answerable() {
                    // The handover needs a master.
                    rig.revive();
                }
                if stage.away && !skipped(&after).is_empty() {
                    // Only a running master can return what a successor could not get.
                    rig.revive();
                    rig.await_gate(true)?;
                }
                rig.look(stage);
                match std::mem::take(&mut in_flight) {
                    false => stage.call(by, &call).and_then(|()| match request.kind() {
                        Kind::Read if !stage.away => rig.same_bytes(&call, &request),
                        _ => Ok(()),
                    }),
                    true => crash_under(rig, stage, by, &call, nth),
                }
            }
            Step::Crash { in_flight: during } => {
                let share = match script.unreturnable {
                    true => &mut tally.with_unreturnable,
                    false => &mut tally.sound,
                };
                share.asked += 1;
                rig.revive();
                let mut skipped = skipped(&stage.model);
                // The running call may be part of the state.
                if let (true, Some(Step::Call { call, .. })) = (during, script.steps.get(nth + 1)) {
                    let mut after = stage.model.clone();
                    after.apply(&stage.real(call).into());
                    skipped.extend(self::skipped(&after));
                }
                if !skipped.is_empty() {
                    tally.spared.extend(skipped.into_iter().take(1));
                    continue;
                }
                share.happened += 1;
                in_flight = *during;
                // Everything queued arrives before the crash, which would lose it.
                stage.settle().and_then(|()| {
                    let repeats = stage.repeats.get_or_insert_default();
                    repeats.crash(&stage.model);
                    stage.away = true;
                    if *during { Ok(()) } else { rig.crash() }
                })
            }
            // A call that must be in flight needs a master.
            Step::Away
                if !in_flight && skipped(&stage.model).is_empty() && rig.master.is_some() =>
            {
                stage.settle().and_then(|()| {
                    let repeats = stage.repeats.get_or_insert_default();
                    repeats.crash(&stage.model);
                    stage.away = true;
                    rig.kill()?;
                    rig.await_gate(false)
                })
            }
            Step::Back => {
                rig.revive();
                Ok(())
            }
            Step::Away | Step::Handover { .. } | Step::Successor(_) => Ok(()),
        };
        done.map_err(|why| format!("step {nth}, {step:?}: {why}"))?;
        if !in_flight && Dice(nth as u64).once_in(INSTANT_EACH) {
            instants.push(instant(&stage.model));
        }
    }
    rig.revive();
    let end = rig.await_gate(true).and_then(|()| {
        rig.look(stage);
        stage.settle()
    });
    let end = end.and_then(|()| {
        let divergences = &status(&rig.rescue.client())["counters"]["divergences"];
        if *divergences != 0 {
            return Err(format!("{divergences} replies were taken for divergences"));
        }
        let mut wire = rig.wire();
        stage.same_reads(&mut wire)?;
        let mut behind = Wire::connect(rig.master_port).map_err(|error| error.to_string())?;
        stage
            .same_reads(&mut behind)
            .map_err(|why| format!("the master behind: {why}"))?;
        // The files may be replaced while they are read.
        let had = rig.had_states(&instants);
        had.or_else(|_| rig.had_states(&instants))
    });
    end.map_err(|why| format!("at the end: {why}"))
}

/// Sends a call, and kills the master a moment later.
fn crash_under(
    rig: &mut Rig,
    stage: &mut Stage<'_>,
    by: usize,
    call: &Call,
    nth: usize,
) -> Result<(), Failure> {
    stage.wires[by].send(call)?;
    let micros = Dice(nth as u64).next() % 2_000;
    std::thread::sleep(Duration::from_micros(micros));
    stage.away = true;
    rig.crash()?;
    let reply = stage.wires[by].receive()?;
    stage.answered(call, &reply, true)
}

/// The parts of this state that an empty master cannot get.
pub(crate) fn skipped(model: &Master) -> Vec<Skipped> {
    let plan = Plan::new(model, &Master::default(), &Token::new("test", 1));
    plan.skipped().to_vec()
}
