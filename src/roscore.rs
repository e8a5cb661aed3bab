//! roscore's duties besides the master: `/run_id`, `/rosversion`, `/rosdistro`, and rosout.

use std::{
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicU32, Ordering},
    },
    time::{Duration, Instant},
};

use rescue_core::replay::ROSOUT;
use ros1_master::{
    master::{self, CALLER_ID, Method, Request},
    xmlrpc::{Reply, Value},
};
use tokio::task::block_in_place;
use tokio_util::sync::CancellationToken;

use crate::nodes::client::{self, Reaction};
use crate::{
    gate,
    ledger::Ledger,
    limit::{AlarmLimit, alarm, all_clear},
    process::{self, Rosout},
    resolver,
    write_queue::WriteQueue,
};

/// Time limit for `rosversion`, which is a Python program.
const VERSION_TIME: Duration = Duration::from_secs(20);
/// Pause before rosout is restarted, as with roslaunch's `respawn`. The pause doubles each time rosout ends before it
/// has run for [`LONGEST_RESPAWN`].
const RESPAWN: Duration = Duration::from_secs(1);
const LONGEST_RESPAWN: Duration = Duration::from_secs(10);

pub(crate) struct Roscore {
    /// The ledger, which knows whether the parameters are set already.
    pub ledger: Arc<Ledger>,
    pub write_queue: WriteQueue,
    /// The gate, which tells whether calls pass to the master.
    pub gate: gate::Rx,
    /// The address that rosrescue serves.
    pub uri: String,
    /// Path of the checkpoint. The rosout of this rosrescue is known by this path in its environment.
    pub checkpoint: PathBuf,
    /// Longest time for a node to answer.
    pub node_timeout: Duration,
    /// Process id of the rosout of this rosrescue; 0 if there is none.
    pub rosout: AtomicU32,
}

fn set(key: &str, value: &str) -> Request {
    Request::new(Method::SetParam, [CALLER_ID, key, value])
}

fn has_param(roscore: &Roscore, key: &str) -> bool {
    let call = Request::new(Method::HasParam, [CALLER_ID, key]);
    let yes = Value::Bool(true);
    matches!(roscore.ledger.answer(&call), Some(Reply::Value(Value::Array(answer))) if answer.get(2) == Some(&yes))
}

fn run_id(roscore: &Roscore) -> Request {
    set("/run_id", &roscore.ledger.session().id)
}

/// Sets the run id of a new session before there is a master. The master gets it with the rest of the state, so every
/// roslaunch sees a master with a run id. Does nothing if the master may already have a run id.
pub(crate) fn seed_run_id(roscore: &Roscore) {
    if !has_param(roscore, "/run_id") {
        roscore.ledger.seed(&run_id(roscore));
    }
}

/// Sets the versions, and runs rosout once there is a master, until `stop`. Then it stops rosout.
pub(crate) async fn run(roscore: Roscore, rosout: bool, stop: CancellationToken) {
    let duties = async {
        // `rosversion` is slow, so it runs while the master starts.
        let versions = tokio::join!(
            version_call(&roscore, "/rosversion", "roslaunch"),
            version_call(&roscore, "/rosdistro", "-d"),
            first_opening(&roscore),
        );
        let missing = Some(run_id(&roscore)).filter(|_| !has_param(&roscore, "/run_id"));
        let calls: Vec<_> = [missing, versions.0, versions.1]
            .into_iter()
            .flatten()
            .collect();
        if !calls.is_empty() {
            let calls = Request::multicall(calls);
            roscore.write_queue.call(calls).await;
        }
    };
    let rosout = async {
        first_opening(&roscore).await;
        if rosout {
            supervise_rosout(&roscore).await;
        }
    };
    tokio::select! {
        ((), ()) = async { tokio::join!(duties, rosout) } => {}
        () = stop.cancelled() => {}
    }
    stop.cancelled().await;
    // From now on no rosout is started. rosout can still unregister from the master.
    end_rosout(&roscore).await;
}

async fn first_opening(roscore: &Roscore) {
    roscore.gate.clone().wait_for(gate::State::is_open).await;
}

