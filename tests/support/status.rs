//! The status that rosrescue reports.

use serde_json::Value;

use super::rpc::Client;

const GET: &[u8] = b"GET /status.json HTTP/1.1\r\nHost: localhost\r\n\r\n";

/// Fetches `/status.json`.
#[track_caller]
pub(crate) fn status(client: &Client) -> Value {
    let response = client.exchange(GET).expect("the status page");
    serde_json::from_slice(&response.body).expect("JSON")
}

/// Fetches `/status.json`. `None` if rosrescue does not answer.
pub(crate) fn try_status(client: &Client) -> Option<Value> {
    let response = client.exchange(GET).ok()?;
    serde_json::from_slice(&response.body).ok()
}

/// The process id of the master to which calls pass, according to `status`. `None` while they pass to none.
pub(crate) fn open_to(status: &Value) -> Option<u32> {
    let pid = status["last_recovery"]["master_pid"].as_u64()?;
    (status["open"] == true).then(|| u32::try_from(pid).expect("a process id"))
}

/// The names in a list of the status.
pub(crate) fn names(list: &Value) -> Vec<String> {
    let list = list.as_array().cloned().unwrap_or_default();
    list.iter()
        .map(|name| name.as_str().expect("a name").to_owned())
        .collect()
}
