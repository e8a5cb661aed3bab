//! `rosrescue drill`: kills processes on purpose, watches the robot as a node would, and gives a verdict.

mod calls;
mod kill;
mod node;
mod robot;
mod target;
mod tcpros;
mod topics;
mod verdict;

use std::{
    io::IsTerminal,
    time::{Duration, Instant},
};

use checkpoint_store::history;
use ros1_master::xmlrpc::Value;
use tokio::{
    task::JoinHandle,
    time::{sleep, timeout},
};
use tokio_util::sync::CancellationToken;

use self::{
    calls::{Api, CallResults, Callers},
    node::DrillNode,
    robot::{ByOthers, DrillDifference, RobotState},
    target::Target,
    topics::{Topic, Usefulness},
    verdict::{DrillVerdict, names},
};
use super::{
    CommandFailure, Exit, agrees, counted, end_signals::EndSignals, eprint_line, print,
    running::Running,
};
use crate::{
    cli::{DrillArgs, Victim},
    process,
    status::summary::Status,
};

const PREFIX: &str = history::DRILLS;
/// How long the drill watches the robot before the first kill, to choose topics and learn normal pauses.
const BEFORE: Duration = Duration::from_secs(2);
/// Number of topics that are watched if none is named.
const TOPICS: usize = 5;
/// Longest time for a node that has ended to start again, for example by roslaunch's `respawn`.
const START_AGAIN: Duration = Duration::from_secs(8);
/// Pause between two looks at nodes that do not answer.
const LOOK_AGAIN: Duration = Duration::from_millis(500);
/// Longest time for cleaning up.
const TIDY_LIMIT: Duration = Duration::from_secs(15);

pub(super) async fn run(args: &DrillArgs) -> Result<Exit, CommandFailure> {
    let running = Running::find(&args.target)?;
    let name = format!("{PREFIX}{}", std::process::id());
    let api = Api {
        uri: running.address.to_string(),
        caller: name.clone(),
    };
    let target = Target { running, api };
    let status = target.running.status().await?;
    if !args.no_kill {
        agree(args, &target).await?;
    }
    let node = DrillNode::start(name).await;
    let node = node.map_err(|error| CommandFailure::Failed(format!("cannot listen: {error}")))?;
    let mut drill = Drill {
        args,
        target,
        node,
        topics: Vec::new(),
        calls: None,
    };
    let mut ends = EndSignals::new()?;
    let stop = CancellationToken::new();
    let ended = tokio::select! {
        verdict = drill.run(&status, &stop) => verdict,
        () = ends.received() => Err(interrupted()),
    };
    // Each caller first finishes its present call, so nothing is registered after this.
    stop.cancel();
    let tidied = drill.tidy_up().await;
    let mut verdict = match ended {
        Ok(verdict) => verdict,
        Err(failure) => return tidied.map_err(CommandFailure::Failed).and(Err(failure)),
    };
    if let Err(why) = tidied {
        verdict.passed = false;
        verdict.failures.push(why);
    }
    print(&verdict, &args.output)?;
    Ok(if verdict.passed {
        Exit::Good
    } else {
        Exit::Bad
    })
}

fn interrupted() -> CommandFailure {
    CommandFailure::Failed("interrupted: no verdict. The drill has cleaned up".to_owned())
}

/// Says what will be killed, and asks for consent.
async fn agree(args: &DrillArgs, target: &Target) -> Result<(), CommandFailure> {
    target.require_this_computer().await?;
    let kill = if args.hang { Victim::Master } else { args.kill };
    let victims = names(&target.victims(kill).await?);
    let how = if args.hang { "SIGSTOP" } else { "SIGKILL" };
    eprint_line(&format!(
        "This sends {how} to {victims} of {}, {}.",
        target.running.address,
        counted(args.times as usize, "time")
    ));
    if args.yes {
        return Ok(());
    }
    if !std::io::stdin().is_terminal() {
        return Err(CommandFailure::Usage(
            "cannot ask here: run the drill with --yes, at a terminal, or with --no-kill"
                .to_owned(),
        ));
    }
    match agrees("Is the robot safe on the bench? Start the drill?").unwrap_or(false) {
        true => Ok(()),
        false => Err(CommandFailure::Failed("killed nothing".to_owned())),
    }
}

