use super::*;

const PROBING: Probing = Probing {
    interval: Duration::from_secs(1),
    count: 3,
};

/// Drives the machine along a virtual clock.
struct Script {
    machine: Lifecycle,
    now: Instant,
}

impl Script {
    fn new(supervision: Supervision) -> Self {
        Self {
            machine: Lifecycle::new(supervision, PROBING),
            now: Instant::now(),
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

    /// Jumps to the next deadline, which must lie `pause` ahead.
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
                .feed(Input::Start { remembered: false }, &[Action::Spawn])
                .feed(Input::Spawned, &[Action::Connect]),
            Supervision::Theirs => {
                script.feed(Input::Start { remembered: false }, &[Action::Connect])
            }
        };
        script
            .feed(Input::Connected, &[Action::Examine])
            .feed(Input::Examined, &[Action::OpenGate]);
        script
    }
}

#[test]
fn a_killed_child_is_replaced_at_once() {
    let mut script = Script::serving(Supervision::Ours);
    script
        .feed(
            Input::ConnectionLost,
            &[Action::ShutGate(Cause::ConnectionLost), Action::Connect],
        )
        .feed(Input::Refused, &[])
        .feed(Input::Exited, &[Action::Spawn])
        .feed(Input::Spawned, &[Action::Connect])
        .feed(Input::Refused, &[])
        .wake(Duration::from_millis(1), &[Action::Connect])
        .feed(Input::Connected, &[Action::Examine])
        .feed(Input::Examined, &[Action::OpenGate]);
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
fn an_idle_connection_that_the_master_closed_is_no_death() {
    let mut script = Script::serving(Supervision::Ours);
    script
        .feed(
            Input::ConnectionLost,
            &[Action::ShutGate(Cause::ConnectionLost), Action::Connect],
        )
        .feed(Input::Connected, &[Action::Examine])
        .feed(Input::Examined, &[Action::OpenGate]);
    assert_eq!(script.machine.recent_deaths(), 0);
}

#[test]
fn a_remembered_master_is_tried_first_and_replaced_when_it_is_gone() {
    let mut script = Script::new(Supervision::Ours);
    script
        .feed(Input::Start { remembered: true }, &[Action::Connect])
        .feed(Input::Refused, &[Action::Spawn]);
}

#[test]
fn an_external_master_is_waited_for_with_growing_pauses() {
    let mut script = Script::serving(Supervision::Theirs);
    script
        .feed(
            Input::ConnectionLost,
            &[Action::ShutGate(Cause::ConnectionLost), Action::Connect],
        )
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
fn a_crash_loop_is_slowed_down_and_reported_but_never_given_up() {
    let mut script = Script::serving(Supervision::Ours);
    script.feed(
        Input::Exited,
        &[Action::ShutGate(Cause::Exited), Action::Spawn],
    );
    for _ in 1..DEATHS_AT_ONCE {
        script
            .feed(Input::Spawned, &[Action::Connect])
            .feed(Input::Exited, &[Action::Spawn]);
    }
    for (deaths, pause_ms) in [(6, 500), (7, 1_000), (8, 2_000), (9, 4_000), (10, 8_000)] {
        script
            .feed(Input::Spawned, &[Action::Connect])
            .feed(Input::Exited, &[Action::ReportCrashLoop(deaths)])
            .wake(Duration::from_millis(pause_ms), &[Action::Spawn]);
    }
    script
        .feed(Input::Spawned, &[Action::Connect])
        .feed(Input::Exited, &[Action::ReportCrashLoop(11)])
        .wake(LONGEST_PAUSE, &[Action::Spawn])
        .feed(Input::Spawned, &[Action::Connect])
        .feed(Input::Connected, &[Action::Examine])
        .feed(Input::Examined, &[Action::OpenGate]);
    script.now += DEATH_MEMORY * 2;
    script.feed(
        Input::Exited,
        &[Action::ShutGate(Cause::Exited), Action::Spawn],
    );
    assert_eq!(script.machine.recent_deaths(), 1);
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
        .feed(Input::Connected, &[Action::Examine])
        .feed(Input::Examined, &[Action::OpenGate]);
}

#[test]
fn a_child_that_never_listens_is_killed() {
    let mut script = Script::new(Supervision::Ours);
    script
        .feed(Input::Start { remembered: false }, &[Action::Spawn])
        .feed(Input::Spawned, &[Action::Connect]);
    script.now += START_LIMIT + Duration::from_secs(1);
    script
        .feed(Input::Refused, &[Action::Kill])
        .feed(Input::Exited, &[Action::Spawn]);
}

#[test]
fn a_master_that_dies_while_it_is_examined_is_replaced_without_a_rush() {
    let mut script = Script::new(Supervision::Ours);
    script
        .feed(Input::Start { remembered: false }, &[Action::Spawn])
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
