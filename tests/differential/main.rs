//! Compares the model with real masters: both must answer random sequences of calls alike, have the same state, and
//! cause the same callbacks. A sequence is played in one of three ways:
//!
//! * with a bare rosmaster, whose state is injected into a fresh one on the way;
//! * through rosrescue with a rosmaster that is killed again and again, while the model never crashes;
//! * through several rosrescues on an etcd, whose leader is killed or hands over.
//!
//! `together.rs` has callers that do not take turns.
//!
//! A sequence that fails is shortened as far as possible and printed. On a busy computer a master may be late, or lose
//! its lead, without a step of the sequence. Callbacks then come in another order, or not at all. A sequence that fails
//! after such a disturbance is played again, and the disturbance is printed.
//!
//! The variables are:
//!
//! | variable | |
//! |---|---|
//! | `ROSRESCUE_SEQUENCES` | number of sequences with a bare rosmaster |
//! | `ROSRESCUE_CRASH_SEQUENCES` | number of sequences through rosrescue; every [`CORE_EACH`]th with `core` |
//! | `ROSRESCUE_TAKEOVER_SEQUENCES` | number through several computers; every [`THREE_EACH`]th through three |
//! | `ROSRESCUE_CALLS` | number of calls in each sequence |
//! | `ROSRESCUE_CRASHES` | number of crashes, or takeovers, in each sequence through rosrescue |
//! | `ROSRESCUE_SEED` | number of the first sequence; the others follow it |
//! | `ROSRESCUE_SCRIPT` | a file with a printed sequence, which is played instead of all others |

#![allow(
    clippy::expect_used,
    clippy::indexing_slicing,
    clippy::unwrap_used,
    reason = "a test fails by panicking"
)]

mod crashes;
mod dice;
mod direct;
mod nodes;
mod oracle;
mod real;
mod script;
mod shrinking;
mod stage;
#[path = "../support/mod.rs"]
mod support;
mod takeovers;
mod together;
mod unreturnable;

use std::io::Write;
use std::path::Path;
use std::time::{Duration, Instant};

use crashes::Tally;
use nodes::Node;
use real::Rosmaster;
use script::{Script, Step, shrink, simpler};
use stage::Failure;
use support::Servers;

const SEQUENCES: u64 = 30;
const CRASH_SEQUENCES: u64 = 12;
const TAKEOVER_SEQUENCES: u64 = 6;
const CALLS: u64 = 200;
/// Deaths of the master in each sequence.
const CRASHES: u64 = 5;
/// Deaths and handovers of the leader in each sequence.
const TAKEOVERS: u64 = 3;
/// Starting a core takes long, so only every sixth sequence uses one.
const CORE_EACH: u64 = 6;
/// The other sequences use two computers.
const THREE_EACH: u64 = 3;
/// No master hangs in these tests: a killed one closes its connections. One that gets no processor for some seconds
/// must not count as hung, because then rosrescue answers and notifies nodes in its place.
const NO_HANGS: [&str; 2] = ["--probe-timeout", "20000"];
/// Whether master or mirror answers reads; the mirror in two of three sequences.
const READS: [&str; 2] = ["master", "mirror"];
/// Number of nodes that receive callbacks.
const NODES: usize = 5;
/// Maximum number of runs for finding a shorter script.
const PATIENCE: usize = 300;
/// Longest time for finding a shorter script. One run with takeovers may take half a minute.
const SHRINKING: Duration = Duration::from_secs(120);

fn number(name: &str, default: u64) -> u64 {
    match std::env::var(name) {
        Ok(text) => text.parse().expect(name),
        Err(_) => default,
    }
}

/// The scripts to play before random sequences: all scripts that ever failed, or only the file in `ROSRESCUE_SCRIPT`.
fn scripts() -> (Vec<(String, Script)>, bool) {
    let read = |path: &Path| {
        let script = Script::parse(&std::fs::read_to_string(path).unwrap());
        (path.display().to_string(), script)
    };
    if let Ok(path) = std::env::var("ROSRESCUE_SCRIPT") {
        return (vec![read(Path::new(&path))], true);
    }
    let found = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/differential/found");
    let found = std::fs::read_dir(found).unwrap();
    (found.map(|it| read(&it.unwrap().path())).collect(), false)
}

fn nodes() -> Vec<Node> {
    (0..NODES).map(|_| Node::start()).collect()
}

/// Prints `text` at once, and not with the test's output.
fn say(text: &str) {
    drop(writeln!(std::io::stderr(), "{text}"));
}

/// Plays `script`. If that fails, searches for a shorter script that fails too, and panics.
fn play_or_shorten(
    what: &str,
    script: &Script,
    mut run: impl FnMut(&Script) -> Result<(), Failure>,
) {
    let Err(first) = run(script) else { return };
    // The search takes long.
    say(&format!(
        "{what} fails: {first}\n\n{}\nIt is being shortened, for at most {SHRINKING:?}.",
        script.print()
    ));
    let deadline = Instant::now() + SHRINKING;
    // A failure by timeout is not a shorter form of this failure.
    let is_late = |why: &Failure| why.contains("there is never");
    let late = is_late(&first);
    nodes::HURRIED.set(!late);
    let mut why = first;
    let steps = shrink(&script.steps, simpler, PATIENCE, |steps: &[Step]| {
        let steps = steps.to_vec();
        let shorter = Script { steps, ..*script };
        let failure = (Instant::now() < deadline).then(|| run(&shorter).err());
        let failure = failure.flatten().filter(|it| is_late(it) == late);
        let fails = failure.is_some();
        if let Some(failure) = failure {
            why = failure;
            say(&format!(
                "{what} fails with {} steps, too",
                shorter.steps.len()
            ));
        }
        fails
    });
    let shortest = Script { steps, ..*script };
    panic!(
        "{what} fails. Put this into a file, and its path into ROSRESCUE_SCRIPT:\n\n{}\n{why}",
        shortest.print()
    );
}

