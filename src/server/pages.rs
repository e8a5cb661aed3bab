//! The page, the status and the metrics, by GET on the port that nodes use. Read-only.
//!
//! | path | answer |
//! |---|---|
//! | `/` | the page for a browser, the status as text for other clients |
//! | `/status.json` | the status as JSON, with the report of the last recovery |
//! | `/state.json` | nodes, topics, services and parameters, now or at an earlier time |
//! | `/history.json` | when nodes died and restarted |
//! | `/events` | what changes, as it happens |
//! | `/metrics` | metrics in Prometheus' text format, or OpenMetrics |
//! | `/live` | 200 while rosrescue runs |
//! | `/ready` | 200 while calls are answered, by the master, the mirror or another computer, else 503 |

mod events;
mod history;
mod params;
mod past;
mod robot;
pub(crate) mod status;

use std::sync::Arc;

use checkpoint_store::change_log::KnownTimes;
use hyper::{
    HeaderMap, StatusCode, Uri,
    header::{
        ACCEPT, CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, HeaderName, HeaderValue,
        REFERRER_POLICY, VARY, X_CONTENT_TYPE_OPTIONS,
    },
};
use rescue_core::hide::Hide;
use ros1_master::{master::Master, xmlrpc::Struct};
use serde::Serialize;
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;

use self::{events::Feed, params::Members, past::Past, robot::Robot, status::Rate};
use super::{
    Server,
    clients::Clients,
    replies::{HttpReply, page as reply, text},
};
use crate::{
    gate,
    ledger::Ledger,
    nodes::Nodes,
    printable::plain_json,
    process::usage,
    status::{
        Board,
        metrics::{metrics, openmetrics},
        stats::Stats,
        summary::Status,
    },
    upstream::Upstream,
};

const HTML: &str = "text/html; charset=utf-8";
const JSON: &str = "application/json";
const OPENMETRICS: &str = "application/openmetrics-text";
const OPENMETRICS_1: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// Version of `/state.json`. It changes when a field is removed or changes its meaning.
const SCHEMA: u32 = 1;
/// Maximum number of nodes, topics or services in `/state.json`.
const LISTED: usize = 5000;
/// Maximum number of characters of a query value.
const ASKED: usize = 500;

/// Content security policy: a page may only load its own script, style and data.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; \
                      img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// Headers of every page.
