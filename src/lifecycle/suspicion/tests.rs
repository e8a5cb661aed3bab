//! Masters that die in every way, on a virtual clock.

use proptest::prelude::*;

use super::*;
use crate::{
    master::{Careful, Mark, Master, Plan},
    xmlrpc::{Struct, Value, decode_call},
};

/// What a master counts.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Counted {
    Calls,
    Changes,
    Registrations,
    Method(&'static str),
}

/// What a master dies of.
#[derive(Clone, Debug)]
enum Sickness {
    /// Each of these calls, and a tree of parameters that holds one of them.
    Poison(Vec<Call>),
    /// The call of this number, whatever it is.
    Count(Counted, usize),
    /// Its age, not the same in each life.
    Age([Duration; 4]),
    /// A call in each life, by its number.
    Chance(Vec<usize>),
    Healthy,
}

const CALL_TIME: Duration = Duration::from_micros(200);

/// One life of a master.
struct Life<'a> {
    sickness: &'a Sickness,
    number: usize,
    age: Duration,
    made: Vec<Call>,
}

impl Life<'_> {
    /// Whether the master survives the call.
    fn survives(&mut self, call: &Call) -> bool {
        self.age += CALL_TIME;
        let registration = |call: &Call| call.method.starts_with("register");
        let changes = |call: &Call| {
            ["register", "setParam", "subscribeParam"]
                .iter()
                .any(|start| call.method.starts_with(start))
        };
        self.made.push(call.clone());
        let counted = |counts: &dyn Fn(&Call) -> bool| {
            if counts(call) {
                self.made.iter().filter(|call| counts(call)).count()
            } else {
                0
            }
        };
        !match self.sickness {
            Sickness::Poison(records) => records.iter().any(|record| holds(call, record)),
            Sickness::Count(Counted::Calls, most) => self.made.len() == *most,
            Sickness::Count(Counted::Changes, most) => counted(&changes) == *most,
            Sickness::Count(Counted::Registrations, most) => counted(&registration) == *most,
            Sickness::Count(Counted::Method(name), most) => {
                counted(&|call| call.method == *name) == *most
            }
            Sickness::Age(most) => self.age >= most[self.number % most.len()],
            Sickness::Chance(numbers) => numbers.get(self.number) == Some(&self.made.len()),
            Sickness::Healthy => false,
        }
    }
}

/// Whether a call brings in a record, for itself or within a tree.
fn holds(call: &Call, record: &Call) -> bool {
    if call == record {
        return true;
    }
    let (Some(root), Some(path)) = (call.params.get(1), record.params.get(1)) else {
        return false;
    };
    let whole = call.method == "setParam" && root.as_str() == Some("/");
    if !whole || record.method != "setParam" {
        return false;
    }
    let path = path.as_str().unwrap().split('/').skip(1);
    let found = path.fold(call.params.get(2), |tree, name| {
        tree?.as_struct()?.get(name)
    });
    found.is_some()
}

/// What one life came to.
enum Ended {
    Died(InFlight),
    Whole(Box<Master>, Vec<Call>),
}

fn live(suspicion: &Suspicion, target: &Master, sickness: &Sickness, number: usize) -> Ended {
    let mark = Mark::new("m");
    let mut life = Life {
        sickness,
        number,
        age: Duration::from_millis(100),
        made: Vec::new(),
    };
    let start = life.age;
    for name in [
        "getPid",
        "lookupNode",
        "getSystemState",
        "getTopicTypes",
        "getParam",
    ] {
        if !life.survives(&Call::new(name, vec![])) {
            return Ended::Died(InFlight::Nothing);
        }
    }
    let Some(trial) = suspicion.trial() else {
        let plan = Plan::new(target, &Master::default(), &mark);
        for entry in decode_call(plan.request()).unwrap().entries() {
            if !life.survives(&entry) {
                return Ended::Died(InFlight::Whole);
            }
        }
        return Ended::Whole(plan.expected().clone().into(), Vec::new());
    };
    let tested = trial.tested.as_ref().map(|(call, _)| call);
    let plan = Careful::new(target, &Master::default(), &mark, &trial.left_out, tested);
    let mut index = 0;
    for step in plan.steps() {
        if let Some((_, age)) = trial.tested.as_ref().filter(|_| step.tested) {
            while life.age - start < *age {
                life.age += Duration::from_millis(50).min(*age - (life.age - start));
                if !life.survives(&Call::new("getPid", vec![])) {
                    return Ended::Died(InFlight::NoRecord);
                }
            }
        }
        let age = life.age - start;
        if !life.survives(&step.call) {
            return Ended::Died(match step.record {
                true => InFlight::Record {
                    call: step.call.clone(),
                    index,
                    age,
                },
                false => InFlight::NoRecord,
            });
        }
        index += usize::from(step.record);
    }
    Ended::Whole(plan.expected().clone().into(), plan.left_out().to_vec())
}

