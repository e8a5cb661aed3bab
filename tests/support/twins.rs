//! A bare master and one behind rosrescue, asked the same.

use rosrescue::xmlrpc::{Reply, Value};

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
        let scratch = Scratch::new();
        let masters = [Rosmaster::start(&scratch), Rosmaster::start(&scratch)];
        let rescue = Setup::proxy(&scratch, masters[1].port).start();
        Self {
            bare: masters[0].client(),
            through: rescue.client(),
            behind: masters[1].client(),
            _rescue: rescue,
            _masters: masters,
            _scratch: scratch,
        }
    }

    /// Sends the same bytes to both and compares what comes back; gives the answer.
    #[track_caller]
    pub(crate) fn same(&self, request: &[u8]) -> Response {
        let shown = String::from_utf8_lossy(&request[..request.len().min(300)]).into_owned();
        let mut wires = [
            self.bare.connect().unwrap(),
            self.through.connect().unwrap(),
        ];
        let [bare, through] = [0, 1].map(|i| {
            // A server may answer and close before it has read everything.
            let _ = wires[i].send(request);
            let who = ["the bare master", "rosrescue"][i];
            wires[i]
                .response()
                .unwrap_or_else(|error| panic!("{who}: {error}\n{shown}"))
        });
        assert_eq!(
            essence(&bare),
            essence(&through),
            "the request was\n{shown}"
        );
        assert_form(&through, &shown);
        through
    }

    /// As [`Self::same`], for a call.
    #[track_caller]
    pub(crate) fn same_call(&self, method: &str, params: Vec<Value>) -> Reply {
        self.same(&http_request(&encode_call(method, params)))
            .reply()
    }
}

/// What of an answer must be the same: all that is not a date or a name of a program.
fn essence(response: &Response) -> (String, Option<String>, Option<String>, String) {
    let header = |name| response.header(name).map(str::to_owned);
    (
        response.status.clone(),
        header("content-type"),
        header("content-length"),
        response.text(),
    )
}

/// What roscpp's parser of HTTP needs: a length, with one space before it, and no pieces.
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
