//! `rosrescue restore`: sets the parameters of a running robot to those of a checkpoint. It uses ordinary calls, so the
//! master, the mirror, the journal and the nodes all get the changes.

use std::{
    fmt,
    io::{self, IsTerminal},
    time::{Duration, Instant},
};

use rescue_core::{
    checkpoint::{
        format::shown,
        putback::{LeftOut, ParamChanges},
    },
    hide::Hide,
};
use ros1_master::{
    master::{CALLER_ID, Master, Method, Request},
    xmlrpc::Value,
};
use serde::Serialize;

use super::{
    CommandFailure, Exit, agrees, eprint_line, files, live::Live, print, running::Running,
};
use crate::{
    cli::RestoreArgs,
    printable::{Lines, Page, display_lines, line},
};

/// Maximum number of calls in one multicall; its size is limited as well. Other callers get their turn between two
/// multicalls.
const CALLS_AT_ONCE: usize = 200;
const BYTES_AT_ONCE: usize = 4 << 20;

pub(super) async fn run(args: &RestoreArgs) -> Result<Exit, CommandFailure> {
    let file = files::read_either(args.state.file.as_deref(), args.state.at, &args.read).await?;
    let mut live = Live::connect(&Running::find(&args.target)?).await?;
    let now = live.state(&file.state).await?;
    let between = |now: &Master| {
        let mut found = ParamChanges::between(file.state.params(), now.params(), args.exact);
        found.retain(&args.param);
        found
    };
    let params = between(&now);
    let mut restored = Restored {
        file: match args.state.at {
            Some(_) => file.moment(),
            None => file.path.display().to_string(),
        },
        master: live.uri.clone(),
        plan: ParamPlan::new(&params, &args.hide.hide_values),
        done: false,
        failed: Vec::new(),
    };
    let json = args.output.json;
    let does = !args.plan && !params.is_empty();
    if !json || (does && !args.yes) {
        print(&restored, &args.output)?;
    }
    if does {
        if !(args.yes || agreed(json)?) {
            return Err(CommandFailure::Failed("changed nothing".to_owned()));
        }
        restored.failed = apply(&params, &mut live).await?;
        // If the master refused calls, its messages explain what differs.
        if restored.failed.is_empty() {
            let now = live.state(&file.state).await?;
            let left = between(&now);
            let changed = left
                .set
                .iter()
                .map(|(name, ..)| format!("{name} was changed again meanwhile"));
            let back = left
                .delete
                .iter()
                .map(|name| format!("{name} was set again meanwhile"));
            restored.failed = changed.chain(back).collect();
        }
        restored.done = restored.failed.is_empty();
        if !json {
            print(&Outcome(&restored), &args.output)?;
        }
    }
    if json {
        print(&restored, &args.output)?;
    }
    Ok(if restored.failed.is_empty() {
        Exit::Good
    } else {
        Exit::Bad
    })
}

/// Asks at the terminal. Fails without asking if the output is `json`.
fn agreed(json: bool) -> Result<bool, CommandFailure> {
    if json || !io::stdin().is_terminal() || !io::stderr().is_terminal() {
        let why = "cannot ask here: --plan shows the changes, --yes makes them";
        return Err(CommandFailure::Usage(why.to_owned()));
    }
    agrees("Set these parameters?")
        .map_err(|error| CommandFailure::Failed(format!("no answer: {error}")))
}

