//! Tests one situation at a time. `crate::cluster::tests` combines many.

use super::*;

const TTL: Duration = Duration::from_secs(2);

fn machine(alone: WhenAlone) -> (Machine, Instant) {
    let machine = Machine::new(Settings {
        name: "a".to_owned(),
        id: "a-1".to_owned(),
        uri: String::new(),
        boot: String::new(),
        version: String::new(),
        ttl: TTL,
        commit: Commit::Always,
        alone,
    });
    (machine, Instant::now())
}

fn ms(milliseconds: u64) -> Duration {
    Duration::from_millis(milliseconds)
}

/// The keys when `name` leads since revision `term`, and has written `alive` at `revision`.
fn led(name: &str, term: u64, revision: u64) -> View {
    View {
        revision,
        origin: 1,
        journal_number: 1,
        leader: Some(Leader {
            term,
            name: name.to_owned(),
            id: format!("{name}-1"),
            claim: 1,
            claimed_at: 0,
            uri: String::new(),
            boot: String::new(),
            version: String::new(),
        }),
        alive: Some(Alive {
            revision,
            beat: revision - term,
            seq: 10,
            released: None,
            settled: true,
        }),
    }
}

/// The request among `actions`.
fn sent(actions: &[Action]) -> (u64, Op) {
    let mut sent = actions.iter().filter_map(|action| match action {
        Action::Send { number, op } => Some((*number, op.clone())),
        _ => None,
    });
    sent.next()
        .unwrap_or_else(|| panic!("nothing is sent: {actions:?}"))
}

/// A machine that follows `b` and whose mirror is up to date.
fn following(alone: WhenAlone) -> (Machine, Instant) {
    let (mut machine, now) = machine(alone);
    let (number, op) = sent(&machine.on(now, Input::Start));
    assert_eq!(op, Op::Read);
    let answer = EtcdAnswer::Is(led("b", 5, 6));
    let actions = machine.on(now, Input::Answer { number, answer });
    let follows = [Action::Become(Role::Following), Action::CatchUp(10)];
    assert_eq!(actions, follows);
    machine.on(now, Input::Followed(10));
    (machine, now)
}

/// A machine that leads, and has sent nothing since `now`.
fn leading(alone: WhenAlone) -> (Machine, Instant) {
    let (mut machine, now) = machine(alone);
    let (number, _) = sent(&machine.on(now, Input::Start));
    let nobody = EtcdAnswer::Is(View::default());
    let claimed = machine.on(
        now,
        Input::Answer {
            number,
            answer: nobody,
        },
    );
    let (number, op) = sent(&claimed);
    let claim = Op::Claim {
        guard: RevisionGuard::default(),
        claim: 1,
        begins: Some(1),
        seq: 0,
        settled: false,
    };
    assert_eq!(op, claim);
    let (revision, seq) = (1, 0);
    let answer = EtcdAnswer::Applied { revision, seq };
    machine.on(now, Input::Answer { number, answer });
    assert_eq!(machine.role(), Role::CatchingUp);
    let goes_on = true;
    let actions = machine.on(now, Input::Decided { seq, goes_on });
    assert_eq!(actions, [Action::Become(Role::Leading)]);
    assert_eq!(machine.deadline(), Some(now + TTL / BEATS));
    (machine, now)
}

/// When the machine claims leadership, if it does `actions` at `now`, and etcd answers each read with `view`.
fn claims(
    machine: &mut Machine,
    mut now: Instant,
    mut actions: Vec<Action>,
    view: &View,
) -> Instant {
    loop {
        if actions.is_empty() {
            now = machine.deadline().unwrap();
            actions = machine.on(now, Input::Wake);
            continue;
        }
        let (number, op) = sent(&actions);
        if op != Op::Read {
            assert!(matches!(op, Op::Claim { .. }), "{op:?}");
            return now;
        }
        let answer = EtcdAnswer::Is(view.clone());
        actions = machine.on(now, Input::Answer { number, answer });
    }
}