struct Drill<'a> {
    args: &'a DrillArgs,
    target: Target,
    node: DrillNode,
    topics: Vec<Topic>,
    /// The task of the callers, while they run.
    calls: Option<JoinHandle<CallResults>>,
}

impl Drill<'_> {
    /// Waits for the callers to end, and returns what they found.
    async fn calls(&mut self) -> CallResults {
        let calls = match &mut self.calls {
            Some(calls) => calls.await.unwrap_or_default(),
            None => CallResults::default(),
        };
        self.calls = None;
        calls
    }

    fn key(&self) -> &str {
        &self.node.name
    }

    /// Runs the whole drill, without [`Self::tidy_up`].
    async fn run(
        &mut self,
        status: &Status,
        stop: &CancellationToken,
    ) -> Result<DrillVerdict, CommandFailure> {
        let start = Instant::now();
        eprint_line("watching normal operation, and finding topics with messages");
        let api = self.target.api.clone();
        self.remove_left_behind().await?;
        let before = RobotState::read(&api)
            .await
            .map_err(CommandFailure::Failed)?;
        // Subscribes to all parameters: changes by others are not failures of rosrescue.
        let subscribe = [self.node.api.as_str().into(), "/".into()];
        let subscribed = api.call("subscribeParam", &subscribe).await;
        subscribed.map_err(CommandFailure::Failed)?;
        let callers = Callers {
            api: api.clone(),
            node_api: self.node.api.clone(),
            log: self.node.log.clone(),
            key: self.key().to_owned(),
            topic: format!("{}/topic", self.key()),
        };
        self.calls = Some(crate::task::spawn(callers.run(stop.clone())));
        self.choose_topics().await?;
        sleep(BEFORE).await;
        let meanwhile = RobotState::read(&api)
            .await
            .map_err(CommandFailure::Failed)?;
        for topic in &self.topics {
            topic.begin();
        }
        let kills = if self.args.no_kill {
            eprint_line(&format!("watching for {} s", self.args.seconds));
            sleep(Duration::from_secs(self.args.seconds.into())).await;
            Vec::new()
        } else {
            self.kill().await?
        };
        stop.cancel();
        let calls = self.calls().await;
        let updates = self.node.log.updates();
        let (now, watched) = (Instant::now(), self.topics.iter());
        let mut topics: Vec<_> = watched.map(|topic| topic.report(now, &updates)).collect();
        let difference = match self.read_after(&before).await {
            Ok((after, others)) => before.compare(&meanwhile, &after, &others),
            Err(why) => DrillDifference {
                lost: vec![format!("cannot read the state at the end: {why}")],
                ..DrillDifference::default()
            },
        };
        for topic in &mut topics {
            topic.count_failures(&difference.ended);
        }
        let mut verdict = DrillVerdict {
            passed: false,
            uri: self.target.running.address.to_string(),
            version: status.version.clone(),
            seconds: start.elapsed().as_secs_f64(),
            kills,
            calls,
            topics,
            nodes: difference.same,
            registrations_and_parameters: before.facts(),
            failures: Vec::new(),
            notes: Vec::new(),
        };
        let shutdown = self.node.log.shutdown();
        verdict.collect_failures(difference, shutdown, self.args.limit);
        Ok(verdict)
    }

    /// Reads the state at the end, and what others did. A node that is started again gets some time for that.
    async fn read_after(&self, before: &RobotState) -> Result<(RobotState, ByOthers), String> {
        let start = Instant::now();
        let after = loop {
            let after = RobotState::read(&self.target.api).await?;
            if before.all_answer(&after) || start.elapsed() > START_AGAIN {
                break after;
            }
            sleep(LOOK_AGAIN).await;
        };
        let others = ByOthers {
            changed: self.node.log.changed(),
            died: self.target.died().await?,
            alive: before.alive_without(&after).await,
        };
        Ok((after, others))
    }

    /// Subscribes to the topics to watch.
    async fn choose_topics(&mut self) -> Result<(), CommandFailure> {
        let api = self.target.api.clone();
        if !self.args.topic.is_empty() {
            for topic in &self.args.topic {
                let name = format!("/{}", topic.trim_start_matches('/'));
                let topic = Topic::subscribe(&api, &self.node, &name, Usefulness::Other).await;
                let topic = topic.map_err(CommandFailure::Failed)?;
                let published = topic.has_publishers();
                self.topics.push(topic);
                if !published {
                    let what = format!("--topic: no node publishes {name}");
                    return Err(CommandFailure::Usage(what));
                }
            }
            return Ok(());
        }
        let mut found = Vec::new();
        let candidates = topics::candidates(&api).await;
        for (name, usefulness) in candidates.map_err(CommandFailure::Failed)? {
            match Topic::subscribe(&api, &self.node, &name, usefulness).await {
                Ok(topic) => found.push(topic),
                Err(why) => {
                    eprint_line(&format!("not watched: {why}"));
                    let _ = topics::unregister(&api, &self.node, &name).await;
                }
            }
        }
        sleep(BEFORE).await;
        let names: Vec<_> = found.iter().map(|topic| topic.name.clone()).collect();
        topics::sort(&mut found);
        found.truncate(TOPICS);
        for name in names {
            if !found.iter().any(|topic| topic.name == name) {
                let _ = topics::unregister(&api, &self.node, &name).await;
            }
        }
        self.topics.extend(found);
        Ok(())
    }

    /// Deletes the parameters of earlier drills that were killed. The next health check removes their registrations.
    async fn remove_left_behind(&self) -> Result<(), CommandFailure> {
        let api = &self.target.api;
        let keys = api
            .call("getParamNames", &[])
            .await
            .map_err(CommandFailure::Failed)?;
        for key in keys.as_array().unwrap_or_default() {
            let pid = key.as_str().and_then(|key| key.strip_prefix(PREFIX));
            let pid = pid.and_then(|pid| pid.parse().ok());
            if pid.is_some_and(|pid| !process::is_alive(pid)) {
                let _ = api.call("deleteParam", std::slice::from_ref(key)).await;
            }
        }
        Ok(())
    }

    /// Removes everything that the drill has left in the master.
    async fn tidy_up(&mut self) -> Result<(), String> {
        self.calls().await;
        let api = &self.target.api;
        let work = async {
            let mut done = Ok(());
            for topic in &self.topics {
                done = done.and(topic.unsubscribe(api, &self.node).await);
            }
            let topic = format!("{}/topic", self.key());
            done = done.and(topics::unregister(api, &self.node, &topic).await);
            let unsubscribe = [self.node.api.as_str().into(), "/".into()];
            done = done.and(api.call("unsubscribeParam", &unsubscribe).await.map(drop));
            let keys = api.call("getParamNames", &[]).await?;
            let key = Value::from(self.key());
            if keys.as_array().is_some_and(|keys| keys.contains(&key)) {
                done = done.and(api.call("deleteParam", &[key]).await.map(drop));
            }
            done
        };
        let done = timeout(TIDY_LIMIT, work).await;
        let done = done.unwrap_or_else(|_| Err(format!("no answer in {} s", TIDY_LIMIT.as_secs())));
        done.map_err(|why| {
            format!(
                "the drill could not clean up: {why}. The next health check removes {}. Remove its \
                 parameter with `rosparam delete {}`",
                self.node.name,
                self.key()
            )
        })
    }
}
