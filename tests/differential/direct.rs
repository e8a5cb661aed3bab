//! Compares the model with a bare rosmaster.

use rescue_core::replay::{Inspection, NotAMaster, Plan, Skipped, Token, TokenState, difference};
use ros1_master::{
    master::{Master, Notice, Request},
    xmlrpc::{Call, decode_call},
};

use crate::dice::{Cast, Dice};
use crate::nodes::Node;
use crate::real::{Rosmaster, Wire, lost_callback};
use crate::script::{Script, Step, node_api};
use crate::stage::{CLIENTS, Failure, Stage, excuse, undisturbed};
use crate::support::unordered;

/// Maximum number of calls that a successor has answered before it gets the state.
const FOUND: usize = 15;

/// A random sequence with one or two successors.
pub(crate) fn script(seed: u64, calls: usize, nodes: usize) -> Script {
    let mut dice = Dice(seed);
    let mut cast = Cast {
        apis: (0..nodes).map(node_api).collect(),
        unreturnable: dice.once_in(3),
        errors: !dice.once_in(4),
        process: true,
    };
    cast.apis.push("rosrpc://h:1".to_owned());
    let unreturnable = cast.unreturnable;
    // A successor does not get values that a master cannot return, so values can no longer be compared.
    let between = (!unreturnable && dice.once_in(2)).then(|| dice.below(calls.max(1)));
    let mut steps = Vec::with_capacity(calls + 2);
    for nth in 0..calls {
        if between == Some(nth) {
            steps.push(successor(&mut dice, &cast));
        }
        let (by, call) = (dice.below(CLIENTS), dice.call(&cast, 2));
        steps.push(Step::Call { by, call });
    }
    cast.unreturnable = false;
    steps.push(successor(&mut dice, &cast));
    Script {
        unreturnable,
        steps,
    }
}

fn successor(dice: &mut Dice, cast: &Cast) -> Step {
    let count = if dice.once_in(3) { FOUND } else { 0 };
    Step::Successor((0..count).map(|_| dice.call(cast, 2)).collect())
}

/// Plays a sequence. `spare` is started in time for the next master that is needed.
pub(crate) fn run(script: &Script, nodes: &[Node], spare: &mut Rosmaster) -> Result<(), Failure> {
    undisturbed(|| {
        let mut real = None;
        let result = steps(script, nodes, spare, &mut real);
        let lost = real.and_then(|real| lost_callback(&real.scratch));
        let excuse = excuse(&result, lost);
        (result, excuse)
    })
}

/// Plays a sequence. `real` is the present master.
fn steps(
    script: &Script,
    nodes: &[Node],
    spare: &mut Rosmaster,
    real: &mut Option<Rosmaster>,
) -> Result<(), Failure> {
    let mut fresh = || {
        let mut next = std::mem::replace(spare, Rosmaster::start());
        let mut wires = vec![next.ready()];
        wires.extend((1..CLIENTS).map(|_| Wire::connect(next.port).unwrap()));
        let mut model = Master::default();
        wires[0].identify(&mut model);
        *real = Some(next);
        (wires, model)
    };
    let (wires, model) = fresh();
    let mut stage = Stage::new(nodes, wires, model);
    stage.callbacks = !script.unreturnable;
    for (nth, step) in script.steps.iter().enumerate() {
        let done = match step {
            Step::Call { by, call } => {
                let call = stage.real(call);
                stage.call(by % CLIENTS, &call)
            }
            Step::Successor(found) => finish(&mut stage).and_then(|()| {
                let (wires, model) = fresh();
                succeed(&mut stage, wires, model, found)
            }),
            Step::Crash { .. } | Step::Handover { .. } | Step::Away | Step::Back => Ok(()),
        };
        done.map_err(|why| format!("step {nth}, {step:?}: {why}"))?;
    }
    finish(&mut stage).map_err(|why| format!("at the end: {why}"))
}

/// Compares the remaining callbacks and all reads.
fn finish(stage: &mut Stage<'_>) -> Result<(), Failure> {
    stage.settle()?;
    let mut wire = stage.wires.remove(0);
    let same = stage
        .same_reads(&mut wire)
        .and_then(|()| look(&mut wire, &stage.model));
    stage.wires.insert(0, wire);
    same
}

/// Brings the state to a master that has answered the calls `found`, and continues with that master.
fn succeed(
    stage: &mut Stage<'_>,
    wires: Vec<Wire>,
    model: Master,
    found: &[Call],
) -> Result<(), Failure> {
    let target = std::mem::replace(&mut stage.model, model);
    stage.wires = wires;
    stage.callbacks = true;
    for call in found {
        let call = stage.real(call);
        stage
            .call(0, &call)
            .map_err(|why| format!("{call:?} {why}"))?;
    }
    let plan = Plan::new(&target, &stage.model, &Token::new("test", 1));
    let call = decode_call(plan.request()).map_err(|error| error.to_string())?;
    let reply = stage.wires[0].call(&call)?;
    let verdict = match unordered() {
        true => plan.verify_in_any_order(&reply),
        false => plan.verify(&reply),
    };
    verdict.map_err(|mismatches| format!("the injection: {mismatches:?}"))?;
    let notices = stage.model.clone().apply(&call.into()).notices;
    let is_complete = |notice: &Notice| match notice {
        Notice::PublisherUpdate {
            topic, publishers, ..
        } => *publishers == plan.expected().publishers_of(topic),
        Notice::ParamUpdate { .. } => true,
        Notice::Shutdown { .. } => false,
    };
    let is_fine = match found.is_empty() {
        true => notices.is_empty(),
        false => notices.iter().all(is_complete),
    };
    if !is_fine {
        return Err(format!("the injection causes {notices:?}"));
    }
    let cannot_be = |it: &Skipped| matches!(it, Skipped::Param { .. } | Skipped::Unnameable { .. });
    if found.is_empty() && !plan.skipped().iter().all(cannot_be) {
        return Err(format!("the injection skips {:?}", plan.skipped()));
    }
    if found.is_empty() && plan.skipped().is_empty() {
        let words = difference(&target, plan.expected());
        if !words.is_empty() {
            return Err(format!("the injection makes something else: {words:?}"));
        }
    }
    stage.note(&notices, false);
    stage.model = plan.expected().clone();
    stage.wires[0].identify(&mut stage.model);
    Ok(())
}

/// Inspects the real master, with the model as the known state, and checks that the result equals the model.
fn look(wire: &mut Wire, model: &Master) -> Result<(), Failure> {
    let mark = Token::new("none", 1);
    let mut look = |call: Request| {
        wire.ask(&call)
            .map(|reply| Inspection::decode(&reply, &mark))
    };
    let look = match look(Inspection::call(&mark))? {
        Err(NotAMaster::ParamsUnreadable { .. }) => look(Inspection::call_without_params(&mark))?,
        look => look,
    };
    let mut look = look.map_err(|error| error.to_string())?;
    if unordered() {
        look.arrange_like(model);
    }
    if look.bears() != TokenState::Nothing {
        return Err("the master has a token, although none was set".to_owned());
    }
    let second = match look.second_call(model) {
        Some(call) => Some(wire.ask(&call)?),
        None => None,
    };
    let found = look
        .into_master(second.as_ref(), model)
        .map_err(|error| error.to_string())?;
    let words = difference(model, &found);
    match words.is_empty() {
        true => Ok(()),
        false => Err(format!("a look shows something else: {words:?}")),
    }
}