fn call(method: &str, params: &[&str]) -> Call {
    Call::new(method, params.iter().map(|text| (*text).into()).collect())
}

/// A state with so many publishers, subscribers, services, parameter subscriptions and parameters.
fn state([publishers, subscribers, services, watchers, params]: [usize; 5]) -> Master {
    let mut master = Master::default();
    let mut apply = |call: Call| {
        master.apply(&call);
    };
    for i in 0..params {
        let key = format!("/space{}/inner/p{i}", i % 3);
        apply(Call::new(
            "setParam",
            vec!["/n".into(), key.into(), (i as i32).into()],
        ));
    }
    for i in 0..publishers {
        let (node, topic) = (format!("/n{}", i % 4), format!("/t{}", i * 2 / 3));
        let api = format!("http://n{}:1/", i % 4);
        apply(call("registerPublisher", &[&node, &topic, "a/B", &api]));
    }
    for i in 0..subscribers {
        let (node, topic) = (format!("/n{}", i % 5), format!("/t{i}"));
        let api = format!("http://n{}:1/", i % 5);
        apply(call("registerSubscriber", &[&node, &topic, "a/B", &api]));
    }
    for i in 0..services {
        let (node, service) = (format!("/n{}", i % 3), format!("/s{i}"));
        let api = format!("http://n{}:1/", i % 3);
        let service_api = format!("rosrpc://n:{i}");
        apply(call(
            "registerService",
            &[&node, &service, &service_api, &api],
        ));
    }
    for i in 0..watchers {
        let api = format!("http://n{}:1/", i % 3);
        apply(call(
            "subscribeParam",
            &[&format!("/n{}", i % 3), &api, &format!("/space{i}")],
        ));
    }
    master
}

/// The entries of a careful injection of `target`.
fn records(target: &Master) -> Vec<Call> {
    let plan = Careful::new(target, &Master::default(), &Mark::new("m"), &[], None);
    assert_eq!(plan.expected(), target);
    let records = plan.steps().iter().filter(|step| step.record);
    records.map(|step| step.call.clone()).collect()
}

/// Lives until one is whole, at most `most`: how many died, and the last one.
fn lives(
    suspicion: &mut Suspicion,
    target: &Master,
    sickness: &Sickness,
    most: usize,
) -> (usize, Option<(Master, Vec<Call>)>) {
    for number in 0..most {
        match live(suspicion, target, sickness, number) {
            Ended::Died(at) => suspicion.died(at),
            Ended::Whole(state, left_out) => {
                suspicion.survived();
                return (number, Some((*state, left_out)));
            }
        }
    }
    (most, None)
}

/// A state without the order of its topic types: to test the first publisher of all, another topic's
/// type has to come before it.
fn without_order(state: &Master) -> (usize, Value) {
    let mut state = state.clone();
    let mut of = |method: &str| match state.apply(&call(method, &["/x"])).reply {
        crate::xmlrpc::Reply::Value(value) => value,
        fault => panic!("{fault:?}"),
    };
    let types = of("getTopicTypes").as_array().unwrap()[2]
        .as_array()
        .unwrap()
        .len();
    let system = of("getSystemState");
    (types, system)
}

fn sizes() -> impl Strategy<Value = [usize; 5]> {
    [3..12_usize, 0..12_usize, 0..6_usize, 0..6_usize, 0..8_usize]
}

fn counted() -> impl Strategy<Value = Counted> {
    let names = [
        "setParam",
        "registerPublisher",
        "registerSubscriber",
        "registerService",
        "subscribeParam",
    ];
    prop_oneof![
        Just(Counted::Calls),
        Just(Counted::Changes),
        Just(Counted::Registrations),
        prop::sample::select(names.to_vec()).prop_map(Counted::Method),
    ]
}

