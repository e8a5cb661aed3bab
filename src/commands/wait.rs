//! `rosrescue wait`: waits until calls are answered, for start scripts.

use std::{fmt, time::Duration};

use ros1_master::{
    master::Method,
    xmlrpc::{Reply, Value},
};
use serde::Serialize;
use tokio::time::{Instant, sleep_until, timeout_at};

use super::{
    CommandFailure, Exit, note, print,
    running::{ANSWER_LIMIT, Running},
};
use crate::{
    cli::{For, WaitArgs},
    printable::{Lines, Page, display_lines},
    status::{condition::ConditionName, summary::Status},
};

/// Pause between two checks of the conditions.
const PAUSE: Duration = Duration::from_millis(250);
/// Time for the last check, which may end after `--timeout`. rosrescue answers in milliseconds, unless the computer is
/// busy.
const LAST_CHECK: Duration = Duration::from_secs(1);

/// The result of waiting.
#[derive(Debug, Serialize)]
struct Waited {
    uri: String,
    /// Whether all conditions are met.
    met: bool,
    /// The conditions that are not met yet.
    missing: Vec<String>,
    /// Why the missing conditions are not met.
    why: Option<String>,
    seconds: f64,
}

impl Lines for Waited {
    fn lines(&self, f: &mut Page) -> fmt::Result {
        let Self { uri, seconds, .. } = self;
        match self.met {
            true => write!(f, "ready after {seconds:.1} s: {uri}"),
            false => {
                let missing = self.missing.join(", ");
                write!(f, "timed out after {seconds:.1} s, waiting for {missing}")?;
                self.why.iter().try_for_each(|why| write!(f, ": {why}"))
            }
        }
    }
}

display_lines!(Waited);

pub(super) async fn run(args: &WaitArgs) -> Result<Exit, CommandFailure> {
    let running = Running::find(&args.target)?;
    let start = Instant::now();
    let deadline = (args.timeout > 0.0)
        .then(|| Duration::try_from_secs_f64(args.timeout).ok())
        .flatten()
        .and_then(|limit| start.checked_add(limit));
    let mut said = false;
    let mut found = (
        describe_all(&args.wanted),
        Some(format!("no answer from {}", running.address)),
    );
    loop {
        let check = missing(&running, &args.wanted);
        let checked = match deadline {
            Some(deadline) => timeout_at(deadline.max(Instant::now() + LAST_CHECK), check).await,
            None => Ok(check.await),
        };
        // A check that does not end in time changes nothing.
        if let Ok(checked) = checked {
            found = checked?;
        }
        let (missing, why) = &found;
        let late = deadline.is_some_and(|deadline| Instant::now() >= deadline);
        if missing.is_empty() || late {
            let waited = Waited {
                uri: running.address.to_string(),
                met: missing.is_empty(),
                missing: missing.clone(),
                why: why.clone(),
                seconds: start.elapsed().as_secs_f64(),
            };
            print(&waited, &args.output)?;
            return Ok(match waited.met {
                true => Exit::Good,
                false => Exit::Bad,
            });
        }
        if !std::mem::replace(&mut said, true) {
            note(&format!(
                "waiting for {} at {}",
                missing.join(", "),
                running.address
            ));
        }
        let next = Instant::now() + PAUSE;
        sleep_until(deadline.map_or(next, |deadline| deadline.min(next))).await;
    }
}

fn describe_all(wanted: &[For]) -> Vec<String> {
    wanted.iter().map(ToString::to_string).collect()
}

/// The conditions in `wanted` that are not met, and why.
async fn missing(
    running: &Running,
    wanted: &[For],
) -> Result<(Vec<String>, Option<String>), CommandFailure> {
    let status = match running.status().await {
        Ok(status) => status,
        Err(nobody @ (CommandFailure::Nobody { .. } | CommandFailure::Silent { .. })) => {
            return Ok((describe_all(wanted), Some(nobody.to_string())));
        }
        Err(failure) => return Err(failure),
    };
    let mut missing = Vec::new();
    for wanted in wanted {
        if !is_so(running, wanted, &status).await {
            missing.push(wanted.to_string());
        }
    }
    let why = (!missing.is_empty()).then(|| status.condition.line());
    Ok((missing, why))
}

async fn is_so(running: &Running, wanted: &For, status: &Status) -> bool {
    match wanted {
        For::Answered => status.ready,
        For::Master => status.open || status.condition.apart_from_nodes == ConditionName::Following,
        For::Protected => status.condition.is_protected(),
        // rosrescue would hold the lookup.
        For::Node(_) if !status.ready => false,
        For::Node(name) => {
            let params = ["/rosrescue_wait", name].map(Value::from);
            let reply = running
                .call(Method::LookupNode.name(), params.into(), ANSWER_LIMIT)
                .await;
            matches!(reply, Ok(Reply::Value(Value::Array(answer))) if answer.first() == Some(&Value::Int(1)))
        }
    }
}