/// Sets and deletes the parameters of a live robot. Returns the refused calls with their reasons.
async fn apply(params: &ParamChanges, live: &mut Live) -> Result<Vec<String>, CommandFailure> {
    let set = params.set.iter().map(|(name, _, value)| {
        let params = [Value::from(CALLER_ID), name.as_str().into(), value.clone()];
        let call = Request::new(Method::SetParam, params);
        (format!("set {name}"), call)
    });
    let delete = params.delete.iter().map(|name| {
        let call = Request::new(Method::DeleteParam, [CALLER_ID, name]);
        (format!("delete {name}"), call)
    });
    let total = params.set.len() + params.delete.len();
    let (mut failed, mut done, mut said) = (Vec::new(), 0, Instant::now());
    let mut calls = set.chain(delete).peekable();
    while calls.peek().is_some() {
        let (mut texts, mut batch, mut bytes) = (Vec::new(), Vec::new(), 0);
        while batch.len() < CALLS_AT_ONCE
            && bytes < BYTES_AT_ONCE
            && let Some((text, call)) = calls.next()
        {
            bytes += call.params().iter().map(Value::size).sum::<usize>();
            texts.push(text);
            batch.push(call);
        }
        done += batch.len();
        let refused = live.call_all(batch).await?;
        let refused = texts.into_iter().zip(refused);
        failed.extend(refused.filter_map(|(text, why)| Some(format!("{text}: {}", why?))));
        if said.elapsed() >= Duration::from_secs(1) && io::stderr().is_terminal() {
            eprint_line(&format!("{done} of {total} calls …"));
            said = Instant::now();
        }
    }
    Ok(failed)
}

#[derive(Serialize)]
struct Restored {
    file: String,
    master: String,
    plan: ParamPlan,
    /// Whether all parameters were set and read back.
    done: bool,
    /// Calls that were refused, and parameters that have changed again.
    failed: Vec<String>,
}

#[derive(Serialize)]
struct ParamPlan {
    set: Vec<Set>,
    delete: Vec<String>,
    left_out: Vec<SkippedParam>,
}

impl ParamPlan {
    fn new(params: &ParamChanges, hide: &Hide) -> Self {
        let set = params.set.iter().map(|(name, was, is)| Set {
            name: name.clone(),
            from: was.as_ref().map(|was| shown(&hide.mask(name, was))),
            to: shown(&hide.mask(name, is)),
        });
        let left_out = params
            .left_out
            .iter()
            .map(|(what, why): &LeftOut| SkippedParam {
                what: what.clone(),
                why: why.clone(),
            });
        Self {
            set: set.collect(),
            delete: params.delete.clone(),
            left_out: left_out.collect(),
        }
    }
}

#[derive(Serialize)]
struct Set {
    name: String,
    /// The present value. `None` if the parameter is not set.
    from: Option<String>,
    to: String,
}

#[derive(Serialize)]
struct SkippedParam {
    what: String,
    why: String,
}

/// Shows the plan.
impl Lines for Restored {
    fn lines(&self, f: &mut Page) -> fmt::Result {
        let plan = &self.plan;
        line!(f, "from  {}", self.file)?;
        line!(f, "to    {}", self.master)?;
        for Set { name, from, to } in &plan.set {
            match from {
                Some(from) => line!(f, "set {name}: {from} -> {to}")?,
                None => line!(f, "set {name}: {to}")?,
            }
        }
        plan.delete
            .iter()
            .try_for_each(|name| line!(f, "delete {name}"))?;
        for SkippedParam { what, why } in &plan.left_out {
            line!(f, "left out: {what}: {why}")?;
        }
        let (set, delete) = (plan.set.len(), plan.delete.len());
        match set + delete {
            0 => line!(f, "nothing to do"),
            _ => line!(f, "{set} parameters to set, {delete} to delete"),
        }
    }
}

display_lines!(Restored);

#[derive(Serialize)]
#[serde(transparent)]
struct Outcome<'a>(&'a Restored);

impl Lines for Outcome<'_> {
    fn lines(&self, f: &mut Page) -> fmt::Result {
        let failed = &self.0.failed;
        failed
            .iter()
            .try_for_each(|sentence| line!(f, "failed: {sentence}"))?;
        match failed.len() {
            0 => line!(f, "done and read back"),
            count => line!(f, "done, except for {count}"),
        }
    }
}

display_lines!(Outcome<'_>);
