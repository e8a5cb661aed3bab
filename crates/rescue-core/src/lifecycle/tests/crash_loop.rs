//! How often a master is restarted.

use super::*;

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
    assert!(!script.machine.crash_loop);
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
        .serve(true);
    for _ in 1..CALM.as_secs() {
        script
            .wake(PROBING.interval, &[Action::Probe])
            .feed(Input::ProbeAnswered, &[]);
    }
    script.wake(PROBING.interval, &[Action::ReportCalm]);
    script.now += DEATH_MEMORY * 2;
    script.feed(
        Input::Exited,
        &[Action::ShutGate(Cause::Exited), Action::Spawn],
    );
    assert_eq!(script.machine.deaths.len(), 1);
}

#[test]
fn a_master_that_cannot_be_spawned_is_retried_with_growing_pauses() {
    let mut script = Script::serving(Supervision::Ours);
    script
        .lose()
        .feed(Input::Refused, &[])
        .feed(Input::Exited, &[Action::Spawn]);
    for _ in 0..2 {
        for pause_ms in [500, 1_000, 2_000, 4_000, 8_000, 10_000, 10_000] {
            script
                .feed(Input::SpawnFailed { pending: true }, &[])
                .wake(Duration::from_millis(pause_ms), &[Action::Spawn]);
        }
        // A master that can be started ends the series.
        script
            .feed(Input::Spawned, &[Action::Connect])
            .serve(true)
            .lose()
            .feed(Input::Exited, &[Action::Spawn]);
    }
    assert_eq!(script.machine.deaths(), 3, "what never lived has not died");
}

#[test]
fn a_master_that_serves_for_a_moment_before_each_death_does_not_end_the_crash_loop() {
    let mut script = Script::serving(Supervision::Ours);
    for death in 1..20 {
        script.now += Duration::from_secs(2);
        let actions = script.machine.on(script.now, Input::Exited);
        assert_eq!(script.machine.crash_loop, death > DEATHS_AT_ONCE, "{death}");
        if !actions.contains(&Action::Spawn) {
            script.now = script.machine.deadline().expect("a pause");
            script.feed(Input::Wake, &[Action::Spawn]);
        }
        script.feed(Input::Spawned, &[Action::Connect]).serve(true);
    }
    assert_eq!(
        script.machine.deadline(),
        Some(script.now + PROBING.interval)
    );
    script.now += CALM;
    script.feed(Input::Wake, &[Action::ReportCalm]);
    assert!(!script.machine.crash_loop);
}

#[test]
fn the_crash_loop_of_an_external_master_is_said_once() {
    let mut script = Script::serving(Supervision::Theirs);
    for death in 1..=9 {
        let report = [Action::ReportCrashLoop(death)];
        let said = if death == DEATHS_AT_ONCE + 1 {
            &report[..]
        } else {
            &[]
        };
        match death % 3 {
            // The next master listens before it is checked for the first time.
            0 => {
                let actions = [Action::OpenGate].iter().chain(said).copied();
                script
                    .lose()
                    .feed(Input::Connected, &[Action::Examine])
                    .feed(Input::Examined { new: true }, &actions.collect::<Vec<_>>());
            }
            1 => {
                script
                    .lose()
                    .feed(Input::Refused, said)
                    .feed(Input::Refused, &[])
                    .feed(Input::Connected, &[Action::Examine]);
            }
            _ => {
                script
                    .feed(Input::ConnectionLost, said)
                    .feed(Input::Refused, &[])
                    .serve(true);
            }
        }
    }
    assert_eq!(script.machine.deaths(), 9);
    for _ in 0..3 {
        script.lose().serve(false);
    }
    assert_eq!(script.machine.deaths(), 9, "idle connections are closed");
    script.now += CALM;
    script.feed(Input::Wake, &[Action::ReportCalm]);
}

/// The number of starts within any minute is bounded, whatever the masters die of and whenever they do.
#[test]
fn the_rate_of_restarts_is_bounded() {
    const MOST: usize = 16;
    let lives = [0, 1, 100, 700, 2_000, 5_900, 9_900, 20_000].map(Duration::from_millis);
    for (number, first) in lives.into_iter().enumerate() {
        for second in lives.into_iter().skip(number) {
            let mut script = Script::serving(Supervision::Ours);
            let mut starts = vec![script.now];
            for life in [first, second].into_iter().cycle().take(200) {
                script.now += life;
                let actions = script.machine.on(script.now, Input::Exited);
                if !actions.contains(&Action::Spawn) {
                    script.now = script.machine.deadline().expect("a pause");
                    script.feed(Input::Wake, &[Action::Spawn]);
                }
                starts.push(script.now);
                script.feed(Input::Spawned, &[Action::Connect]).serve(true);
            }
            for from in &starts {
                let minute = *from..*from + DEATH_MEMORY;
                let count = starts.iter().filter(|at| minute.contains(at)).count();
                assert!(
                    count <= MOST,
                    "{count} within a minute: {first:?}, {second:?}"
                );
            }
        }
    }
}
