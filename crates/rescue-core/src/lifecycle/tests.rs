mod crash_loop;
mod late;

use super::*;

const PROBING: Probing = Probing {
    interval: Duration::from_secs(1),
    count: 3,
    start_limit: START_LIMIT,
};
const START_LIMIT: Duration = Duration::from_secs(30);
/// A start without a master of an earlier rosrescue.
const FIRST: Input = Input::Start {
    left: false,
    restored: false,
};
/// A start after an earlier rosrescue has left its master running.
const LEFT: Input = Input::Start {
    left: true,
    restored: false,
};

/// Runs the state machine on a virtual clock.
struct Script {
    machine: Lifecycle,
    start: Instant,
    now: Instant,
}

impl Script {
    fn new(supervision: Supervision) -> Self {
        let start = Instant::now();
        Self {
            machine: Lifecycle::new(supervision, PROBING),
            start,
            now: start,
        }
    }

    fn feed(&mut self, input: Input, expected: &[Action]) -> &mut Self {
        assert_eq!(
            self.machine.on(self.now, input),
            expected,
            "after {input:?}"
        );
        self
    }

    /// The connection to a serving master ends.
    fn lose(&mut self) -> &mut Self {
        let shut = Action::ShutGate(Cause::ConnectionLost);
        self.feed(Input::ConnectionLost, &[shut, Action::Connect])
    }

    /// A master listens, and is found to hold the state.
    fn serve(&mut self, new: bool) -> &mut Self {
        self.feed(Input::Connected, &[Action::Examine])
            .feed(Input::Examined { new }, &[Action::OpenGate])
    }

    /// Moves the clock to the next deadline, which must be `pause` ahead.
    fn wake(&mut self, pause: Duration, expected: &[Action]) -> &mut Self {
        let deadline = self.machine.deadline().expect("a deadline");
        assert_eq!(deadline - self.now, pause);
        self.now = deadline;
        self.feed(Input::Wake, expected)
    }

    fn serving(supervision: Supervision) -> Self {
        let mut script = Self::new(supervision);
        match supervision {
            Supervision::Ours => script
                .feed(FIRST, &[Action::Spawn])
                .feed(Input::Spawned, &[Action::Connect]),
            Supervision::Theirs => script.feed(FIRST, &[Action::Connect]),
        };
        script.serve(true);
        script
    }
}

#[test]
fn a_killed_child_is_replaced_at_once() {
    let mut script = Script::serving(Supervision::Ours);
    script
        .lose()
        .feed(Input::Refused, &[])
        .feed(Input::Exited, &[Action::Spawn])
        .feed(Input::Spawned, &[Action::Connect])
        .feed(Input::Refused, &[])
        .wake(Duration::from_millis(1), &[Action::Connect])
        .serve(true);
}

#[test]
fn a_child_whose_end_is_seen_first_shuts_the_gate_too() {
    let mut script = Script::serving(Supervision::Ours);
    script.feed(
        Input::Exited,
        &[Action::ShutGate(Cause::Exited), Action::Spawn],
    );
    assert_eq!(script.machine.deadline(), None);
}

#[test]
fn a_thread_that_ends_shuts_the_gate_before_the_process_has_ended() {
    let mut script = Script::serving(Supervision::Ours);
    script
        .feed(
            Input::ThreadEnded,
            &[Action::ShutGate(Cause::ThreadEnded), Action::Connect],
        )
        // The dying process still accepts connections.
        .feed(Input::Connected, &[Action::Examine])
        .feed(Input::ThreadEnded, &[])
        .feed(Input::ConnectionLost, &[])
        .feed(Input::Exited, &[Action::Spawn]);
    assert_eq!(script.machine.deaths(), 1);
}

#[test]
fn an_external_master_whose_thread_ends_dies_once() {
    let lost = [Action::ShutGate(Cause::ThreadEnded), Action::Connect];
    let mut script = Script::serving(Supervision::Theirs);
    script
        .feed(Input::ThreadEnded, &lost)
        .feed(Input::Refused, &[])
        .serve(true);
    assert_eq!(script.machine.deaths(), 1);
    script
        .feed(Input::ThreadEnded, &lost)
        // The dying process still accepts connections.
        .feed(Input::Connected, &[Action::Examine])
        .feed(Input::ConnectionLost, &[])
        .feed(Input::Refused, &[])
        .serve(true);
    assert_eq!(script.machine.deaths(), 2);
}

#[test]
fn the_end_of_a_single_thread_does_not_count_as_a_death() {
    let mut script = Script::serving(Supervision::Ours);
    script
        .feed(
            Input::ThreadEnded,
            &[Action::ShutGate(Cause::ThreadEnded), Action::Connect],
        )
        .serve(false);
    assert_eq!(script.machine.deaths(), 0);
}