#[test]
fn a_silent_leader_is_succeeded_after_its_time_and_not_before() {
    let (mut machine, now) = following(WhenAlone::Serve);
    let later = now + ms(1500);
    assert_eq!(machine.on(later, Input::View(led("b", 5, 7))), []);
    assert_eq!(machine.on(later + TTL - ms(1), Input::Wake), []);
    let (_, op) = sent(&machine.on(later + TTL, Input::Wake));
    let claim = Op::Claim {
        guard: RevisionGuard {
            origin: 1,
            leader: 5,
            alive: 7,
            seq: 10,
        },
        claim: 1,
        begins: None,
        seq: 10,
        // This computer has seen the previous leader lead.
        settled: true,
    };
    assert_eq!(op, claim);
}

/// Seed 3042947.
#[test]
fn who_has_not_heard_of_etcd_for_twice_the_time_to_live_reads_first_and_claims_later() {
    let (mut machine, now) = following(WhenAlone::Serve);
    let (_, op) = sent(&machine.on(now + TTL, Input::Wake));
    assert!(matches!(op, Op::Claim { .. }), "{op:?}");
    let given_up = now + TTL + ANSWER_LIMIT + RETRY;
    machine.on(given_up, Input::Wake);
    let (number, op) = sent(&machine.on(given_up + RETRY, Input::Wake));
    assert_eq!(op, Op::Read);
    let answer = EtcdAnswer::Is(led("b", 5, 6));
    let answered = given_up + 2 * RETRY;
    let actions = machine.on(answered, Input::Answer { number, answer });
    let claimed = claims(&mut machine, answered, actions, &led("b", 5, 6));
    assert_eq!(claimed - answered, TTL);
}

/// Seed 26336186.
#[test]
fn who_has_paused_for_a_time_to_live_reads_first_and_claims_later() {
    let (mut machine, now) = following(WhenAlone::Serve);
    let resumed = now + TTL + TTL / 2;
    // What arrives first may be old.
    let (number, op) = sent(&machine.on(resumed, Input::View(led("b", 5, 6))));
    assert_eq!(op, Op::Read);
    let answer = EtcdAnswer::Is(led("b", 5, 6));
    let actions = machine.on(resumed, Input::Answer { number, answer });
    let claimed = claims(&mut machine, resumed, actions, &led("b", 5, 6));
    assert_eq!(claimed - resumed, TTL);
}

/// Its keys may just have been deleted, and this computer may not have read the journal.
#[test]
fn who_starts_and_finds_an_etcd_in_use_without_a_leader_claims_after_the_time_to_live() {
    let first_claim = |revision| {
        let (mut machine, now) = machine(WhenAlone::Serve);
        let (number, _) = sent(&machine.on(now, Input::Start));
        let bare = View {
            revision,
            ..View::default()
        };
        let answer = EtcdAnswer::Is(bare.clone());
        let actions = machine.on(now, Input::Answer { number, answer });
        claims(&mut machine, now, actions, &bare) - now
    };
    assert_eq!(first_claim(1), Duration::ZERO);
    assert_eq!(first_claim(29), TTL);
}

#[test]
fn an_earlier_process_of_this_computer_is_succeeded_at_once() {
    let (mut machine, now) = machine(WhenAlone::Serve);
    let (number, _) = sent(&machine.on(now, Input::Start));
    let mut before = led("a", 5, 6);
    before.leader.as_mut().unwrap().id = "a-0".to_owned();
    let answer = EtcdAnswer::Is(before);
    let (_, op) = sent(&machine.on(now, Input::Answer { number, answer }));
    assert!(matches!(op, Op::Claim { .. }), "{op:?}");
}

#[test]
fn a_computer_of_the_same_name_at_another_address_is_not_deposed_while_it_lives() {
    let (mut machine, now) = machine(WhenAlone::Serve);
    let (number, _) = sent(&machine.on(now, Input::Start));
    let namesake = |revision| {
        let mut view = led("a", 5, revision);
        let leader = view.leader.as_mut().unwrap();
        leader.id = "a-elsewhere".to_owned();
        leader.uri = "http://10.0.0.9:11311/".to_owned();
        view
    };
    let answer = EtcdAnswer::Is(namesake(6));
    let actions = machine.on(now, Input::Answer { number, answer });
    assert_eq!(machine.role(), Role::Following, "{actions:?}");
    for beat in 1..9 {
        let now = now + beat * TTL / BEATS;
        let actions = machine.on(now, Input::View(namesake(6 + u64::from(beat))));
        assert_eq!(actions, []);
    }
    // A silent namesake is succeeded like any other leader.
    let (_, op) = sent(&machine.on(now + 3 * TTL, Input::Wake));
    assert!(matches!(op, Op::Claim { .. }), "{op:?}");
}

