//! `rosrescue restore`: puts a checkpoint back into a running rosrescue, by calls that anybody may make. So the
//! master, the mirror, the journal and the nodes all hear of it.

mod evidence;

use std::{
    fmt,
    io::{self, IsTerminal, Write},
    sync::Arc,
    time::{Duration, Instant},
};

use serde::Serialize;

use super::{Exit, Failure, files, live::Live, print, running::Running};
use crate::{
    checkpoint::{
        format::shown,
        putback::{self, LeftOut, Params, Registration},
    },
    cli::RestoreArgs,
    hide::Hide,
    master::{CALLER_ID, Displaced, Master, Method, Request},
    xmlrpc::Value,
};

/// Most calls, and about the most bytes of values, in one multicall: other callers have their turn in between.
const CALLS_AT_ONCE: usize = 200;
const BYTES_AT_ONCE: usize = 4 << 20;

pub(super) async fn run(args: &RestoreArgs) -> Result<Exit, Failure> {
    let file = files::read(&args.file, &args.read).await?;
    let mut live = Live::connect(&Running::find(&args.target)?).await?;
    let work = Work::plan(&Arc::new(file.state.clone()), &mut live, args.exact).await?;
    let mut restored = Restored {
        file: file.path.display().to_string(),
        master: live.uri.clone(),
        plan: work.in_words(&args.hide.hide_values),
        done: false,
        failed: Vec::new(),
    };
    let json = args.output.json;
    let does = !args.plan && !work.is_empty();
    if !json || (does && !args.yes) {
        print(&restored, &args.output)?;
    }
    if does {
        if !(args.yes || agreed(json)?) {
            return Err(Failure::Failed("nothing was done".to_owned()));
        }
        restored.failed = work.carry_out(&file.state, &mut live, args.exact).await?;
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

/// Asks at the terminal, unless the output is `json` for a program.
fn agreed(json: bool) -> Result<bool, Failure> {
    if json || !io::stdin().is_terminal() || !io::stderr().is_terminal() {
        let why = "nothing was done: there is nobody to ask. --yes does it, --plan only says it";
        return Err(Failure::Usage(why.to_owned()));
    }
    eprint!("Do this? [y/N] ");
    let _ = io::stderr().flush();
    let mut answer = String::new();
    let read = io::stdin().read_line(&mut answer);
    read.map_err(|error| Failure::Failed(format!("no answer: {error}")))?;
    Ok(["y", "yes"].contains(&answer.trim().to_lowercase().as_str()))
}

/// What is to be done.
struct Work {
    params: Params,
    registrations: Vec<Registration>,
    left_out: Vec<LeftOut>,
}

impl Work {
    async fn plan(file: &Arc<Master>, live: &mut Live, exact: bool) -> Result<Self, Failure> {
        let now = live.state(file).await?;
        let params = putback::params(file.params(), now.params(), exact);
        let (absent, mut left_out) = putback::absent(file, &now);
        let mut registrations = evidence::of_living(file, &now, absent, &mut left_out).await;
        registrations.sort_by_key(|one| rank(&one.call));
        left_out.extend(params.left_out.iter().cloned());
        Ok(Self {
            params,
            registrations,
            left_out,
        })
    }

    fn is_empty(&self) -> bool {
        self.params.set.is_empty() && self.params.delete.is_empty() && self.registrations.is_empty()
    }

    fn in_words(&self, hide: &Hide) -> Plan {
        let set = self.params.set.iter().map(|(name, was, is)| Set {
            name: name.clone(),
            from: was.as_ref().map(|was| shown(&hide.mask(name, was))),
            to: shown(&hide.mask(name, is)),
        });
        let left_out = self.left_out.iter().map(|(what, why)| Left {
            what: what.clone(),
            why: why.clone(),
        });
        Plan {
            set: set.collect(),
            delete: self.params.delete.clone(),
            register: self
                .registrations
                .iter()
                .map(|one| one.text.clone())
                .collect(),
            left_out: left_out.collect(),
        }
    }

    /// Does it, reads back, and returns what has not come about.
    async fn carry_out(
        &self,
        file: &Master,
        live: &mut Live,
        exact: bool,
    ) -> Result<Vec<String>, Failure> {
        let mut failed = Vec::new();
        let set = self.params.set.iter().map(|(name, _, value)| {
            let params = [Value::from(CALLER_ID), name.as_str().into(), value.clone()];
            (
                format!("set {name}"),
                Request::new(Method::SetParam, params),
            )
        });
        let delete = self.params.delete.iter().map(|name| {
            let call = Request::new(Method::DeleteParam, [CALLER_ID, name]);
            (format!("delete {name}"), call)
        });
        make(live, set.chain(delete).collect(), &mut failed).await?;
        let register = self.still_there(live, file, &mut failed).await?;
        make(live, register, &mut failed).await?;
        // What was refused is told with the master's own words.
        if failed.is_empty() {
            let now = live.state(file).await?;
            let params = putback::params(file.params(), now.params(), exact);
            failed.extend(
                params
                    .set
                    .iter()
                    .map(|(name, ..)| format!("{name} has another value again")),
            );
            failed.extend(
                params
                    .delete
                    .iter()
                    .map(|name| format!("{name} is there again")),
            );
            let (absent, _) = putback::absent(file, &now);
            let lacking: Vec<_> = absent.iter().flat_map(|node| &node.registrations).collect();
            let again = self
                .registrations
                .iter()
                .filter(|one| lacking.contains(one));
            failed.extend(again.map(|one| format!("{} is not so", one.text)));
        }
        Ok(failed)
    }

    /// The registrations of nodes that have not registered at another address since the plan was made: rosmaster
    /// would shut them down.
    async fn still_there(
        &self,
        live: &mut Live,
        file: &Master,
        failed: &mut Vec<String>,
    ) -> Result<Vec<(String, Request)>, Failure> {
        if self.registrations.is_empty() {
            return Ok(Vec::new());
        }
        let now = live.state(file).await?;
        let mut calls = Vec::new();
        for Registration { text, call, .. } in &self.registrations {
            match now.displaced_by(call) {
                Some(Displaced { node, api, .. }) => {
                    failed.push(format!("{text}: {node} is at {api} by now"));
                }
                None => calls.push((text.clone(), call.clone())),
            }
        }
        Ok(calls)
    }
}

/// Publishers come first: a subscriber hears of all of them at once.
fn rank(call: &Request) -> u8 {
    match call.method() {
        Method::RegisterPublisher => 0,
        Method::RegisterService => 1,
        Method::RegisterSubscriber => 2,
        _ => 3,
    }
}

/// Makes calls, each with what it is for. Adds those that were refused to `failed`.
async fn make(
    live: &mut Live,
    calls: Vec<(String, Request)>,
    failed: &mut Vec<String>,
) -> Result<(), Failure> {
    let (total, mut done, mut said) = (calls.len(), 0, Instant::now());
    let mut calls = calls.into_iter().peekable();
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
        let refused = live.make(batch).await?;
        let refused = texts.into_iter().zip(refused);
        failed.extend(refused.filter_map(|(text, why)| Some(format!("{text}: {}", why?))));
        if said.elapsed() >= Duration::from_secs(1) && io::stderr().is_terminal() {
            eprintln!("{done} of {total} calls …");
            said = Instant::now();
        }
    }
    Ok(())
}

#[derive(Serialize)]
struct Restored {
    file: String,
    master: String,
    plan: Plan,
    /// Whether it was done and read back.
    done: bool,
    /// What was tried and is not so.
    failed: Vec<String>,
}

#[derive(Serialize)]
struct Plan {
    set: Vec<Set>,
    delete: Vec<String>,
    /// Registrations of nodes that answer where they were.
    register: Vec<String>,
    left_out: Vec<Left>,
}

#[derive(Serialize)]
struct Set {
    name: String,
    /// None if it is not set now.
    from: Option<String>,
    to: String,
}

#[derive(Serialize)]
struct Left {
    what: String,
    why: String,
}

/// The plan.
impl fmt::Display for Restored {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let plan = &self.plan;
        writeln!(f, "from  {}\nto    {}", self.file, self.master)?;
        for Set { name, from, to } in &plan.set {
            match from {
                Some(from) => writeln!(f, "set {name}: {from} -> {to}")?,
                None => writeln!(f, "set {name}: {to}")?,
            }
        }
        plan.delete
            .iter()
            .try_for_each(|name| writeln!(f, "delete {name}"))?;
        plan.register
            .iter()
            .try_for_each(|text| writeln!(f, "register: {text}"))?;
        for Left { what, why } in &plan.left_out {
            writeln!(f, "left out: {what}: {why}")?;
        }
        let (set, delete, register) = (plan.set.len(), plan.delete.len(), plan.register.len());
        match set + delete + register {
            0 => writeln!(f, "nothing to do"),
            _ => writeln!(
                f,
                "to do: {set} parameters to set, {delete} to delete, {register} registrations to make"
            ),
        }
    }
}

#[derive(Serialize)]
#[serde(transparent)]
struct Outcome<'a>(&'a Restored);

impl fmt::Display for Outcome<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let failed = &self.0.failed;
        failed
            .iter()
            .try_for_each(|sentence| writeln!(f, "failed: {sentence}"))?;
        match failed.len() {
            0 => writeln!(f, "done, and read back"),
            count => writeln!(f, "done but for {count}"),
        }
    }
}
