//! The state at an earlier time, for the page's time line. It comes from the log of changes, like that of
//! `rosrescue inspect --at`, and takes no lock that a call needs.

use std::{fs, path::Path, sync::Arc};

use checkpoint_store::change_log::{KnownTimes, PastState, oldest, past_state};
use hyper::StatusCode;
use rescue_core::checkpoint::compare::{Described, compare};
use serde::Serialize;

use super::{Asked, Pages, WholeState, in_background, robot::Robot, text};
use crate::{
    cli::When,
    clock,
    server::{Server, replies::HttpReply},
};

/// Maximum number of changes in one answer.
const CHANGES: usize = 1000;
/// Names of two states in the description of a change.
const NAMES: [&str; 2] = ["the earlier state", "the later state"];

/// What `/state.json` says about an earlier state besides its content.
#[derive(Debug, Default, Serialize)]
pub(super) struct Past {
    /// Time of the last change in the state, in seconds since 1970.
    at: f64,
    /// Time at which the log begins, in seconds since 1970.
    oldest: Option<f64>,
    /// Whether no change before that time is missing.
    exact: bool,
    /// Whether the clock was set back later: changes after this state have its time or an earlier one.
    set_back: bool,
    /// How the earlier of two states differs from the later one.
    changes: Vec<Described>,
    /// Number of changes that are left out.
    more_changes: usize,
}

pub(super) async fn state(server: &Arc<Server>, asked: Asked) -> HttpReply {
    let time = |text: &Option<String>| text.as_deref().map(str::parse).transpose();
    let (at, with) = match (time(&asked.at), time(&asked.with)) {
        (Ok(at), Ok(with)) => (at.unwrap_or(When::Now), with),
        (Err(why), _) | (_, Err(why)) => return text(StatusCode::BAD_REQUEST, why + "\n"),
    };
    let turn = server.pages.state.reading_past.clone();
    let Ok(mut known) = turn.try_lock_owned() else {
        return busy();
    };
    let server = server.clone();
    let work = move || match answer(&server.pages, &asked, at, with, &mut known) {
        Ok(reply) => reply,
        Err(why) => text(StatusCode::NOT_FOUND, why + "\n"),
    };
    in_background(work).await
}

/// The answer while the log is read for another request.
pub(super) fn busy() -> HttpReply {
    let why = "rosrescue is reading an earlier state; try again\n".to_owned();
    text(StatusCode::SERVICE_UNAVAILABLE, why)
}

fn answer(
    pages: &Pages,
    asked: &Asked,
    at: When,
    with: Option<When>,
    known: &mut KnownTimes,
) -> Result<HttpReply, String> {
    let path = Path::new(&pages.checkpoint);
    let path = fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
    let now = clock::wall_millis();
    // `now` stands for the end of the log, whatever the clock shows.
    let time = |when| match when {
        When::Now => u64::MAX,
        when => when.millis(now),
    };
    let begun = oldest(&path);
    let mut read = |when| {
        past_state(&path, time(when), known).map_err(|error| match begun {
            Some(begun) => format!(
                "{error}; the log begins at {}",
                clock::wall_text_millis(begun)
            ),
            None => error.to_string(),
        })
    };
    let found = read(at)?;
    let state = &found.moment.rebuilt.mirror;
    let mut changes = Vec::new();
    if let Some(with) = with {
        let other = read(with)?.moment.rebuilt.mirror;
        let (a, b) = match time(at) <= time(with) {
            true => (state, &other),
            false => (&other, state),
        };
        changes = compare(a, b, &pages.hide);
    }
    let past = Past {
        at: found.moment.at as f64 / 1e3,
        oldest: begun.map(|at| at as f64 / 1e3),
        exact: is_exact(&found),
        set_back: found.is_set_back,
        more_changes: changes.len().saturating_sub(CHANGES),
        changes: changes
            .into_iter()
            .take(CHANGES)
            .map(|change| change.described(NAMES))
            .collect(),
    };
    Ok(asked.answer(state.params(), &pages.hide, |params| {
        let robot = Robot::from_snapshot(state.snapshot());
        WholeState::new(found.moment.seq, robot, params, Some(past))
    }))
}

fn is_exact(found: &PastState) -> bool {
    found.moment.exact && found.moment.rebuilt.trouble.is_none() && found.unread.is_empty()
}