#[test]
fn who_is_named_by_a_leader_that_gives_up_goes_first() {
    for (to, after) in [("a", ms(0)), ("", ms(0)), ("c", TTL / BEATS)] {
        let (mut machine, now) = following(WhenAlone::Serve);
        let mut view = led("b", 5, 7);
        view.alive.as_mut().unwrap().released = Some(to.to_owned());
        let actions = machine.on(now, Input::View(view));
        assert_eq!(actions.is_empty(), after > ms(0), "{to}: {actions:?}");
        if after > ms(0) {
            sent(&machine.on(now + after, Input::Wake));
        }
    }
}

#[test]
fn writes_travel_in_one_transaction_after_the_one_that_is_under_way() {
    let (mut machine, now) = leading(WhenAlone::Serve);
    let (number, op) = sent(&machine.on(now, Input::Recorded(1)));
    assert!(
        matches!(
            op,
            Op::Beat {
                beat: 1,
                seq: 1,
                ..
            }
        ),
        "{op:?}"
    );
    assert_eq!(machine.on(now, Input::Recorded(2)), []);
    assert_eq!(machine.on(now, Input::Recorded(3)), []);
    let (revision, seq) = (2, 1);
    let answer = EtcdAnswer::Applied { revision, seq };
    let actions = machine.on(now, Input::Answer { number, answer });
    assert_eq!(actions[0], Action::Acknowledge(1));
    let (_, op) = sent(&actions);
    assert!(
        matches!(
            op,
            Op::Beat {
                beat: 2,
                seq: 3,
                ..
            }
        ),
        "{op:?}"
    );
}

#[test]
fn an_answer_that_was_lost_is_seen_in_the_keys() {
    let (mut machine, now) = leading(WhenAlone::Serve);
    let (number, first) = sent(&machine.on(now, Input::Recorded(1)));
    let answer = EtcdAnswer::Silence;
    assert_eq!(machine.on(now, Input::Answer { number, answer }), []);
    let (number, again) = sent(&machine.on(now + RETRY, Input::Wake));
    assert_eq!(again, first);
    let mut made = led("a", 1, 2);
    made.alive.as_mut().unwrap().seq = 1;
    let answer = EtcdAnswer::Is(made);
    let actions = machine.on(now + RETRY, Input::Answer { number, answer });
    assert_eq!(actions, [Action::Acknowledge(1)]);
}

#[test]
fn a_leader_that_hears_nothing_acknowledges_nothing_and_is_alone_after_a_while() {
    for (alone, answers) in [(WhenAlone::Serve, true), (WhenAlone::Refuse, false)] {
        let (mut machine, now) = leading(alone);
        sent(&machine.on(now, Input::Recorded(1)));
        // No other computer can lead before the time to live has passed.
        assert!(machine.may_have_master());
        assert_eq!(machine.deadline(), Some(now + TTL));
        machine.on(now + TTL, Input::Wake);
        assert!(!machine.may_have_master());
        // The leader waits longer, because etcd may be electing its own leader.
        let lapses = now + TTL + PATIENCE;
        assert_eq!(machine.deadline(), Some(lapses));
        assert!(!machine.is_sole(now + TTL - TTL / MARGIN));
        let actions = machine.on(lapses, Input::Wake);
        assert_eq!(actions[0], Action::Become(Role::Alone));
        assert_eq!(actions.contains(&Action::Acknowledge(1)), answers);
        // Another computer leads, so this one hands back the writes that it answered.
        let actions = machine.on(lapses, Input::View(led("b", 5, 6)));
        let hands_back = Action::HandBack {
            committed: 0,
            acknowledged: u64::from(answers),
        };
        assert_eq!(actions[0], hands_back);
        assert_eq!(actions[1], Action::Become(Role::Following));
    }
}

