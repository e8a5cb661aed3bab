//! Tests how failing sequences are made shorter, and how they are printed.

use ros1_master::{
    master::Master,
    xmlrpc::{Call, Value},
};

use crate::script::{Script, Step, shrink, simpler};
use crate::{crashes, direct, takeovers};

#[test]
fn shrinking_leaves_the_fewest_items_that_fail() {
    let whole: Vec<u32> = (0..200).collect();
    let mut runs = 0;
    let least = shrink(
        &whole,
        |_| Vec::new(),
        usize::MAX,
        |items| {
            runs += 1;
            let at = |wanted| items.iter().position(|item| *item == wanted);
            at(17).is_some_and(|first| at(150).is_some_and(|second| first < second))
        },
    );
    assert_eq!(least, [17, 150]);
    assert!(runs < 200, "{runs} runs");
    // This also works if pieces that need each other are neighbours.
    let least = shrink(
        &whole,
        |_| Vec::new(),
        usize::MAX,
        |items| items.iter().filter(|item| *item % 50 < 2).count() >= 8,
    );
    assert_eq!(least, [0, 1, 50, 51, 100, 101, 150, 151]);
}

#[test]
fn shrinking_also_removes_parts_of_items() {
    let shorter = |text: &String| match text.len() {
        0 => Vec::new(),
        length => vec![text[1..].to_owned(), text[..length - 1].to_owned()],
    };
    let whole = ["abc".to_owned(), "defgh".to_owned(), "ijk".to_owned()];
    let least = shrink(&whole, shorter, usize::MAX, |items| {
        items.concat().contains('f')
    });
    assert_eq!(least, ["f"]);
}

/// A master with a defect: it never removes a subscriber.
fn wrong(model: &mut Master, call: &Call) -> Option<ros1_master::xmlrpc::Reply> {
    (call.method != "unregisterSubscriber").then(|| model.apply(&call.clone().into()).reply)
}

/// Whether an answer to one of the calls reveals the defect.
fn is_found_out(steps: &[Step]) -> bool {
    let (mut right, mut mistaken) = (Master::default(), Master::default());
    steps.iter().any(|step| match step {
        Step::Call { call, .. } => {
            let reply = right.apply(&call.clone().into()).reply;
            wrong(&mut mistaken, call).is_some_and(|other| other != reply)
        }
        _ => false,
    })
}

#[test]
fn a_defect_of_the_model_is_shrunk_to_three_calls() {
    let failing = (0..100).map(|seed| direct::script(seed, 200, 5));
    let failing: Vec<Script> = failing
        .filter(|script| is_found_out(&script.steps))
        .collect();
    assert!(failing.len() > 20, "{} of 100", failing.len());
    for script in failing.iter().take(20) {
        let steps = shrink(&script.steps, simpler, usize::MAX, is_found_out);
        // A registration, its removal, and a call whose answer reveals the defect.
        assert!(is_found_out(&steps) && steps.len() <= 3, "{steps:?}");
    }
}

#[test]
fn a_printed_script_is_parsed_unchanged() {
    for seed in 0..200 {
        for script in [
            direct::script(seed, 50, 5),
            crashes::script(seed, 50, 3, 5),
            takeovers::script(seed, 50, 3, 5),
        ] {
            let printed = script.print();
            assert!(Script::parse(&printed) == script, "{printed}");
            assert_eq!(Script::parse(&printed).print(), printed);
        }
    }
    let text = "unreturnable\n# a remark\n\n1 [\"setParam\",\"/n\",\"a\",{\"double\":\"NaN\"}]\nsuccessor\n\
                + [\"getUri\",\"/n\"]\ncrash in flight\n";
    let script = Script::parse(text);
    assert_eq!(
        (script.unreturnable, script.steps.len(), script.calls()),
        (true, 3, 2)
    );
    let Step::Call { by: 1, call } = &script.steps[0] else {
        panic!("{script:?}")
    };
    assert_eq!(call.params[2], Value::Double(f64::NAN));
}