#[test]
fn a_bare_rosmaster_answers_as_the_model_does() {
    let nodes = nodes();
    let mut spare = Rosmaster::start();
    let (scripts, alone) = scripts();
    for (path, script) in &scripts {
        println!("{path}");
        direct::run(script, &nodes, &mut spare).unwrap();
    }
    if alone {
        return;
    }
    let calls = usize::try_from(number("ROSRESCUE_CALLS", CALLS)).unwrap();
    let first = number("ROSRESCUE_SEED", u64::from(std::process::id()) << 20);
    let count = number("ROSRESCUE_SEQUENCES", SEQUENCES);
    let (start, mut played) = (Instant::now(), 0);
    for seed in first..first + count {
        let script = direct::script(seed, calls, NODES);
        play_or_shorten(&format!("seed {seed}"), &script, |script| {
            direct::run(script, &nodes, &mut spare)
        });
        played += script.calls();
    }
    println!(
        "{count} sequences, {played} calls, seeds from {first}, {:?}",
        start.elapsed()
    );
}

#[test]
fn no_crash_of_the_master_is_visible_through_rosrescue() {
    let nodes = nodes();
    let mut tally = Tally::default();
    let (scripts, alone) = scripts();
    for (path, script) in &scripts {
        // A core differs in how its master dies and who starts the next one.
        let dies = |step: &Step| matches!(step, Step::Crash { .. } | Step::Away);
        let core = script.steps.iter().any(dies);
        for (core, reads) in [(false, READS[0]), (core, READS[1])] {
            println!("{path}, core: {core}, reads: {reads}");
            crashes::run(script, &nodes, core, reads, &mut tally).unwrap();
        }
    }
    if alone {
        return;
    }
    let calls = usize::try_from(number("ROSRESCUE_CALLS", CALLS)).unwrap();
    let crashes = usize::try_from(number("ROSRESCUE_CRASHES", CRASHES)).unwrap();
    let first = number("ROSRESCUE_SEED", u64::from(std::process::id()) << 20);
    let count = number("ROSRESCUE_CRASH_SEQUENCES", CRASH_SEQUENCES);
    let (start, mut played) = (Instant::now(), 0);
    for seed in first..first + count {
        let script = crashes::script(seed, calls, crashes, NODES);
        let core = seed % CORE_EACH == 0;
        let reads = READS[usize::from(seed % 3 > 0)];
        let what = format!(
            "seed {seed} with {crashes} crashes{}, --reads {reads}",
            if core { " of core" } else { "" }
        );
        play_or_shorten(&what, &script, |script| {
            crashes::run(script, &nodes, core, reads, &mut tally)
        });
        played += script.calls();
    }
    let Tally {
        sound,
        with_unreturnable,
        spared,
    } = tally;
    let spared: Vec<_> = spared.iter().map(ToString::to_string).collect();
    println!(
        "{count} sequences, {played} calls, crashes {sound:?}, with unreturnable values {with_unreturnable:?}, left out \
         {spared:?}, seeds from {first}, {:?}",
        start.elapsed()
    );
    // A test without crashes would prove nothing. A few sequences may have none by chance.
    if count * crashes as u64 >= 50 {
        assert!(sound.happened * 4 >= sound.asked * 3, "{sound:?}");
        assert!(with_unreturnable.happened > 0, "{with_unreturnable:?}");
    }
}

#[test]
fn no_takeover_is_visible_through_several_computers() {
    let nodes = nodes();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let servers = runtime.block_on(Servers::new(1));
    let mut tally = takeovers::Tally::default();
    let (scripts, alone) = scripts();
    for (path, script) in &scripts {
        println!("{path}");
        takeovers::run(script, &nodes, &servers, 2, &mut tally).unwrap();
    }
    if alone {
        return;
    }
    let calls = usize::try_from(number("ROSRESCUE_CALLS", CALLS)).unwrap();
    let takeovers = usize::try_from(number("ROSRESCUE_CRASHES", TAKEOVERS)).unwrap();
    let first = number("ROSRESCUE_SEED", u64::from(std::process::id()) << 20);
    let count = number("ROSRESCUE_TAKEOVER_SEQUENCES", TAKEOVER_SEQUENCES);
    let (start, mut played) = (Instant::now(), 0);
    for seed in first..first + count {
        let script = takeovers::script(seed, calls, takeovers, NODES);
        let computers = if seed % THREE_EACH == 0 { 3 } else { 2 };
        let what = format!("seed {seed} with {takeovers} takeovers of {computers} computers");
        play_or_shorten(&what, &script, |script| {
            takeovers::run(script, &nodes, &servers, computers, &mut tally)
        });
        played += script.calls();
    }
    println!(
        "{count} sequences, {played} calls, {tally:?}, seeds from {first}, {:?}",
        start.elapsed()
    );
    // A test without takeovers would prove nothing. A few sequences may have none by chance: while there is a value
    // that a master cannot return, no computer is stopped.
    if count * takeovers as u64 >= 24 {
        assert!(tally.deaths.happened * 4 >= tally.deaths.asked, "{tally:?}");
        assert!(tally.handovers.happened > 0, "{tally:?}");
    }
}