#[test]
fn a_leader_whose_etcd_comes_back_unchanged_goes_on() {
    let (mut machine, now) = leading(WhenAlone::Serve);
    let (number, _) = sent(&machine.on(now, Input::Recorded(1)));
    let late = now + TTL + PATIENCE;
    wake_until(&mut machine, late);
    assert_eq!(machine.role(), Role::Alone);
    let answer = EtcdAnswer::Silence;
    machine.on(late, Input::Answer { number, answer });
    let (number, _) = sent(&machine.on(late + RETRY, Input::Wake));
    let (revision, seq) = (2, 1);
    let answer = EtcdAnswer::Applied { revision, seq };
    let actions = machine.on(late + RETRY, Input::Answer { number, answer });
    // The successful beat was sent more than the time to live ago. Only the next one shows that this computer leads.
    let (number, _) = sent(&actions);
    assert_eq!(machine.role(), Role::Alone);
    let (revision, seq) = (3, 1);
    let answer = EtcdAnswer::Applied { revision, seq };
    let actions = machine.on(late + ms(200), Input::Answer { number, answer });
    assert_eq!(actions, [Action::Become(Role::Leading)]);
    assert!(machine.may_have_master());
}

/// With `--alone refuse` a leader records nothing while it is cut off, and starts again after the journal's last
/// record.
#[test]
fn a_leader_that_refused_to_serve_alone_does_not_wait_for_records_that_it_gave_up() {
    let (mut machine, now) = leading(WhenAlone::Refuse);
    let (number, _) = sent(&machine.on(now, Input::Recorded(3)));
    let late = now + TTL + PATIENCE;
    wake_until(&mut machine, late);
    assert_eq!(machine.role(), Role::Alone);
    // The first record is in the journal.
    let (revision, seq) = (2, 1);
    let answer = EtcdAnswer::Applied { revision, seq };
    let actions = machine.on(late, Input::Answer { number, answer });
    let (number, _) = sent(&actions);
    let (revision, seq) = (3, 1);
    let answer = EtcdAnswer::Applied { revision, seq };
    let actions = machine.on(late + ms(200), Input::Answer { number, answer });
    let hands_back = Action::HandBack {
        committed: 1,
        acknowledged: 1,
    };
    assert_eq!(actions, [hands_back, Action::Become(Role::Leading)]);
    assert_eq!(machine.deadline(), Some(late + TTL / BEATS));
    // This leader can hand over.
    let (_, op) = sent(&machine.on(late + ms(200), Input::HandOver(String::new())));
    assert!(
        matches!(
            op,
            Op::Beat {
                released: Some(_),
                ..
            }
        ),
        "{op:?}"
    );
}

#[test]
fn a_leader_that_etcd_answers_late_goes_on_as_if_nothing_had_been() {
    let (mut machine, now) = leading(WhenAlone::Serve);
    let (number, _) = sent(&machine.on(now, Input::Recorded(1)));
    let (revision, seq) = (2, 1);
    let answer = EtcdAnswer::Applied { revision, seq };
    let actions = machine.on(now + TTL + ms(200), Input::Answer { number, answer });
    assert_eq!(actions[0], Action::Acknowledge(1));
    assert_eq!(machine.role(), Role::Leading);
}

/// Wakes the machine at each of its deadlines until `end`.
fn wake_until(machine: &mut Machine, end: Instant) {
    while let Some(due) = machine.deadline().filter(|due| *due < end) {
        machine.on(due, Input::Wake);
    }
    machine.on(end, Input::Wake);
}

/// Without a pause of its process, a leader is alone after the same time.
#[test]
fn a_leader_that_stood_still_asks_etcd_before_it_is_alone() {
    let long = 5 * TTL;
    let (mut machine, now) = leading(WhenAlone::Serve);
    wake_until(&mut machine, now + long);
    assert_eq!(machine.role(), Role::Alone);
    assert_eq!(machine.lease(now + long), None);

    let (mut machine, now) = leading(WhenAlone::Serve);
    assert!(machine.lease(now).is_some_and(|until| until > now));
    let (number, op) = sent(&machine.on(now + long, Input::Wake));
    assert!(matches!(op, Op::Beat { .. }));
    assert_eq!(machine.role(), Role::Leading);
    let lease = machine.lease(now + long);
    assert!(
        lease.is_some_and(|until| until <= now + long),
        "it may not act"
    );
    let answer = EtcdAnswer::Is(led("b", 5, 6));
    let actions = machine.on(now + long, Input::Answer { number, answer });
    assert!(actions.contains(&Action::Become(Role::Following)));
    assert_eq!(machine.lease(now + long), Some(now + long));

    // If etcd does not answer, the leader is alone after all.
    let (mut machine, now) = leading(WhenAlone::Serve);
    machine.on(now + long, Input::Wake);
    wake_until(&mut machine, now + long + PATIENCE);
    assert_eq!(machine.role(), Role::Alone);
}

