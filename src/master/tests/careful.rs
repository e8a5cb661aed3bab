use super::*;
use crate::master::{Careful, Mark, Plan};

fn careful(target: &Master, found: &Master, left_out: &[Call], tested: Option<&Call>) -> Careful {
    let plan = Careful::new(target, found, &Mark::new("m"), left_out, tested);
    let mut master = found.clone();
    for step in plan.steps() {
        let outcome = master.apply(&step.call);
        assert_eq!(outcome.reply, step.predicted, "{:?}", step.call);
        let told = outcome.notices.iter();
        let told = told.filter(|_| found.is_empty()).count();
        assert_eq!(told, 0, "{:?} of {:?}", outcome.notices, step.call);
    }
    plan
}

fn whole() -> Master {
    after([
        set(
            "/ns",
            tree([("p", 1.into()), ("inner", tree([("q", 2.into())]))]),
        ),
        set("/single", "x"),
        publish("/one", "/t", "a/B"),
        publish("/two", "/t", "a/B"),
        publish("/two", "/u", "*"),
        provide("/one", "/s"),
        provide("/two", "/s"),
        subscribe("/one", "/u", "c/D"),
        subscribe("/two", "/v", "e/F"),
        watch("/one", "/ns"),
        watch("/two", "/"),
    ])
}

#[test]
fn entry_by_entry_comes_to_the_same() {
    let target = whole();
    let plan = careful(&target, &Master::default(), &[], None);
    assert_eq!(plan.expected(), &target);
    let held = after([
        set("/ns", tree([("theirs", 3.into())])),
        publish("/rosout", "/rosout_agg", "rosgraph_msgs/Log"),
        subscribe("/rosout", "/t", "a/B"),
        watch("/rosout", "/ns"),
    ]);
    let together = Plan::new(&target, &held, &Mark::new("m"));
    let plan = careful(&target, &held, &[], None);
    assert_eq!(plan.skipped(), together.skipped());
    let (one, other) = (plan.expected(), together.expected());
    // Only the order of the parameters differs: those that are there come first.
    assert_eq!(one.params(), other.params());
    let both = [one, other].map(|state| {
        let mut state = state.clone();
        state.apply(&set("/", tree([])));
        state
    });
    assert_eq!(both[0], both[1]);
}

/// Any entry can be put to the test without a trace, and left out.
#[test]
fn decoys_leave_no_trace() {
    let target = whole();
    let empty = Master::default();
    let steps = careful(&target, &empty, &[], None).steps().to_vec();
    let mut tested = 0;
    for record in steps.iter().filter(|step| step.record) {
        let plan = careful(&target, &empty, &[], Some(&record.call));
        let at = plan.steps().iter().position(|step| step.tested);
        let at = at.expect("the entry is put to the test");
        assert_eq!(plan.steps()[at].call, record.call);
        assert!(plan.steps().len() > steps.len() + 50);
        let decoys = &plan.steps()[at - 64..at];
        assert!(decoys.iter().all(|step| !step.record));
        let kind = |call: &Call| call.method.starts_with("unregister");
        if !kind(&record.call) {
            assert_eq!(decoys[0].call.method, record.call.method);
        }
        if record.call.method == "registerPublisher" && record.call.params[1] == "/t".into() {
            // Another topic's type comes first.
            assert_eq!(plan.expected().params(), target.params());
        } else {
            assert_eq!(plan.expected(), &target, "{:?}", record.call);
        }
        let without = careful(&target, &empty, std::slice::from_ref(&record.call), None);
        assert_eq!(without.left_out(), std::slice::from_ref(&record.call));
        tested += 1;
    }
    assert!(tested > 10, "{tested}");
}