proptest! {
    #[test]
    fn a_record_that_kills_is_found_with_few_deaths(
        sizes in sizes(),
        picked in prop::collection::vec(any::<prop::sample::Index>(), 1..=CONVICTED_MOST),
    ) {
        let target = state(sizes);
        let all = records(&target);
        let mut poison: Vec<usize> = picked.iter().map(|index| index.index(all.len())).collect();
        poison.sort_unstable();
        poison.dedup();
        let poison: Vec<Call> = poison.into_iter().map(|index| all[index].clone()).collect();
        let sickness = Sickness::Poison(poison.clone());
        let mut suspicion = Suspicion::default();
        let (deaths, whole) = lives(&mut suspicion, &target, &sickness, 50);
        let (state, left_out) = whole.expect("a whole life");
        prop_assert_eq!(&left_out, &poison);
        prop_assert_eq!(deaths, 2 + 2 * poison.len());
        // What is left never kills again.
        let (deaths, whole) = lives(&mut suspicion, &state, &sickness, 1);
        prop_assert_eq!(deaths, 0);
        prop_assert_eq!(&whole.expect("a whole life").0, &state);
    }

    #[test]
    fn a_master_that_counts_is_never_believed(
        sizes in sizes(),
        counted in counted(),
        most in 1..60_usize,
        deaths in 1..12_usize,
    ) {
        let target = state(sizes);
        let of_method = |name: &str| {
            records(&target).iter().filter(|record| record.method == name).count()
        };
        // The only one of its method cannot be told from one that kills.
        if let Counted::Method(name) = counted {
            prop_assume!(of_method(name) > 1);
        }
        let sickness = Sickness::Count(counted, most);
        let mut suspicion = Suspicion::default();
        let (_, whole) = lives(&mut suspicion, &target, &sickness, deaths);
        if let Some((state, left_out)) = &whole {
            prop_assert_eq!(left_out, &Vec::<Call>::new());
            prop_assert_eq!(state, &target);
        }
        let (late, whole) = lives(&mut suspicion, &target, &Sickness::Healthy, 1);
        prop_assert_eq!(late, 0);
        let (state, left_out) = whole.expect("a whole life");
        prop_assert_eq!(left_out, Vec::<Call>::new());
        prop_assert_eq!(without_order(&state), without_order(&target));
        prop_assert_eq!(state.params(), target.params());
    }

    #[test]
    fn a_master_that_ages_is_never_believed(
        sizes in sizes(),
        micros in 100_000..110_000_u64,
        // Some of them are just as much later as the calls take that precede a test.
        later in [0..1_u64, 0..1, 0..1, 12_700..13_100],
        deaths in 1..12_usize,
    ) {
        let target = state(sizes);
        let sickness = Sickness::Age(later.map(|later| Duration::from_micros(micros + later)));
        let mut suspicion = Suspicion::default();
        let (_, whole) = lives(&mut suspicion, &target, &sickness, deaths);
        let whole = whole.or_else(|| lives(&mut suspicion, &target, &Sickness::Healthy, 1).1);
        let (state, left_out) = whole.expect("a whole life");
        prop_assert_eq!(left_out, Vec::<Call>::new());
        prop_assert_eq!(without_order(&state), without_order(&target));
    }
}

/// Masters that five times in a row die at some call, of a robot that has few: the worst case.
#[test]
fn chance_hardly_ever_condemns() {
    let target = state([3, 1, 1, 0, 1]);
    let mut dice = 0x2545_f491_4f6c_dd1d_u64;
    let mut next = |end: usize| {
        dice ^= dice << 13;
        dice ^= dice >> 7;
        dice ^= dice << 17;
        5 + (dice % end as u64) as usize
    };
    let runs = 4_000;
    let mut wrong = 0;
    for _ in 0..runs {
        // A careful life with a test makes more calls; who dies anywhere may die there too.
        let sickness = Sickness::Chance(vec![next(12), next(12), next(12), next(80), next(12)]);
        let mut suspicion = Suspicion::default();
        let (_, whole) = lives(&mut suspicion, &target, &sickness, 8);
        wrong += usize::from(!whole.expect("a whole life").1.is_empty());
    }
    assert!(wrong * 100 < runs, "{wrong} of {runs}");
}

#[test]
fn too_many_records_that_kill_are_no_records() {
    let target = state([2, 0, CONVICTED_MOST + 1, 0, 0]);
    let mut poison = records(&target);
    poison.retain(|record| record.method == "registerService");
    let sickness = Sickness::Poison(poison);
    let mut suspicion = Suspicion::default();
    let (_, whole) = lives(&mut suspicion, &target, &sickness, 40);
    assert!(whole.is_none());
    let (_, whole) = lives(&mut suspicion, &target, &Sickness::Healthy, 1);
    // Whatever was left out at that moment is proven; nothing else is missing.
    assert!(whole.expect("a whole life").1.len() <= CONVICTED_MOST);
}

#[test]
fn parameters_come_one_by_one_even_where_some_have_no_name() {
    let tree = |members: Vec<(&str, Value)>| {
        Value::Struct(
            members
                .into_iter()
                .map(|(k, v)| (k.to_owned(), v))
                .collect::<Struct>(),
        )
    };
    let mut target = Master::default();
    let odd = tree(vec![("a/b", 1.into()), ("", 2.into())]);
    let value = tree(vec![
        ("odd", odd.clone()),
        ("empty", tree(vec![])),
        ("x", 3.into()),
    ]);
    target.apply(&Call::new(
        "setParam",
        vec!["/n".into(), "/p".into(), value],
    ));
    let set: Vec<_> = records(&target)
        .into_iter()
        .map(|record| record.params)
        .collect();
    let expected = [
        ("/p/odd", odd),
        ("/p/empty", tree(vec![])),
        ("/p/x", 3.into()),
    ];
    let expected = expected.map(|(key, value)| vec!["/rosrescue".into(), key.into(), value]);
    assert_eq!(set, expected);
    // At the top only the tree as a whole can be set, and it is no record.
    let root = tree(vec![("a/b", 1.into())]);
    target.apply(&Call::new("setParam", vec!["/n".into(), "/".into(), root]));
    assert_eq!(records(&target), []);
}