#[test]
fn a_follower_without_etcd_goes_on_while_the_leader_says_that_it_leads() {
    let (mut machine, now) = following(WhenAlone::Serve);
    machine.on(now, Input::Peer(true));
    let long = now + 10 * TTL;
    wake_until(&mut machine, long);
    assert_eq!(machine.role(), Role::Following);
    let actions = machine.on(long, Input::Peer(false));
    assert_eq!(actions[0], Action::Become(Role::Alone));
    machine.on(long, Input::Recorded(11));
    let actions = machine.on(long + TTL, Input::Peer(true));
    let hands_back = Action::HandBack {
        committed: 10,
        acknowledged: 11,
    };
    assert_eq!(actions[0], hands_back);
    assert_eq!(machine.role(), Role::Following);
}

#[test]
fn a_follower_that_cannot_reach_a_leader_that_lives_is_alone_after_a_while() {
    let (mut machine, now) = following(WhenAlone::Serve);
    machine.on(now, Input::Peer(false));
    let mut at = now;
    for revision in 7..20 {
        at += TTL / BEATS;
        machine.on(at, Input::View(led("b", 5, revision)));
    }
    assert_eq!(machine.role(), Role::Alone);
    // This computer does not claim, because the leader lives.
    assert!(machine.deadline().is_some_and(|deadline| deadline > at));
}

#[test]
fn who_gives_up_commits_all_first_and_takes_no_more() {
    let (mut machine, now) = leading(WhenAlone::Serve);
    let (number, _) = sent(&machine.on(now, Input::Recorded(1)));
    machine.on(now, Input::HandOver(String::new()));
    let (revision, seq) = (2, 1);
    let answer = EtcdAnswer::Applied { revision, seq };
    let (number, op) = sent(&machine.on(now, Input::Answer { number, answer }));
    let released = Some(String::new());
    assert!(matches!(op, Op::Beat { released: of, .. } if of == released));
    let (revision, seq) = (3, 1);
    let answer = EtcdAnswer::Applied { revision, seq };
    let actions = machine.on(now, Input::Answer { number, answer });
    assert_eq!(actions[0], Action::Become(Role::Following));
    assert_eq!(actions.last(), Some(&Action::Released));
    // This computer does not claim again while another one may.
    assert_eq!(machine.on(now + TTL - ms(1), Input::Wake), []);
}

/// A machine that was switched on with all others, and whose claim succeeded at revision 7. The journal and the keys
/// are those of the previous session.
fn claimed() -> (Machine, Instant) {
    let (mut machine, now) = machine(WhenAlone::Serve);
    let (number, _) = sent(&machine.on(now, Input::Start));
    let answer = EtcdAnswer::Is(led("b", 5, 6));
    machine.on(now, Input::Answer { number, answer });
    machine.on(now, Input::Followed(10));
    let (number, op) = sent(&machine.on(now + TTL, Input::Wake));
    assert!(matches!(op, Op::Claim { settled: false, .. }), "{op:?}");
    let (revision, seq) = (7, 10);
    let answer = EtcdAnswer::Applied { revision, seq };
    machine.on(now + TTL, Input::Answer { number, answer });
    (machine, now + TTL)
}

/// The keys that a leader writes before it has decided whether the session continues.
fn undecided(name: &str, term: u64, revision: u64) -> View {
    let mut view = led(name, term, revision);
    view.alive.as_mut().unwrap().settled = false;
    view
}

