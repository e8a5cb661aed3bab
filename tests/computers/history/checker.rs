//! Checks a recorded history against the promises. Times are microseconds from the start.
//!
//! * The final state has each acknowledged write, or a later one. The exception is a write that a computer acknowledged
//!   while it was cut off: it may lose against others' writes, and then a warning names both values. If the computer
//!   started again and reached no other computer's node, it may be in a file, and a warning names the file.
//! * On one computer no read goes back, and none misses a write that was acknowledged there before, except while the
//!   computer is cut off. The value of a write that was not acknowledged may disappear again.
//! * Each value that is read was written.
//! * The last notification of a subscriber has the value in the final state.
//! * No two computers lead at the same time, and no two in the same term.
//!
//! A write is later than another one if it began after that one was acknowledged. Of two writes that overlap, either
//! may be the last. A write that failed may take effect at any time.

use std::collections::BTreeMap;

/// Microseconds from the start of a history.
pub(crate) type Time = u64;

/// The value of a parameter. Each value is written once. `None` if the parameter is not set.
pub(crate) type Value = Option<i32>;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum What {
    Write(i32),
    Read(Value),
}

/// A call of a client. Reads that failed are not recorded.
#[derive(Clone, Debug)]
pub(crate) struct Op {
    pub(crate) computer: usize,
    pub(crate) key: String,
    pub(crate) what: What,
    pub(crate) start: Time,
    /// When the call was answered. `None` if it failed.
    pub(crate) end: Option<Time>,
}

/// A warning about a write that is lost or in a file. This computer acknowledged it while it was cut off.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Loss {
    pub(crate) computer: usize,
    pub(crate) key: String,
    pub(crate) value: i32,
}

/// The role that a computer reported at some time between `from` and `to`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Sample {
    pub(crate) computer: usize,
    pub(crate) from: Time,
    pub(crate) to: Time,
    pub(crate) says: Says,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Says {
    Alone,
    /// The computer leads, and calls pass to its master. The term, if it is known.
    Leads(Option<u64>),
    /// Any other role.
    Other,
}

/// The value in a subscriber's last notification of a parameter. `None` without a notification.
#[derive(Clone, Debug)]
pub(crate) struct Told {
    pub(crate) subscriber: String,
    pub(crate) key: String,
    pub(crate) value: Value,
    /// Its last notifications, for the report.
    pub(crate) trail: String,
}

#[derive(Clone, Debug, Default)]
pub(crate) struct History {
    pub(crate) ops: Vec<Op>,
    pub(crate) losses: Vec<Loss>,
    pub(crate) samples: Vec<Sample>,
    /// When older copies of all etcds were restored. What a leader had shown on a computer before may reach it only with
    /// the new journal.
    pub(crate) restored: Vec<Time>,
}

/// The final state, on which all computers agree.
#[derive(Clone, Debug, Default)]
pub(crate) struct End {
    pub(crate) values: BTreeMap<String, i32>,
    pub(crate) told: Vec<Told>,
}

/// A computer may have been cut off this long before the first sample that says so, and after the last one.
const ALONE_SLACK: Time = 500_000;

/// How long after a computer has begun to lead a sample may say so: its page says it once calls pass to its master.
const LEADS_SLACK: Time = 1_000_000;

/// Between two samples this close together, a leader cannot have been paused and deposed.
const CLOSE: Time = 400_000;

/// Describes each broken promise in a sentence.
pub(crate) fn violations(history: &History, end: &End) -> Vec<String> {
    let judge = Judge::new(history);
    let keys = judge.writes_by_key();
    let mut wrong = Vec::new();
    for (key, writes) in &keys {
        wrong.extend(judge.lost(key, writes, end));
        wrong.extend(judge.reads(key, writes));
    }
    wrong.extend(told(end));
    wrong.extend(leaders(&history.samples));
    wrong
}

/// A write that later reads on the same computer must show, and the time from which they must.
type Floor<'a> = (Time, &'a Op);

/// A write and what is known about it.
#[derive(Clone, Copy, Debug)]
struct Write<'a> {
    op: &'a Op,
    value: i32,
    /// Whether the computer may have been cut off when it acknowledged the write.
    alone: bool,
    /// Whether the final state may lack the write.
    excused: bool,
}