const HEADERS: [(HeaderName, &str); 5] = [
    (CONTENT_SECURITY_POLICY, POLICY),
    (X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (REFERRER_POLICY, "no-referrer"),
    (CACHE_CONTROL, "no-store"),
    (VARY, "Accept"),
];

pub struct Pages {
    /// Address that nodes use as `ROS_MASTER_URI`.
    pub uri: String,
    pub checkpoint: String,
    pub upstream: Arc<Upstream>,
    pub gate: gate::Rx,
    pub ledger: Arc<Ledger>,
    pub nodes: Arc<Nodes>,
    pub board: Arc<Board>,
    pub clients: Arc<Clients>,
    pub stats: &'static Stats,
    pub(crate) rate: Rate,
    /// Parameters whose values are hidden.
    pub hide: Hide,
    /// Ends the event streams.
    pub stop: CancellationToken,
    /// The state that pages share.
    pub(crate) state: PageState,
}

/// The state that pages share.
#[derive(Debug)]
pub(crate) struct PageState {
    feed: Feed,
    /// Permit to build the whole state, which happens one request at a time.
    reading: Semaphore,
    /// Permit to read earlier states, which happens for one request at a time, even if its client has gone.
    reading_past: Arc<tokio::sync::Mutex<KnownTimes>>,
}

impl Default for PageState {
    fn default() -> Self {
        Self {
            feed: Feed::default(),
            reading: Semaphore::new(1),
            reading_past: Arc::default(),
        }
    }
}

/// The answer to a GET of `uri`.
pub(super) async fn page(server: &Arc<Server>, uri: &Uri, headers: &HeaderMap) -> HttpReply {
    let mut reply = answer(server, uri, headers).await;
    for (name, value) in HEADERS {
        reply
            .headers_mut()
            .insert(name, HeaderValue::from_static(value));
    }
    reply
}

async fn answer(server: &Arc<Server>, uri: &Uri, headers: &HeaderMap) -> HttpReply {
    let pages = &server.pages;
    match uri.path() {
        // A browser. curl accepts any type.
        "/" if accepts(headers, "text/html") => {
            reply(StatusCode::OK, HTML, include_str!("pages/web/page.html"))
        }
        "/" => present_status(server, |status| text(StatusCode::OK, status.to_string())).await,
        "/page.css" => reply(StatusCode::OK, "text/css", include_str!("pages/web/page.css")),
        "/page.js" => script(include_str!("pages/web/page.js")),
        "/graph.js" => script(include_str!("pages/web/graph.js")),
        "/time.js" => script(include_str!("pages/web/time.js")),
        "/overview.js" => script(include_str!("pages/web/overview.js")),
        "/layout.js" => script(include_str!("pages/web/layout.js")),
        "/dagre.js" => script(include_str!("pages/web/vendor/dagre.js")),
        "/status.json" => {
            present_status(server, |status| json(serde_json::to_string_pretty(&status))).await
        }
        "/state.json" => match Asked::read(uri) {
            asked @ Asked { at: Some(_), .. } => past::state(server, asked).await,
            asked => state(server, asked).await,
        },
        "/history.json" => history::history(server, Asked::read(uri)).await,
        "/events" => {
            let mut events = events::listen(server);
            if events.status() == StatusCode::OK {
                let kind = HeaderValue::from_static("text/event-stream");
                events.headers_mut().insert(CONTENT_TYPE, kind);
            }
            events
        }
        "/metrics" => {
            let (server, open) = (server.clone(), accepts(headers, OPENMETRICS));
            // The kernel counts the open file descriptors.
            in_background(move || {
                let status = server.pages.status();
                let text = metrics(server.pages.stats, &status, &usage(status.started));
                match open {
                    true => reply(StatusCode::OK, OPENMETRICS_1, openmetrics(&text)),
                    false => reply(StatusCode::OK, "text/plain; version=0.0.4", text),
                }
            })
            .await
        }
        "/live" => text(StatusCode::OK, "live\n".to_owned()),
        "/ready" if pages.board.read().answers_calls(pages.gate.state()) => {
            text(StatusCode::OK, "ready\n".to_owned())
        }
        "/ready" => text(
            StatusCode::SERVICE_UNAVAILABLE,
            "no master was ever seen, here or on another computer: calls wait for one\n".to_owned(),
        ),
        _ => text(
            StatusCode::NOT_FOUND,
            "no such page; there are /, /status.json, /state.json, /history.json, /events, /metrics, /live and /ready\n"
                .to_owned(),
        ),
    }
}

/// Whether the client names this type.
fn accepts(headers: &HeaderMap, kind: &str) -> bool {
    let accepted = headers.get_all(ACCEPT).into_iter();
    let mut accepted = accepted.filter_map(|accepted| accepted.to_str().ok());
    accepted.any(|accepted| accepted.contains(kind))
}

fn script(text: &'static str) -> HttpReply {
    reply(StatusCode::OK, "text/javascript", text)
}

fn json(text: serde_json::Result<String>) -> HttpReply {
    match text {
        // People read pages with curl on a terminal, too.
        Ok(json) => reply(StatusCode::OK, JSON, plain_json(json) + "\n"),
        Err(error) => super::replies::text(StatusCode::INTERNAL_SERVER_ERROR, format!("{error}\n")),
    }
}

/// The query of a page.
#[derive(Debug, Default)]
struct Asked {
    /// Show only the parameters in this namespace.
    params: Option<String>,
    /// Show only the parameters with this text in their names.
    search: Option<String>,
    /// Show the state at this time.
    at: Option<String>,
    /// Show also how that state differs from the one at this time.
    with: Option<String>,
    /// Show what happened since this time.
    since: Option<String>,
}

impl Asked {
    fn read(uri: &Uri) -> Self {
        let mut asked = Self::default();
        let query = uri.query().unwrap_or_default();
        for (name, value) in form_urlencoded::parse(query.as_bytes()) {
            let value = value.chars().take(ASKED).collect();
            match &*name {
                "params" => asked.params = Some(value),
                "search" => asked.search = Some(value),
                "at" => asked.at = Some(value),
                "with" => asked.with = Some(value),
                "since" => asked.since = Some(value),
                _ => {}
            }
        }
        asked
    }

    /// Answers with a part of the parameters, or with what `whole` makes of the first of them.
    fn answer(
        &self,
        params: &Struct,
        hide: &Hide,
        whole: impl FnOnce(Members) -> WholeState,
    ) -> HttpReply {
        match (&self.params, &self.search) {
            (_, Some(search)) => json(serde_json::to_string(&params::search(params, search, hide))),
            (Some(name), _) => match params::members(params, name, hide) {
                Some(members) => json(serde_json::to_string(&members)),
                None => text(
                    StatusCode::NOT_FOUND,
                    "there is no such namespace\n".to_owned(),
                ),
            },
            (None, None) => {
                let members = params::members(params, "", hide).unwrap_or_default();
                json(serde_json::to_string(&whole(members)))
            }
        }
    }
}

/// The content of `/state.json`.
#[derive(Debug, Serialize)]
struct WholeState {
    schema: u32,
    /// Version of the state, as in the events of `/events`.
    version: u64,
    registrations: u64,
    /// Numbers of registered items. The lists may be shorter.
    totals: Totals,
    #[serde(flatten)]
    robot: Robot,
    params: Members,
    /// For an earlier state.
    #[serde(flatten)]
    past: Option<Past>,
}

impl WholeState {
    fn new(version: u64, mut robot: Robot, params: Members, past: Option<Past>) -> Self {
        let registrations = robot.digest();
        let totals = Totals {
            nodes: robot.nodes.len(),
            topics: robot.topics.len(),
            services: robot.services.len(),
        };
        robot.nodes.truncate(LISTED);
        robot.topics.truncate(LISTED);
        robot.services.truncate(LISTED);
        Self {
            schema: SCHEMA,
            version,
            registrations,
            totals,
            robot,
            params,
            past,
        }
    }
}

#[derive(Debug, Serialize)]
struct Totals {
    nodes: usize,
    topics: usize,
    services: usize,
}

async fn state(server: &Arc<Server>, asked: Asked) -> HttpReply {
    // The semaphore is never closed.
    let _turn = server.pages.state.reading.acquire().await;
    let server = server.clone();
    let work = move || {
        let pages = &server.pages;
        let version = pages.ledger.version();
        let mirror = pages.ledger.with_mirror(Master::clone);
        asked.answer(mirror.params(), &pages.hide, |params| {
            let robot = Robot::read(&pages.ledger, &pages.nodes);
            WholeState::new(version, robot, params, None)
        })
    };
    in_background(work).await
}

/// Shows the present status. With many nodes it takes long to collect.
async fn present_status(server: &Arc<Server>, show: fn(Status) -> HttpReply) -> HttpReply {
    let server = server.clone();
    in_background(move || show(server.pages.status())).await
}

/// Makes an answer in a thread that may block.
async fn in_background(work: impl FnOnce() -> HttpReply + Send + 'static) -> HttpReply {
    let made = crate::task::spawn_blocking(work).await;
    made.unwrap_or_else(|error| text(StatusCode::INTERNAL_SERVER_ERROR, format!("{error}\n")))
}
