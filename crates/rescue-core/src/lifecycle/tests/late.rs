//! A master that is late, starved, busy, or slow to start.

use super::super::evidence::Effort;
use super::*;

/// What a master does during a sample.
#[derive(Clone, Copy, PartialEq)]
enum Does {
    Nothing,
    Starve,
    Work,
}

impl Script {
    /// Samples the child if the state machine asks for it, then feeds `input`.
    fn feed_seen(&mut self, does: Does, input: Input, expected: &[Action]) -> &mut Self {
        if self.machine.needs_sample(self.now, input) {
            self.observe(does);
        }
        self.feed(input, expected)
    }

    fn observe(&mut self, does: Does) {
        let ran = match does {
            Does::Work => self.now.duration_since(self.start),
            Does::Nothing | Does::Starve => Duration::ZERO,
        };
        let effort = Effort {
            runnable: does != Does::Nothing,
            ran,
            ..Effort::default()
        };
        self.machine.observe(Sample {
            at: self.now,
            master: Some(effort),
            own_wait: Duration::ZERO,
        });
    }

    /// Misses a probe every half second until the gate is shut.
    fn miss_all(&mut self, does: Does, then: Action) -> &mut Self {
        for _ in 1..PROBING.count {
            self.now += Duration::from_millis(500);
            self.feed_seen(does, Input::ProbeMissed, &[Action::Probe]);
        }
        self.now += Duration::from_millis(500);
        let shut = Action::ShutGate(Cause::Hung);
        self.feed_seen(does, Input::ProbeMissed, &[shut, then])
    }
}

const STARVED: Action = Action::Spare("it gets too little CPU time");
const BUSY: Action = Action::Spare("it is busy");

#[test]
fn a_starved_master_whose_connections_end_is_not_killed() {
    let mut script = Script::serving(Supervision::Ours);
    script.lose();
    // The master closes each connection that the starved rosrescue has left idle for too long.
    let mut lose_again = |does| {
        script.now += Duration::from_secs(1);
        script.machine.on(script.now, Input::Wake);
        script.feed(Input::Connected, &[Action::Examine]);
        if script
            .machine
            .needs_sample(script.now, Input::ConnectionLost)
        {
            script.observe(does);
        }
        script.machine.on(script.now, Input::ConnectionLost)
    };
    let actions: Vec<_> = (0..300).flat_map(|_| lose_again(Does::Starve)).collect();
    assert!(actions.contains(&STARVED));
    assert!(!actions.contains(&Action::Kill), "{actions:?}");
    // A master that gets processor time and closes each connection nevertheless is of no use.
    let mut actions = (0..3).flat_map(|_| lose_again(Does::Nothing));
    assert!(actions.any(|action| action == Action::Kill));
}

#[test]
fn a_late_master_is_stood_in_for_and_given_what_it_missed() {
    for supervision in [Supervision::Ours, Supervision::Theirs] {
        let mut script = Script::serving(supervision);
        script
            .feed(Input::Late, &[Action::StandIn, Action::Probe])
            .feed(Input::Late, &[])
            .feed(Input::Slow, &[])
            .feed(Input::ProbeMissed, &[Action::Probe])
            .feed(Input::LateAnswered, &[Action::CatchUp])
            .feed(Input::Slow, &[])
            .feed(Input::CaughtUp, &[Action::OpenGate])
            .wake(PROBING.interval, &[Action::Probe])
            // No probe is started while another one is running.
            .feed(Input::Late, &[Action::StandIn])
            .feed(Input::LateAnswered, &[Action::CatchUp])
            .feed(
                Input::NotCaughtUp,
                &[Action::ShutGate(Cause::Late), Action::Connect],
            )
            // This answer belongs to the time before the gate was shut.
            .feed(Input::LateAnswered, &[])
            .feed(Input::CaughtUp, &[])
            .serve(false)
            .feed(Input::LateAnswered, &[]);
        assert_eq!(script.machine.deaths(), 0);
    }
}

