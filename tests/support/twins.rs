//! Sends the same requests to a bare master and to one behind rosrescue.

use ros1_master::xmlrpc::{Reply, Value};

use super::rescue::{Rescue, Setup};
use super::ros::Rosmaster;
use super::rpc::{Client, Response, encode_call, http_request};
use super::scratch::Scratch;

/// A bare rosmaster, and another one behind rosrescue.
pub(crate) struct Twins {
    pub(crate) bare: Client,
    pub(crate) through: Client,
    pub(crate) behind: Client,
    _rescue: Rescue,
    _masters: [Rosmaster; 2],
    _scratch: Scratch,
}

impl Twins {
    pub(crate) fn start() -> Self {
        Self::start_with(&[])
    }

    /// Like [`Self::start`], with further options for rosrescue.
    pub(crate) fn start_with(options: &[&str]) -> Self {
        let scratch = Scratch::new();
        let masters = [Rosmaster::start(&scratch), Rosmaster::start(&scratch)];
        let setup = Setup::proxy(&scratch, masters[1].port);
        let rescue = setup.args(options).start();
        Self {
            bare: masters[0].client(),
            through: rescue.client(),
            behind: masters[1].client(),
            _rescue: rescue,
            _masters: masters,
            _scratch: scratch,
        }
    }

    /// Sends the same bytes to both. Returns rosrescue's answer, or a description of the difference.
    pub(crate) fn compare(&self, request: &[u8]) -> Result<Response, String> {
        let shown = String::from_utf8_lossy(&request[..request.len().min(400)]).into_owned();
        let mut answers = Vec::new();
        for (who, client) in [
            ("the bare master", &self.bare),
            ("rosrescue", &self.through),
        ] {
            let mut wire = client.connect().unwrap();
            // A server may answer and close before it has read the whole request.
            let _ = wire.send(request);
            let answer = wire.response();
            answers.push(answer.map_err(|error| format!("{who}: {error}\n{shown}"))?);
        }
        if essence(&answers[0]) != essence(&answers[1]) {
            return Err(format!(
                "{:#?}\nfor\n{shown}",
                answers.iter().map(essence).collect::<Vec<_>>()
            ));
        }
        let through = answers.remove(1);
        assert_form(&through, &shown);
        Ok(through)
    }

    /// Sends the same bytes to both, which must give the same answer. Returns it.
    #[track_caller]
    pub(crate) fn same(&self, request: &[u8]) -> Response {
        self.compare(request)
            .unwrap_or_else(|difference| panic!("{difference}"))
    }

    /// Like [`Self::same`], for a call.
    #[track_caller]
    pub(crate) fn same_call(&self, method: &str, params: Vec<Value>) -> Reply {
        self.same(&http_request(&encode_call(method, params)))
            .reply()
    }
}

/// The part of an answer that must be the same: everything except dates and program names. rosmaster says HTTP/1.1 even
/// to HTTP/1.0 clients; a separate test covers the end of the connection, which matters to these clients.
fn essence(response: &Response) -> (String, Option<String>, Option<String>, String) {
    let header = |name| response.header(name).map(str::to_owned);
    (
        response.status["HTTP/1.x".len()..].to_owned(),
        header("content-type"),
        header("content-length"),
        response.text(),
    )
}

/// Checks what roscpp's HTTP parser requires: a length, with one space before it, and no chunks.
#[track_caller]
pub(crate) fn assert_form(response: &Response, shown: &str) {
    let lengths: Vec<_> = response
        .headers
        .iter()
        .filter(|line| line.to_ascii_lowercase().starts_with("content-length: "))
        .collect();
    assert_eq!(lengths.len(), 1, "{:?}\n{shown}", response.headers);
    assert_eq!(response.header("transfer-encoding"), None, "{shown}");
    if response.code == 200 {
        assert!(response.status.ends_with(" 200 OK"), "{}", response.status);
    }
}