/// The call that sets `key` to the output of `rosversion ARGUMENT`, with its last line feed, as roslaunch does for
/// `roscore.xml`. `None` if the parameter is set already, or the program does not answer.
async fn version_call(roscore: &Roscore, key: &str, argument: &str) -> Option<Request> {
    if has_param(roscore, key) {
        return None;
    }
    let version = process::output_of("rosversion", &[argument], VERSION_TIME).await;
    if version.is_none() {
        tracing::warn!(
            "the parameter {key} is not set: `rosversion {argument}` did not answer; set it yourself if a node needs it"
        );
    }
    version.map(|version| set(key, &version))
}

/// Limits the log lines about the end and the start of rosout.
static ENDED: AlarmLimit = AlarmLimit::new();

/// Keeps one rosout running: that of this rosrescue, or one that exists already.
async fn supervise_rosout(roscore: &Roscore) {
    let Some(rosout) = block_in_place(|| Rosout::find(&roscore.checkpoint)) else {
        tracing::warn!(
            "rosout is not installed, so /rosout is not collected; run `apt-get install rosout`, or use --no-rosout"
        );
        return;
    };
    let mut pause = RESPAWN;
    loop {
        let start = Instant::now();
        let mut living = living_rosout(roscore).await;
        while living == Some(Living::Elsewhere) {
            tokio::time::sleep(LONGEST_RESPAWN).await;
            living = living_rosout(roscore).await;
        }
        let here = match living {
            Some(Living::Here { pid }) => Some(pid),
            _ => block_in_place(|| rosout.find_orphan()),
        };
        match here {
            Some(pid) => {
                roscore.rosout.store(pid, Ordering::Relaxed);
                process::wait_until_ended(pid).await;
            }
            None => match rosout.spawn(&roscore.uri).await {
                Ok(mut child) => {
                    let pid = child.id().unwrap_or_default();
                    roscore.rosout.store(pid, Ordering::Relaxed);
                    all_clear!(info, ENDED, pid, "started rosout");
                    let how = child.wait().await.map(process::describe);
                    let (how, last_words) = (how.unwrap_or_default(), rosout.last_words().await);
                    alarm!(
                        warn,
                        ENDED,
                        pid,
                        how,
                        last_words,
                        "rosout has ended and is restarted"
                    );
                }
                Err(error) => {
                    alarm!(warn, ENDED, %error, "cannot start rosout; retrying; /rosout is not collected meanwhile")
                }
            },
        }
        roscore.rosout.store(0, Ordering::Relaxed);
        if start.elapsed() >= LONGEST_RESPAWN {
            pause = RESPAWN;
        }
        tokio::time::sleep(pause).await;
        pause = (pause * 2).min(LONGEST_RESPAWN);
    }
}

/// A registered rosout that answers.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Living {
    Here {
        pid: u32,
    },
    /// It runs on another computer or in a container, where its process id means something else, or is another program.
    Elsewhere,
}

/// The registered rosout. `None` if it does not answer.
async fn living_rosout(roscore: &Roscore) -> Option<Living> {
    let api = roscore
        .ledger
        .with_mirror(|mirror| mirror.api_of(ROSOUT).map(str::to_owned))?;
    let asked = client::call_for_value(&api, &master::get_pid(), roscore.node_timeout).await;
    let (Reaction::Alive, Some(Value::Int(pid))) = asked else {
        return None;
    };
    let pid = u32::try_from(pid).ok()?;
    let is_here = block_in_place(|| process::runs(pid, "rosout"))
        && !resolver::is_elsewhere(&api, roscore.node_timeout).await;
    Some(match is_here {
        true => Living::Here { pid },
        false => Living::Elsewhere,
    })
}

/// Time after which a new process shows its command line.
const STARTED: Duration = Duration::from_millis(500);

/// Stops rosout cleanly.
async fn end_rosout(roscore: &Roscore) {
    let pid = match roscore.rosout.load(Ordering::Relaxed) {
        // A rosout that an earlier rosrescue left running may not have been found yet.
        0 => block_in_place(|| Rosout::find(&roscore.checkpoint)?.find_orphan()),
        pid => Some(pid),
    };
    let Some(pid) = pid else { return };
    // A new process has no command line for a moment.
    let named = async {
        while process::is_alive(pid) && !process::runs(pid, "rosout") {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    };
    let _ = tokio::time::timeout(STARTED, named).await;
    if process::runs(pid, "rosout") {
        process::stop(pid, process::wait_until_ended(pid)).await;
    }
}