#[test]
fn a_master_that_is_late_for_ever_hangs() {
    let mut script = Script::serving(Supervision::Theirs);
    script
        .feed(Input::Late, &[Action::StandIn, Action::Probe])
        .feed(Input::ProbeMissed, &[Action::Probe])
        .feed(Input::ProbeMissed, &[Action::Probe])
        .feed(Input::ProbeMissed, &[Action::ShutGate(Cause::Hung)])
        .wake(FIRST_PAUSE, &[Action::Connect]);
    let mut script = Script::serving(Supervision::Ours);
    script
        .feed(Input::Late, &[Action::StandIn, Action::Probe])
        .miss_all(Does::Nothing, Action::Kill)
        .feed(Input::Exited, &[Action::Spawn]);
}

#[test]
fn a_master_that_ends_while_it_is_late_is_replaced() {
    for catching_up in [false, true] {
        let mut script = Script::serving(Supervision::Ours);
        script.feed(Input::Late, &[Action::StandIn, Action::Probe]);
        if catching_up {
            script.feed(Input::LateAnswered, &[Action::CatchUp]);
        }
        script
            .lose()
            .feed(Input::NotCaughtUp, &[])
            .feed(Input::Exited, &[Action::Spawn]);
    }
}

#[test]
fn a_starved_or_busy_master_is_left_alone_until_it_answers() {
    for (does, spare) in [(Does::Starve, STARVED), (Does::Work, BUSY)] {
        let mut script = Script::serving(Supervision::Ours);
        script
            .wake(PROBING.interval, &[Action::Probe])
            .miss_all(does, spare)
            .wake(FIRST_PAUSE, &[Action::Connect])
            .feed(Input::Connected, &[Action::Examine]);
        script.now += Duration::from_secs(3);
        script
            .feed_seen(does, Input::Unreachable, &[spare])
            .feed(Input::Wake, &[])
            .wake(Duration::from_millis(200), &[Action::Connect])
            .serve(false);
        assert_eq!(script.machine.deaths(), 0);
    }
}

#[test]
fn a_master_that_hangs_at_last_is_killed_at_last() {
    let mut script = Script::serving(Supervision::Ours);
    script
        .wake(PROBING.interval, &[Action::Probe])
        .miss_all(Does::Starve, STARVED)
        .wake(FIRST_PAUSE, &[Action::Connect])
        .feed(Input::Connected, &[Action::Examine]);
    // The previous sample still shows a starved master.
    script.now += Duration::from_secs(3);
    script
        .feed_seen(Does::Nothing, Input::Unreachable, &[STARVED])
        .wake(Duration::from_millis(200), &[Action::Connect])
        .feed(Input::Connected, &[Action::Examine]);
    script.now += Duration::from_secs(3);
    script
        .feed_seen(Does::Nothing, Input::Unreachable, &[Action::Kill])
        .feed(Input::Exited, &[Action::Spawn]);
}

#[test]
fn a_master_that_starts_slowly_is_not_ended_while_it_works() {
    let mut script = Script::new(Supervision::Ours);
    script
        .feed(FIRST, &[Action::Spawn])
        .feed(Input::Spawned, &[Action::Connect]);
    let refuse = |script: &mut Script, does: Does, seconds: u64| {
        let mut actions = Vec::new();
        for _ in 0..5 * seconds {
            script.now += Duration::from_millis(200);
            if script.machine.needs_sample(script.now, Input::Refused) {
                let ran = match does {
                    Does::Work => script.now.duration_since(script.start),
                    Does::Nothing | Does::Starve => Duration::from_secs(120),
                };
                let effort = Effort {
                    ran,
                    ..Effort::default()
                };
                script.machine.observe(Sample {
                    at: script.now,
                    master: Some(effort),
                    own_wait: Duration::ZERO,
                });
            }
            let refused = script.machine.on(script.now, Input::Refused);
            actions.extend(refused.into_iter().filter(|it| *it != BUSY));
            script.machine.on(script.now, Input::Wake);
        }
        actions
    };
    assert_eq!(refuse(&mut script, Does::Work, 120), []);
    // From then on the master waits forever.
    let actions = refuse(&mut script, Does::Nothing, 2);
    assert_eq!(actions.first(), Some(&Action::Kill));
    script.feed(Input::Exited, &[Action::Spawn]);
    // An endless loop is not a slow start.
    script.feed(Input::Spawned, &[Action::Connect]);
    assert_eq!(refuse(&mut script, Does::Work, 300), []);
    let actions = refuse(&mut script, Does::Work, 40);
    assert_eq!(actions.first(), Some(&Action::Kill));
}