#[test]
fn a_closed_idle_connection_does_not_count_as_a_death() {
    let mut script = Script::serving(Supervision::Ours);
    script.lose().serve(true);
    assert_eq!(script.machine.deaths(), 0);
}

#[test]
fn a_master_that_was_left_is_taken_over_and_replaced_when_it_ends() {
    let mut script = Script::new(Supervision::Ours);
    script
        .feed(LEFT, &[Action::Connect])
        .feed(Input::Refused, &[])
        .wake(Duration::from_millis(1), &[Action::Connect])
        .serve(false)
        .lose()
        .feed(Input::Refused, &[])
        .feed(Input::Exited, &[Action::Spawn]);
}

#[test]
fn a_master_that_was_left_hanging_is_killed() {
    let mut script = Script::new(Supervision::Ours);
    script
        .feed(LEFT, &[Action::Connect])
        .feed(Input::Connected, &[Action::Examine])
        .feed(Input::Unreachable, &[Action::Kill])
        .feed(Input::Exited, &[Action::Spawn]);
}

/// A stopped process accepts no more connections once its backlog is full.
#[test]
fn a_master_that_was_left_and_takes_no_connection_is_killed() {
    let mut script = Script::new(Supervision::Ours);
    script
        .feed(LEFT, &[Action::Connect])
        .feed(Input::Unreachable, &[]);
    script.now += START_LIMIT + Duration::from_secs(1);
    script
        .feed(Input::Wake, &[Action::Connect])
        .feed(Input::Unreachable, &[Action::Kill])
        .feed(Input::Exited, &[Action::Spawn]);
    // External masters are waited for.
    let mut script = Script::new(Supervision::Theirs);
    script.feed(FIRST, &[Action::Connect]);
    script.now += START_LIMIT * 2;
    script.feed(Input::Unreachable, &[]);
}

/// The server at the child's port is not a master.
#[test]
fn a_child_at_whose_port_there_is_no_master_is_replaced() {
    for answer in [Input::NotAMaster, Input::ConnectionLost] {
        let mut script = Script::new(Supervision::Ours);
        script
            .feed(FIRST, &[Action::Spawn])
            .feed(Input::Spawned, &[Action::Connect])
            .feed(Input::Connected, &[Action::Examine])
            .feed(answer, &[]);
        script.now += START_LIMIT + Duration::from_secs(1);
        script
            .feed(Input::Wake, &[Action::Connect])
            .feed(Input::Connected, &[Action::Examine])
            .feed(answer, &[Action::Kill])
            .feed(Input::Exited, &[Action::Spawn]);
        // External masters are never replaced.
        let mut script = Script::new(Supervision::Theirs);
        script.feed(FIRST, &[Action::Connect]);
        script.now += START_LIMIT * 2;
        script.feed(Input::Connected, &[Action::Examine]);
        let actions = script.machine.on(script.now, answer);
        assert!(!actions.contains(&Action::Kill), "{actions:?}");
    }
}

#[test]
fn an_external_master_is_waited_for_with_growing_pauses() {
    let mut script = Script::serving(Supervision::Theirs);
    script
        .lose()
        .feed(Input::Refused, &[])
        .wake(Duration::from_millis(1), &[Action::Connect]);
    script.now += Duration::from_secs(3);
    script
        .feed(Input::Refused, &[])
        .wake(Duration::from_millis(20), &[Action::Connect]);
    script.now += Duration::from_secs(60);
    script
        .feed(Input::Refused, &[])
        .wake(Duration::from_millis(200), &[Action::Connect]);
}

#[test]
fn a_hung_child_is_killed_after_so_many_missed_probes() {
    let mut script = Script::serving(Supervision::Ours);
    script
        .wake(PROBING.interval, &[Action::Probe])
        .feed(Input::ProbeMissed, &[Action::Probe])
        .feed(Input::ProbeAnswered, &[])
        .wake(PROBING.interval, &[Action::Probe])
        .feed(Input::ProbeMissed, &[Action::Probe])
        .feed(Input::ProbeMissed, &[Action::Probe])
        .feed(
            Input::ProbeMissed,
            &[Action::ShutGate(Cause::Hung), Action::Kill],
        )
        .feed(Input::Exited, &[Action::Spawn]);
}

#[test]
fn a_hung_external_master_is_asked_again_and_never_killed() {
    let mut script = Script::serving(Supervision::Theirs);
    script
        .wake(PROBING.interval, &[Action::Probe])
        .feed(Input::ProbeMissed, &[Action::Probe])
        .feed(Input::ProbeMissed, &[Action::Probe])
        .feed(Input::ProbeMissed, &[Action::ShutGate(Cause::Hung)])
        .wake(FIRST_PAUSE, &[Action::Connect])
        .feed(Input::Connected, &[Action::Examine])
        .feed(Input::Unreachable, &[])
        .wake(Duration::from_millis(200), &[Action::Connect])
        .serve(true);
}

