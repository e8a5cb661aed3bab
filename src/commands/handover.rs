//! `rosrescue handover`: makes another computer the leader.

use std::{fmt, time::Duration};

use rescue_core::cluster::machine::Role;
use ros1_master::xmlrpc::{Reply, Value};
use serde::Serialize;
use tokio::time::{Instant, sleep};

use super::{
    CommandFailure, Exit, note, print,
    running::{ANSWER_LIMIT, Running},
};
use crate::{
    cli::HandoverArgs,
    printable::{Lines, Page, display_lines},
    server::others::HANDOVER,
    status::computers::{Computers, LeaderStatus},
};

/// The caller id with which this command makes its call.
const CALLER: &str = "/rosrescue_handover";
/// Pause between two checks for the new leader.
const PAUSE: Duration = Duration::from_millis(20);
/// Pause between two messages about the wait.
const SAY_EVERY: Duration = Duration::from_secs(1);

/// The result of a handover.
#[derive(Debug, Serialize)]
struct Outcome {
    uri: String,
    /// Whether another computer leads now. With `--to`, whether that computer leads now.
    handed_over: bool,
    /// The leader before the handover.
    from: String,
    /// The leader now. `None` if no computer leads.
    to: Option<String>,
    /// The computer that `--to` asks for. `None` without `--to`.
    wanted: Option<String>,
    /// Seconds from the request until the result was seen.
    seconds: f64,
}

impl Outcome {
    fn new(
        running: &Running,
        from: &LeaderStatus,
        to: Option<&LeaderStatus>,
        wanted: Option<&str>,
    ) -> Self {
        let to = to.map(|to| to.name.clone());
        let is_meant = |to: &String| wanted.map_or(*to != from.name, |wanted| to == wanted);
        Self {
            uri: running.address.to_string(),
            handed_over: to.as_ref().is_some_and(is_meant),
            from: from.name.clone(),
            to,
            wanted: wanted.map(str::to_owned),
            seconds: 0.0,
        }
    }
}

impl Lines for Outcome {
    fn lines(&self, f: &mut Page) -> fmt::Result {
        let Self { from, seconds, .. } = self;
        match (&self.to, &self.wanted) {
            (Some(to), _) if self.handed_over && to == from => write!(f, "{to} leads already"),
            (Some(to), _) if self.handed_over => {
                write!(f, "{from} led, {to} leads now, after {seconds:.2} s")
            }
            (Some(to), Some(wanted)) if to != from => write!(
                f,
                "{from} led, {to} leads now instead of {wanted}, after {seconds:.2} s"
            ),
            (Some(_), _) => write!(
                f,
                "no other computer took over: {from} still leads after {seconds:.2} s"
            ),
            (None, _) => write!(
                f,
                "no other computer took over: {from} led, and no computer leads after {seconds:.2} s; see \
                 `rosrescue status`"
            ),
        }
    }
}

display_lines!(Outcome);

pub(super) async fn run(args: &HandoverArgs) -> Result<Exit, CommandFailure> {
    let running = Running::find(&args.target)?;
    let before = computers(&running).await?;
    let wanted = match args.to.as_deref() {
        Some(given) => Some(meant(&before, given)?),
        None => None,
    };
    let from = leader(&before)?;
    let mut to = Some(from.clone());
    let start = Instant::now();
    if wanted != Some(&from.name) {
        request_handover(&running, wanted, args.timeout).await?;
        to = next_leader(&running, from, start, args.timeout).await?;
    }
    let outcome = Outcome {
        seconds: start.elapsed().as_secs_f64(),
        ..Outcome::new(&running, from, to.as_ref(), wanted)
    };
    print(&outcome, &args.output)?;
    Ok(match outcome.handed_over {
        true => Exit::Good,
        false => Exit::Bad,
    })
}

async fn computers(running: &Running) -> Result<Computers, CommandFailure> {
    running.status().await?.cluster.ok_or_else(|| {
        CommandFailure::Failed(format!(
            "the rosrescue at {} runs without --cluster: there is no other \
             computer to hand over to",
            running.address
        ))
    })
}

/// The name of the computer that `--to` stands for.
fn meant<'a>(now: &'a Computers, given: &str) -> Result<&'a str, CommandFailure> {
    now.find(given).ok_or_else(|| {
        let names: Vec<_> = now.computers.iter().map(|of| &*of.name).collect();
        CommandFailure::Usage(format!(
            "--to: no computer of this robot is called `{given}`, or more than one is; there are {}",
            names.join(", ")
        ))
    })
}