impl Write<'_> {
    /// Whether this write was acknowledged before `other` began.
    fn is_before(&self, other: &Write<'_>) -> bool {
        self.op.end.is_some_and(|end| end < other.op.start)
    }
}

struct Judge<'a> {
    history: &'a History,
}

impl<'a> Judge<'a> {
    fn new(history: &'a History) -> Self {
        Self { history }
    }

    fn is_alone(&self, op: &Op) -> bool {
        let to = op.end.unwrap_or(op.start) + ALONE_SLACK;
        let from = op.start.saturating_sub(ALONE_SLACK);
        let mut samples = self.history.samples.iter();
        samples.any(|it| {
            it.computer == op.computer && it.says == Says::Alone && it.from <= to && it.to >= from
        })
    }

    /// Whether computers led in different terms between these times.
    fn takeover_in(&self, from: Time, to: Time) -> bool {
        let samples = self.history.samples.iter();
        let between = samples.filter(|it| it.from <= to && it.to >= from);
        let mut leaders = between.filter_map(|it| match it.says {
            Says::Leads(term) => Some((it.computer, term)),
            _ => None,
        });
        let first = leaders.next();
        leaders.any(|leader| Some(leader) != first)
    }

    fn writes_by_key(&self) -> BTreeMap<&'a str, Vec<Write<'a>>> {
        let mut keys: BTreeMap<&str, Vec<Write<'_>>> = BTreeMap::new();
        for op in &self.history.ops {
            let writes = keys.entry(op.key.as_str()).or_default();
            if let What::Write(value) = op.what {
                let alone = op.end.is_some() && self.is_alone(op);
                let excused = alone && self.is_reported(op, value);
                writes.push(Write {
                    op,
                    value,
                    alone,
                    excused,
                });
            }
        }
        for writes in keys.values_mut() {
            excuse_replaced(writes);
        }
        keys
    }

    fn is_reported(&self, op: &Op, value: i32) -> bool {
        let mut losses = self.history.losses.iter();
        losses.any(|it| it.computer == op.computer && it.key == op.key && it.value == value)
    }

    /// Acknowledged writes that are missing in the final state, and are not older than the write that is there.
    fn lost(&self, key: &str, writes: &[Write<'_>], end: &End) -> Vec<String> {
        let last = match end.values.get(key) {
            None => None,
            Some(value) => match writes.iter().find(|it| it.value == *value) {
                None => return vec![format!("{key} is {value} in the end, which nobody wrote")],
                last => last,
            },
        };
        let is_lost = |it: &&Write<'_>| {
            it.op.end.is_some() && !it.excused && last.is_none_or(|last| last.is_before(it))
        };
        let lost: Vec<_> = writes.iter().filter(is_lost).collect();
        let Some(first) = lost.first() else {
            return Vec::new();
        };
        let alone = if first.alone { ", alone" } else { "" };
        vec![format!(
            "{} acknowledged writes of {key} are lost; the first{alone}: {:?}; in the end there is {:?}",
            lost.len(),
            first.op,
            last.map(|it| it.op)
        )]
    }

