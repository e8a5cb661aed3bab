//! Merges the writes of random partitions. Leaders are replaced, forget changes, and lose answers.

use super::super::{
    Changes, MergeVerdict, WritesToSend,
    changes::{param_of, value_at},
    judge_write, merge,
    wire::{MergeAnswer, WriteOutcome},
};
use ros1_master::{
    master::{Master, Method, Request, is_success, names},
    xmlrpc::{Reply, Struct, Value},
};

const KEYS: [&str; 7] = ["/a", "/a/b", "/a/b/c", "/a/d", "/e", "/e/f", "/g"];

/// A random number generator (xorshift64*).
struct Dice(u64);

impl Dice {
    fn below(&mut self, most: usize) -> usize {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        let high = self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 33;
        usize::try_from(high).unwrap() % most
    }

    fn one_in(&mut self, of: usize) -> bool {
        self.below(of) == 0
    }

    fn write(&mut self, caller: &str, number: &mut i32) -> Request {
        let key = KEYS[self.below(KEYS.len())];
        if self.one_in(5) {
            return Request::new(Method::DeleteParam, [caller, key]);
        }
        *number += 1;
        // Small numbers make both sides write the same value by chance.
        let value = match self.below(6) {
            0 => Value::Struct(Struct::from([("b".to_owned(), (*number).into())])),
            1 => Value::Int(1),
            _ => Value::Int(*number),
        };
        Request::new(Method::SetParam, [caller.into(), key.into(), value])
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum By {
    Others,
    Lonely,
}

/// The other computers: their journal and their state.
#[derive(Default)]
struct There {
    state: Master,
    journal: Vec<(By, Request)>,
    /// The leader knows the changes after this record.
    known: usize,
}

impl There {
    fn run(&mut self, by: By, call: &Request) -> Reply {
        let reply = self.state.apply_telling(call, &mut ());
        if is_success(&reply) {
            self.journal.push((by, call.clone()));
        }
        reply
    }

    /// Makes a portion of writes as the write queue does.
    fn merge(&mut self, seq: usize, calls: &[Request]) -> MergeAnswer {
        if seq < self.known {
            return MergeAnswer::Again;
        }
        let mut changes = Changes::default();
        for (by, call) in &self.journal[seq..] {
            if *by == By::Others {
                changes.note(0, call);
            }
        }
        let verdicts: Vec<_> = calls
            .iter()
            .map(|call| judge_write(&changes, &self.state, call))
            .collect();
        let runs = verdicts.iter().zip(calls);
        let runs = runs.filter(|(verdict, _)| **verdict == MergeVerdict::Apply);
        let runs: Vec<_> = runs.map(|(_, call)| call.clone()).collect();
        let results = runs.iter().map(|call| match self.run(By::Lonely, call) {
            Reply::Value(value) => Value::Array(vec![value]),
            fault @ Reply::Fault { .. } => panic!("{fault:?}"),
        });
        let results = results.collect::<Vec<_>>();
        MergeAnswer::from_reply(&verdicts, &Reply::Value(results.into()))
    }
}

fn related(one: &Request, other: &Request) -> bool {
    let (one, other) = (param_of(one).unwrap(), param_of(other).unwrap());
    one.starts_with(&other) || other.starts_with(&one)
}

/// The values at and below `key`, whatever their order.
fn leaves(state: &Master, key: &str) -> Vec<String> {
    fn collect(path: &str, value: &Value, found: &mut Vec<String>) {
        match value {
            Value::Struct(members) if !members.is_empty() => {
                for (name, value) in members {
                    collect(&format!("{path}/{name}"), value, found);
                }
            }
            value => found.push(format!("{path} {value:?}")),
        }
    }
    let parts: Vec<&str> = names::parts(key).collect();
    let mut found = Vec::new();
    if let Some(value) = value_at(state.params(), &parts) {
        collect(key, value, &mut found);
    }
    found.sort();
    found
}

#[derive(Debug, Default)]
struct Counts {
    held: usize,
    lost: usize,
    again: usize,
    unanswered: usize,
    refused: usize,
}

fn play(seed: u64, counts: &mut Counts) {
    let mut dice = Dice(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1);
    let (mut theirs, mut ours) = (1000, 2000);
    let mut there = There::default();
    for _ in 0..dice.below(6) {
        let write = dice.write("/there", &mut theirs);
        there.run(By::Others, &write);
    }
    let base = there.journal.len();
    let mut here = there.state.clone();
    let (mut changes, mut pending, mut written) =
        (Changes::default(), WritesToSend::default(), vec![]);
    // One write was on its way when the connection was cut.
    let first = dice.write("/here", &mut ours);
    if dice.one_in(2) {
        changes.expect([first.clone()]);
        if dice.one_in(2) {
            there.run(By::Lonely, &first);
        }
        if is_success(&here.apply_telling(&first, &mut ())) {
            pending.add(&first);
            written.push(first);
        }
    }
    for _ in 0..dice.below(12) {
        let write = dice.write("/here", &mut ours);
        if is_success(&here.apply_telling(&write, &mut ())) {
            pending.add(&write);
            written.push(write);
        }
    }
    for _ in 0..dice.below(4) {
        let write = dice.write("/there", &mut theirs);
        there.run(By::Others, &write);
    }
    assert!(pending.len() <= 2 * KEYS.len(), "seed {seed}");
    // The network works again.
    let all: Vec<Request> = pending.calls().cloned().collect();
    let (mut left, mut read) = (all.clone(), base);
    let (mut present, mut reported, mut held) = (Master::default(), vec![], vec![]);
    for (_, call) in &there.journal[..base] {
        present.apply_telling(call, &mut ());
    }
    while !left.is_empty() {
        for (_, call) in &there.journal[read..] {
            changes.note(0, call);
            present.apply_telling(call, &mut ());
        }
        read = there.journal.len();
        let merged = merge(&changes, &present, &left);
        reported.extend(merged.lost.into_iter().map(|lost| lost.call));
        left = merged.send;
        while !left.is_empty() {
            if dice.one_in(2) {
                let write = dice.write("/there", &mut theirs);
                there.run(By::Others, &write);
            }
            if dice.one_in(8) {
                // Another computer leads now, or the leader has forgotten older changes.
                there.known = there.journal.len();
            }
            let count = (1 + dice.below(3)).min(left.len());
            let portion = left[..count].to_vec();
            changes.expect(portion.iter().cloned());
            let answer = there.merge(read, &portion);
            if dice.one_in(6) {
                counts.unanswered += 1;
                continue;
            }
            let MergeAnswer::Done(outcomes) = answer else {
                counts.again += 1;
                break;
            };
            for (call, outcome) in portion.iter().zip(outcomes) {
                match outcome {
                    WriteOutcome::Holds => held.push(call.clone()),
                    WriteOutcome::Lost { .. } => reported.push(call.clone()),
                    WriteOutcome::Refused(_) if *call.method() == Method::DeleteParam => {
                        counts.refused += 1;
                    }
                    WriteOutcome::Refused(why) => panic!("seed {seed}: {why}"),
                }
            }
            left.drain(..count);
        }
    }
    counts.held += held.len();
    counts.lost += reported.len();
    let others = |from: usize, to: usize| {
        let part = there.journal[from..to].iter();
        part.filter(|(by, _)| *by == By::Others)
            .map(|(_, call)| call)
    };
    // No write of this computer replaces a change by others that this computer had not seen.
    for (at, (_, call)) in there.journal.iter().enumerate().skip(base) {
        if all.contains(call) && there.journal[at].0 == By::Lonely {
            let unseen = others(base, at).find(|of| related(of, call));
            // The write that was on its way ran before all of the others' changes.
            let was_first = at == base;
            assert!(
                unseen.is_none() || was_first,
                "seed {seed}: {call:?} replaces {unseen:?}"
            );
        }
    }
    let end = there.journal.len();
    for (at, call) in all.iter().enumerate() {
        let is_deleted = all[at + 1..].iter().any(|of| {
            let (path, of_path) = (param_of(call).unwrap(), param_of(of).unwrap());
            *of.method() == Method::DeleteParam && path.starts_with(&of_path)
        });
        if is_deleted {
            continue;
        }
        // Each write is in the journal or is reported, unless others have set the same value or have deleted the
        // parameter, too.
        let contested = others(base, end).any(|of| related(of, call));
        let is_reported = reported.contains(call);
        assert!(contested || !is_reported, "seed {seed}: {call:?} is lost");
        let ran = there.journal[base..]
            .iter()
            .any(|(by, of)| *by == By::Lonely && of == call);
        assert!(
            ran || is_reported || contested || *call.method() == Method::DeleteParam,
            "seed {seed}: {call:?} has vanished"
        );
        if contested && !ran && !is_reported {
            let wanted = call.params().get(2).cloned();
            let was_so = others(base, end).any(|of| of.params().get(2).cloned() == wanted)
                || *call.method() == Method::DeleteParam
                || others(base, end).any(|of| matches!(of.params().get(2), Some(Value::Struct(_))));
            assert!(was_so, "seed {seed}: {call:?} was lost without a word");
        }
    }
    // Parameters that no other computer has written have this computer's values.
    for key in KEYS {
        let this = Request::new(Method::DeleteParam, ["/here", key]);
        let about = written.iter().filter(|call| related(call, &this));
        let touched = others(base, end).any(|of| related(of, &this));
        let contested = about
            .clone()
            .any(|call| others(base, end).any(|of| related(of, call)));
        if !touched && !contested && about.count() > 0 {
            let [ours, theirs] = [&here, &there.state].map(|state| leaves(state, key));
            assert_eq!(ours, theirs, "seed {seed}: {key}");
        }
    }
}

#[test]
fn others_win_each_loss_is_reported_and_the_rest_holds() {
    let seeds = match std::env::var("ROSRESCUE_SEED") {
        Ok(seed) => {
            let seed = seed.parse().unwrap();
            seed..seed + 1
        }
        Err(_) => 1..4000,
    };
    let mut counts = Counts::default();
    for seed in seeds.clone() {
        play(seed, &mut counts);
    }
    println!("{counts:?}");
    // With fewer events the schedules would test nothing.
    let Counts {
        held,
        lost,
        again,
        unanswered,
        refused,
    } = counts;
    let all = [held, lost, again, unanswered, refused];
    assert!(
        seeds.end - seeds.start == 1 || all.iter().all(|count| *count > 20),
        "{all:?}"
    );
}