/// The present leader. Fails if there is none to hand over from.
fn leader(now: &Computers) -> Result<&LeaderStatus, CommandFailure> {
    if now.role == Role::Alone {
        return Err(CommandFailure::Failed(format!(
            "{} is cut off from the others: ask another computer, with --uri",
            now.name
        )));
    }
    now.leads().ok_or_else(|| {
        CommandFailure::Failed(
            "no computer leads now, so none can hand over; see `rosrescue status`".to_owned(),
        )
    })
}

/// Asks the leader to hand over.
async fn request_handover(
    running: &Running,
    wanted: Option<&str>,
    timeout: f64,
) -> Result<(), CommandFailure> {
    let limit =
        Duration::try_from_secs_f64(timeout).map_or(ANSWER_LIMIT, |limit| limit.max(ANSWER_LIMIT));
    let params = [CALLER, wanted.unwrap_or_default()].map(Value::from);
    let refused =
        |why: &str| CommandFailure::Failed(format!("the leader refused the handover: {why}"));
    match running.call(HANDOVER, params.into(), limit).await? {
        Reply::Value(Value::Array(answer)) => match answer.as_slice() {
            [Value::Int(1), ..] => Ok(()),
            [_, why, ..] => Err(refused(why.as_str().unwrap_or("it gives no reason"))),
            _ => Err(refused("its answer cannot be read")),
        },
        Reply::Value(_) => Err(refused("its answer cannot be read")),
        Reply::Fault { text, .. } => Err(refused(&text)),
    }
}

/// Waits for a leader other than `from`. Returns the present leader when the time is over.
async fn next_leader(
    running: &Running,
    from: &LeaderStatus,
    start: Instant,
    timeout: f64,
) -> Result<Option<LeaderStatus>, CommandFailure> {
    let mut said = start;
    loop {
        let now = computers(running).await?;
        let is_next = now.leads().is_some_and(|leader| leader.term > from.term);
        if is_next || start.elapsed().as_secs_f64() >= timeout {
            return Ok(now.leads().cloned());
        }
        if said.elapsed() >= SAY_EVERY {
            said = Instant::now();
            let leads = now.leads().map_or("no computer", |leader| &*leader.name);
            let seconds = start.elapsed().as_secs();
            note(&format!(
                "{leads} leads after {seconds} s, waiting for another computer"
            ));
        }
        sleep(PAUSE).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::status::cluster_facts::ClusterFacts;

    fn shown(from: &str, to: Option<&str>, wanted: Option<&str>) -> (bool, String) {
        let running = Running {
            address: crate::ros_env::MasterUri::parse("http://pc-2:1").unwrap(),
        };
        let of = |name: &str| LeaderStatus {
            name: name.to_owned(),
            uri: String::new(),
            version: String::new(),
            term: 1,
            since: 0.0,
        };
        let to = to.map(of);
        let outcome = Outcome::new(&running, &of(from), to.as_ref(), wanted);
        (outcome.handed_over, outcome.to_string())
    }

    #[test]
    fn the_outcome_says_whether_the_requested_computer_leads() {
        for (from, to, wanted, handed_over, text) in [
            ("a", Some("b"), None, true, "a led, b leads now, after"),
            ("a", Some("b"), Some("b"), true, "a led, b leads now, after"),
            ("a", Some("a"), Some("a"), true, "a leads already"),
            (
                "a",
                Some("c"),
                Some("b"),
                false,
                "c leads now instead of b,",
            ),
            ("a", Some("a"), None, false, "a still leads"),
            ("a", Some("a"), Some("b"), false, "a still leads"),
            ("a", None, None, false, "no computer leads"),
        ] {
            let (good, said) = shown(from, to, wanted);
            assert_eq!(good, handed_over, "{said}");
            assert!(said.contains(text), "{said}");
        }
    }

    #[test]
    fn a_leader_is_asked_only_if_there_is_one_and_the_name_is_known() {
        let mut facts = ClusterFacts::of_three();
        let with = |facts: &ClusterFacts| leader(&Computers::from(facts)).cloned();
        assert_eq!(with(&facts).unwrap().name, "pc-1");
        let now = Computers::from(&facts);
        assert_eq!(meant(&now, "pc-3").unwrap(), "pc-3");
        let unknown = meant(&now, "pc-4").expect_err("unknown");
        assert!(matches!(&unknown, CommandFailure::Usage(why) if why.contains("pc-1, pc-2, pc-3")));
        facts.role = Role::Alone;
        assert!(matches!(with(&facts), Err(CommandFailure::Failed(_))));
        facts.role = Role::Following;
        facts.leaderless = Some(std::time::Instant::now());
        assert!(matches!(with(&facts), Err(CommandFailure::Failed(_))));
    }
}