#[test]
fn who_claims_leads_when_it_is_decided_whether_the_session_goes_on_and_not_before() {
    for (goes_on, session) in [
        (true, JournalSession::GoesOn),
        (false, JournalSession::Over(10)),
    ] {
        let (mut machine, now) = claimed();
        // The watch shows this computer's own claim, and the mirror has the whole journal.
        let mut view = undecided("a", 7, 7);
        view.alive.as_mut().unwrap().beat = 0;
        assert_eq!(machine.on(now, Input::View(view)), []);
        assert_eq!(machine.on(now, Input::Followed(10)), []);
        let (_, op) = sent(&machine.on(now + TTL / BEATS, Input::Wake));
        assert!(matches!(op, Op::Beat { settled: false, .. }), "{op:?}");
        let decided = Input::Decided { seq: 10, goes_on };
        let actions = machine.on(now + TTL / BEATS, decided);
        assert_eq!(actions, [Action::Become(Role::Leading)]);
        assert_eq!(machine.session(), session);
    }
}

#[test]
fn a_session_that_is_over_ends_once() {
    let (mut machine, now) = claimed();
    let (seq, goes_on) = (10, false);
    machine.on(now, Input::Decided { seq, goes_on });
    let (number, op) = sent(&machine.on(now, Input::Recorded(11)));
    // The empty state is the next record.
    assert!(matches!(op, Op::Beat { settled: true, .. }), "{op:?}");
    let (revision, seq) = (8, 11);
    let answer = EtcdAnswer::Applied { revision, seq };
    machine.on(now, Input::Answer { number, answer });
    assert_eq!(machine.session(), JournalSession::GoesOn);
    // Another computer leads for a while.
    let mut view = led("b", 9, 10);
    view.alive.as_mut().unwrap().seq = 11;
    machine.on(now, Input::View(view));
    machine.on(now, Input::Followed(11));
    let (number, op) = sent(&machine.on(now + TTL, Input::Wake));
    assert!(matches!(op, Op::Claim { settled: true, .. }), "{op:?}");
    let (revision, seq) = (11, 11);
    let answer = EtcdAnswer::Applied { revision, seq };
    let actions = machine.on(now + TTL, Input::Answer { number, answer });
    assert_eq!(actions.last(), Some(&Action::Become(Role::Leading)));
    assert_eq!(machine.session(), JournalSession::GoesOn);
}

#[test]
fn what_was_not_decided_before_another_one_leads_is_decided_by_that_one() {
    let (mut machine, now) = claimed();
    let (seq, goes_on) = (10, false);
    machine.on(now, Input::Decided { seq, goes_on });
    // Before the empty state is in the journal, a computer that has not decided either deposes this one.
    machine.on(now, Input::View(undecided("b", 8, 8)));
    assert_eq!(machine.session(), JournalSession::Over(10));
    machine.on(now, Input::View(undecided("b", 8, 9)));
    assert_eq!(machine.session(), JournalSession::Over(10));
    machine.on(now, Input::View(led("b", 8, 10)));
    assert_eq!(machine.session(), JournalSession::GoesOn);
}

#[test]
fn a_claim_of_another_computer_does_not_say_that_the_session_goes_on() {
    let (mut machine, now) = machine(WhenAlone::Serve);
    let (number, _) = sent(&machine.on(now, Input::Start));
    // The keys of the previous session.
    let answer = EtcdAnswer::Is(led("b", 5, 6));
    machine.on(now, Input::Answer { number, answer });
    machine.on(now, Input::View(undecided("c", 7, 7)));
    machine.on(now, Input::View(undecided("c", 7, 8)));
    assert_eq!(machine.session(), JournalSession::Unknown);
    machine.on(now, Input::View(led("c", 7, 9)));
    assert_eq!(machine.session(), JournalSession::GoesOn);
    // A late decision changes nothing.
    let (seq, goes_on) = (10, false);
    machine.on(now, Input::Decided { seq, goes_on });
    assert_eq!(machine.session(), JournalSession::GoesOn);
}

#[test]
fn a_leader_that_gives_up_leadership_acknowledges_nothing_that_the_journal_lacks() {
    let (mut machine, now) = leading(WhenAlone::Serve);
    machine.settings.commit = Commit::Interval;
    let before = machine.on(now + ms(1), Input::Recorded(1));
    assert!(before.contains(&Action::Acknowledge(1)), "{before:?}");
    machine.on(now + ms(2), Input::HandOver(String::new()));
    let after = machine.on(now + ms(3), Input::Recorded(2));
    assert!(!after.contains(&Action::Acknowledge(2)), "{after:?}");
}