    /// Reads that return an older value than one that their computer had shown or acknowledged before.
    fn reads(&self, key: &str, writes: &[Write<'_>]) -> Vec<String> {
        let mut wrong = Vec::new();
        let by_value: BTreeMap<i32, &Write<'_>> = writes.iter().map(|it| (it.value, it)).collect();
        // By computer: from this time on, no read may be older than this write.
        let mut floors: BTreeMap<usize, Vec<(Time, &Op)>> = BTreeMap::new();
        let mut reads = Vec::new();
        for op in self.history.ops.iter().filter(|op| op.key == key) {
            let (Some(end), false) = (op.end, self.is_alone(op)) else {
                continue;
            };
            if let What::Read(value) = op.what {
                let write = value.map(|value| by_value.get(&value).copied());
                match write {
                    Some(None) => {
                        wrong.push(format!("{key}: nobody wrote what {op:?} has found"));
                        continue;
                    }
                    Some(Some(write)) if write.op.start > end => {
                        wrong.push(format!("{op:?} has found what was written later"));
                        continue;
                    }
                    _ => {}
                }
                let write = write.flatten();
                reads.push((op, write));
                // A leader may have shown a write that etcd never got, and the writer's computer acknowledged it later,
                // while it was cut off. The others get such a write with the merge.
                let elsewhere = |it: &&Write<'_>| it.alone && it.op.computer != op.computer;
                // The next leader may lack a write that the previous one showed before it was acknowledged, until its
                // computer sends it again. The last sample of the previous leader may be older than the read.
                let lost_for_a_while = |it: &&Write<'_>| {
                    let acknowledged = it.op.end.filter(|acknowledged| *acknowledged > end);
                    let from = op.start.saturating_sub(CLOSE);
                    acknowledged.is_some_and(|until| self.takeover_in(from, until + LEADS_SLACK))
                };
                let counts =
                    |it: &&Write<'_>| !it.excused && !elsewhere(it) && !lost_for_a_while(it);
                if let Some(write) = write.filter(counts)
                    && let Some(acknowledged) = write.op.end
                {
                    let floor = (end.max(acknowledged), write.op);
                    floors.entry(op.computer).or_default().push(floor);
                }
            }
        }
        for write in writes.iter().filter(|it| !it.excused) {
            if let Some(end) = write.op.end {
                let floor = (end, write.op);
                floors.entry(write.op.computer).or_default().push(floor);
            }
        }
        floors.values_mut().for_each(|of| of.sort_by_key(|it| it.0));
        reads.sort_by_key(|(op, _)| op.start);
        // Per computer, how many floors have been looked at, and the highest one.
        let mut at = BTreeMap::<usize, (usize, Option<Floor<'_>>)>::new();
        for (op, write) in reads {
            let Some(floors) = floors.get(&op.computer) else {
                continue;
            };
            let restored = self.history.restored.iter().rev();
            let restored = restored.copied().find(|at| *at < op.start).unwrap_or(0);
            let (next, floor) = at.entry(op.computer).or_default();
            *floor = floor.filter(|(from, _)| *from >= restored);
            while let Some((from, of)) = floors.get(*next).filter(|it| it.0 < op.start) {
                if *from >= restored && floor.is_none_or(|(_, floor)| floor.start < of.start) {
                    *floor = Some((*from, of));
                }
                *next += 1;
            }
            let is_older = |floor: &&Op| match write {
                None => true,
                Some(write) => write.op.end.is_some_and(|end| end < floor.start),
            };
            if let Some(floor) = floor.map(|(_, floor)| floor).filter(is_older) {
                wrong.push(format!("{op:?} goes back behind {floor:?}"));
            }
        }
        wrong
    }
}

/// Of the writes that a computer acknowledged while it was cut off, only the last one must hold or be reported.
fn excuse_replaced(writes: &mut [Write<'_>]) {
    let alone: Vec<Write<'_>> = writes.iter().filter(|it| it.alone).copied().collect();
    for write in writes.iter_mut().filter(|it| it.alone) {
        let mut later = alone.iter();
        write.excused |= later
            .any(|it| it.op.computer == write.op.computer && write.is_before(it) && it.excused);
    }
}

fn told(end: &End) -> Vec<String> {
    let wrong = end.told.iter().filter_map(|told| {
        let last = end.values.get(&told.key).copied();
        let Told {
            subscriber,
            key,
            value,
            trail,
        } = told;
        (*value != last).then(|| {
            format!("{subscriber} was told that {key} is {value:?}, and in the end it is {last:?}: {trail}")
        })
    });
    wrong.collect()
}

/// Pairs of computers that lead at the same time, or in the same term.
fn leaders(samples: &[Sample]) -> Vec<String> {
    let mut spans: Vec<(usize, Time, Time)> = Vec::new();
    let mut before: BTreeMap<usize, &Sample> = BTreeMap::new();
    let mut terms: BTreeMap<u64, usize> = BTreeMap::new();
    let mut wrong = Vec::new();
    for sample in samples {
        let last = before.insert(sample.computer, sample);
        let Says::Leads(term) = sample.says else {
            continue;
        };
        if let Some(term) = term {
            let first = *terms.entry(term).or_insert(sample.computer);
            if first != sample.computer {
                wrong.push(format!("{sample:?} leads in the term of {first}"));
            }
        }
        if let Some(last) = last
            && matches!(last.says, Says::Leads(_))
            && sample.to - last.from < CLOSE
        {
            spans.push((sample.computer, last.to, sample.from));
        }
    }
    spans.sort_by_key(|span| span.1);
    let mut latest: Option<(usize, Time, Time)> = None;
    for span in spans {
        if let Some(latest) = latest
            && latest.0 != span.0
            && span.1 < latest.2
        {
            wrong.push(format!(
                "two lead at once: {} from {} to {}, {} from {} to {}",
                latest.0, latest.1, latest.2, span.0, span.1, span.2
            ));
        }
        if latest.is_none_or(|latest| latest.2 < span.2) {
            latest = Some(span);
        }
    }
    wrong
}

#[cfg(test)]
mod tests {
    use super::*;

    const KEY: &str = "/k";

    fn write(computer: usize, value: i32, start: Time, end: impl Into<Option<Time>>) -> Op {
        op(computer, What::Write(value), start, end.into())
    }

    fn read(computer: usize, value: impl Into<Value>, start: Time, end: Time) -> Op {
        op(computer, What::Read(value.into()), start, Some(end))
    }

    fn op(computer: usize, what: What, start: Time, end: Option<Time>) -> Op {
        let key = KEY.to_owned();
        Op {
            computer,
            key,
            what,
            start,
            end,
        }
    }

    fn says(computer: usize, from: Time, to: Time, says: Says) -> Sample {
        Sample {
            computer,
            from,
            to,
            says,
        }
    }

    /// The broken promises if the parameter has the value `end` finally. Computer 2 is cut off from second 10 to 20.
    fn judge(ops: &[Op], losses: &[(usize, i32)], end: Value) -> Vec<String> {
        let losses = losses.iter().map(|(computer, value)| Loss {
            computer: *computer,
            key: KEY.to_owned(),
            value: *value,
        });
        let history = History {
            ops: ops.to_vec(),
            losses: losses.collect(),
            samples: vec![says(2, 10 * S, 20 * S, Says::Alone)],
            restored: Vec::new(),
        };
        let values = end.map(|value| (KEY.to_owned(), value)).into_iter();
        let end = End {
            values: values.collect(),
            told: Vec::new(),
        };
        violations(&history, &end)
    }

    #[track_caller]
    fn good(ops: &[Op], losses: &[(usize, i32)], end: Value) {
        assert_eq!(judge(ops, losses, end), <[String; 0]>::default());
    }

    #[track_caller]
    fn bad(ops: &[Op], losses: &[(usize, i32)], end: Value, word: &str) {
        let wrong = judge(ops, losses, end);
        assert!(wrong.len() == 1 && wrong[0].contains(word), "{wrong:?}");
    }

    /// A second.
    const S: Time = 1_000_000;

    #[test]
    fn the_last_acknowledged_write_is_there_or_one_that_overlaps_it() {
        let one_by_one = [write(0, 1, 1, 2), write(1, 2, 3, 4)];
        good(&one_by_one, &[], Some(2));
        bad(&one_by_one, &[], Some(1), "lost");
        bad(&one_by_one, &[], None, "lost");
        let overlapping = [write(0, 1, 1, 4), write(1, 2, 2, 3)];
        good(&overlapping, &[], Some(1));
        good(&overlapping, &[], Some(2));
        bad(&overlapping, &[], None, "2 acknowledged writes");
        bad(&overlapping, &[], Some(3), "nobody wrote");
        good(&[], &[], None);
    }

    #[test]
    fn a_write_that_failed_may_be_there_or_not_and_at_any_time() {
        let ops = [write(0, 1, 1, 2), write(1, 2, 3, None), write(0, 3, 5, 6)];
        good(&ops, &[], Some(2));
        good(&ops, &[], Some(3));
        bad(&ops, &[], Some(1), "lost");
    }

    #[test]
    fn only_a_write_made_while_cut_off_may_be_lost_and_only_if_it_is_reported() {
        let others = write(0, 1, 12 * S, 13 * S);
        let alone =
            [14, 15, 16].map(|second| write(2, second, second as Time * S, second as Time * S + 1));
        let ops = [&[others.clone()][..], &alone].concat();
        bad(&ops, &[], Some(1), "3 acknowledged writes");
        good(&ops, &[(2, 16)], Some(1));
        bad(&ops, &[(2, 15)], Some(1), "the first, alone");
        bad(&ops, &[(0, 16)], Some(1), "lost");
        good(&ops, &[], Some(16));
        let ops = [write(1, 1, S, 2 * S), write(0, 2, 3 * S, 4 * S)];
        bad(&ops, &[(0, 2)], Some(1), "lost");
    }

    #[test]
    fn no_read_of_a_computer_goes_back() {
        let writes = [write(0, 1, 1, 2), write(0, 2, 3, 4)];
        let with = |reads: &[Op]| [&writes[..], reads].concat();
        good(&with(&[read(1, 1, 5, 6), read(1, 2, 7, 8)]), &[], Some(2));
        bad(
            &with(&[read(1, 2, 5, 6), read(1, 1, 7, 8)]),
            &[],
            Some(2),
            "goes back",
        );
        bad(
            &with(&[read(1, 1, 5, 6), read(1, None, 7, 8)]),
            &[],
            Some(2),
            "goes back",
        );
        // Two reads at the same time, and reads on two computers.
        good(&with(&[read(1, 2, 5, 7), read(1, 1, 6, 8)]), &[], Some(2));
        good(&with(&[read(1, 2, 5, 6), read(2, 1, 7, 8)]), &[], Some(2));
        bad(&with(&[read(1, 9, 5, 6)]), &[], Some(2), "nobody wrote");
        let early = [write(0, 1, 7, 8), read(1, 1, 5, 6)];
        bad(&early, &[], Some(1), "written later");
        // A write that was not acknowledged may disappear.
        let failed = [
            write(0, 1, 1, 2),
            write(0, 2, 3, None),
            read(1, 2, 4, 5),
            read(1, 1, 6, 7),
        ];
        good(&failed, &[], Some(1));
        let late = [
            write(0, 1, 1, 2),
            write(0, 2, 3, 9),
            read(1, 2, 4, 5),
            read(1, 1, 6, 7),
        ];
        good(&late, &[], Some(2));
    }

    #[test]
    fn a_caller_sees_its_own_acknowledged_writes() {
        let ops = |reader| [write(0, 1, 1, 2), write(0, 2, 3, 4), read(reader, 1, 5, 6)];
        bad(&ops(0), &[], Some(2), "goes back");
        good(&ops(1), &[], Some(2));
    }

    #[test]
    fn reads_may_go_back_once_when_an_older_copy_of_etcd_is_restored() {
        let ops = [
            write(0, 1, 1, 2),
            write(0, 2, 3, 4),
            read(1, 2, S, S + 1),
            read(1, 1, 3 * S, 3 * S + 1),
        ];
        let checked = |ops: &[Op], restored| {
            let history = History {
                ops: ops.to_vec(),
                restored: vec![restored],
                ..History::default()
            };
            let end = End {
                values: BTreeMap::from([(KEY.to_owned(), 2)]),
                told: Vec::new(),
            };
            violations(&history, &end)
        };
        assert_eq!(checked(&ops, 2 * S), <[String; 0]>::default());
        for restored in [S / 2, 4 * S] {
            assert!(checked(&ops, restored)[0].contains("goes back"));
        }
        let again = [read(1, 2, 4 * S, 4 * S + 1), read(1, 1, 5 * S, 5 * S + 1)];
        assert!(checked(&[&ops[..], &again].concat(), 2 * S)[0].contains("goes back"));
    }

    #[test]
    fn a_computer_that_is_cut_off_has_its_own_history() {
        let others = [write(0, 1, S, 2 * S), write(0, 2, 11 * S, 12 * S)];
        let alone = [
            read(2, 1, 13 * S, 13 * S + 1),
            write(2, 3, 14 * S, 14 * S + 1),
        ];
        let with = |reads: &[Op]| [&others[..], &alone, reads].concat();
        good(&with(&[read(2, 3, 15 * S, 15 * S + 1)]), &[], Some(3));
        good(&with(&[read(2, 2, 25 * S, 25 * S + 1)]), &[(2, 3)], Some(2));
        // The write holds, so no later read may miss it.
        bad(
            &with(&[read(2, 2, 25 * S, 25 * S + 1)]),
            &[],
            Some(3),
            "goes back",
        );
        // A leader had shown the write before, and the others lack it until the merge.
        let shown = [
            read(0, 3, 14 * S, 14 * S + 1),
            read(0, 2, 15 * S, 15 * S + 1),
        ];
        good(&with(&shown), &[], Some(3));
        // Reads from before the computer was cut off count afterwards.
        let before = [
            write(0, 1, 1, 2),
            write(0, 2, 3, 4),
            read(2, 2, 5, 6),
            read(2, 1, 25 * S, 25 * S + 1),
        ];
        bad(&before, &[], Some(2), "goes back");
    }

    #[test]
    fn the_next_leader_may_lack_for_a_while_what_the_previous_one_showed_early() {
        let ops = [
            write(0, 1, 1, 2),
            write(0, 2, S, 3 * S),
            read(1, 2, 2 * S, 2 * S + 1),
            read(1, 1, 4 * S, 4 * S + 1),
        ];
        bad(&ops, &[], Some(2), "goes back");
        let leads = |computer, at, term| says(computer, at, at + 1, Says::Leads(Some(term)));
        let end = End {
            values: BTreeMap::from([(KEY.to_owned(), 2)]),
            told: Vec::new(),
        };
        // The next leader may answer before a sample says that it leads.
        for (sample, excused) in [(5 * S / 2, true), (3 * S + S / 2, true), (5 * S, false)] {
            let history = History {
                ops: ops.to_vec(),
                samples: vec![leads(1, 2 * S - CLOSE / 2, 1), leads(0, sample, 2)],
                ..History::default()
            };
            assert_eq!(violations(&history, &end).is_empty(), excused);
        }
    }

    #[test]
    fn the_last_notification_has_the_final_value() {
        let told = |value: Value| Told {
            subscriber: "/s".to_owned(),
            key: KEY.to_owned(),
            value,
            trail: String::new(),
        };
        let end = |value| End {
            values: BTreeMap::from([(KEY.to_owned(), 2)]),
            told: vec![told(value)],
        };
        let history = History {
            ops: vec![write(0, 2, 1, 2)],
            ..History::default()
        };
        assert!(violations(&history, &end(Some(2))).is_empty());
        assert_eq!(violations(&history, &end(Some(1))).len(), 1);
        assert_eq!(violations(&history, &end(None)).len(), 1);
    }

    #[test]
    fn no_two_computers_lead_at_once() {
        let ms = 1000;
        let leads = |computer, term, at: Time| {
            says(computer, at * ms, (at + 10) * ms, Says::Leads(Some(term)))
        };
        let one_by_one = [
            leads(0, 1, 0),
            leads(0, 1, 50),
            says(0, 100 * ms, 110 * ms, Says::Other),
            leads(1, 2, 100),
            leads(1, 2, 150),
        ];
        assert_eq!(leaders(&one_by_one), <[String; 0]>::default());
        let both = [
            leads(0, 1, 0),
            leads(1, 2, 20),
            leads(0, 1, 50),
            leads(1, 2, 60),
            leads(0, 1, 100),
        ];
        assert!(leaders(&both)[0].contains("at once"));
        // Computer 0 was paused between its samples, and another one led.
        let stopped = [
            leads(0, 1, 0),
            leads(1, 2, 2500),
            leads(1, 2, 2550),
            leads(0, 1, 3000),
        ];
        assert_eq!(leaders(&stopped), <[String; 0]>::default());
        let same_term = [leads(0, 1, 0), leads(1, 1, 500)];
        assert!(leaders(&same_term)[0].contains("the term of 0"));
    }
}