#[test]
fn a_child_that_never_listens_is_killed() {
    let mut script = Script::new(Supervision::Ours);
    script
        .feed(FIRST, &[Action::Spawn])
        .feed(Input::Spawned, &[Action::Connect]);
    script.now += START_LIMIT + Duration::from_secs(1);
    script
        .feed(Input::Refused, &[Action::Kill])
        .feed(Input::Exited, &[Action::Spawn]);
}

#[test]
fn a_child_whose_port_was_taken_is_replaced_at_once_without_counting_as_a_death() {
    let mut script = Script::new(Supervision::Ours);
    script.feed(FIRST, &[Action::Spawn]);
    let take = |script: &mut Script, spawned: &[Action]| {
        script
            .feed(Input::Spawned, &[Action::Connect])
            .feed(Input::PortTaken, &[Action::Kill])
            .feed(Input::Exited, spawned);
    };
    for _ in 0..DEATHS_AT_ONCE {
        take(&mut script, &[Action::Spawn]);
    }
    // A program that takes each port in turn must not keep the processor busy.
    take(&mut script, &[]);
    script.wake(FIRST_PAUSE, &[Action::Spawn]);
    take(&mut script, &[]);
    script.wake(2 * FIRST_PAUSE, &[Action::Spawn]);
    script.feed(Input::Spawned, &[Action::Connect]).serve(true);
    assert_eq!(script.machine.deaths(), 0);
}

#[test]
fn a_master_that_dies_while_it_is_examined_is_replaced_without_a_rush() {
    let mut script = Script::new(Supervision::Ours);
    script
        .feed(FIRST, &[Action::Spawn])
        .feed(Input::Spawned, &[Action::Connect])
        .feed(Input::Connected, &[Action::Examine])
        .feed(Input::ConnectionLost, &[])
        .wake(Duration::from_millis(1), &[Action::Connect])
        .feed(Input::Refused, &[])
        .feed(Input::Exited, &[Action::Spawn]);
}

#[test]
fn nothing_happens_after_a_stop() {
    let mut script = Script::serving(Supervision::Ours);
    script
        .feed(Input::Stop, &[Action::ShutGate(Cause::Stopping)])
        .feed(Input::Exited, &[])
        .feed(Input::ConnectionLost, &[]);
    assert_eq!(script.machine.deadline(), None);
}

/// A dying process accepts connections until it closes its listening socket, which comes last. A relay in front of a
/// dead master accepts and closes connections forever.
#[test]
fn a_master_that_is_still_dying_dies_once() {
    let mut script = Script::serving(Supervision::Theirs);
    script.lose().feed(Input::Connected, &[Action::Examine]);
    for _ in 0..10 {
        script.feed(Input::ConnectionLost, &[]);
        script.now += Duration::from_millis(100);
        script
            .feed(Input::Wake, &[Action::Connect])
            .feed(Input::Connected, &[Action::Examine]);
    }
    assert_eq!(script.machine.deaths(), 1);
    script
        .feed(Input::ConnectionLost, &[])
        .feed(Input::Refused, &[])
        .feed(Input::Connected, &[Action::Examine])
        .feed(Input::ConnectionLost, &[]);
    assert_eq!(script.machine.deaths(), 2, "it was gone, and came back");
    script
        .feed(Input::Wake, &[])
        .feed(Input::Connected, &[Action::Examine]);
    script.feed(Input::Answered, &[]);
    script.feed(Input::ConnectionLost, &[]);
    assert_eq!(script.machine.deaths(), 3, "another one had answered");
}

#[test]
fn a_session_that_has_nothing_to_lose_ends_if_no_master_can_be_started() {
    for (restored, pending, expected) in [
        (false, false, &[Action::GiveUp][..]),
        (false, true, &[]),
        (true, false, &[]),
    ] {
        let mut script = Script::new(Supervision::Ours);
        script
            .feed(
                Input::Start {
                    left: false,
                    restored,
                },
                &[Action::Spawn],
            )
            .feed(Input::SpawnFailed { pending }, expected);
    }
}

#[test]
fn the_mirror_stands_in_once_it_is_known_to_be_a_masters_state() {
    for (supervision, left, restored, expected) in [
        (Supervision::Ours, false, false, true),
        (Supervision::Ours, true, false, false),
        (Supervision::Theirs, false, false, false),
        (Supervision::Theirs, false, true, true),
    ] {
        let mut machine = Lifecycle::new(supervision, PROBING);
        machine.on(Instant::now(), Input::Start { left, restored });
        assert_eq!(machine.may_stand_in(), expected);
        machine.on(Instant::now(), Input::Connected);
        machine.on(Instant::now(), Input::Examined { new: true });
        assert!(machine.may_stand_in() && machine.has_served() && !machine.is_new_session());
    }
}
