//! Reads and changes the running master through ordinary Master API calls.

use std::{fmt::Display, time::Duration};

use rescue_core::replay::Token;
use ros1_master::{
    master::{Master, Request},
    xmlrpc::{Reply, Value},
};
use tokio::time::{Instant, timeout};

use super::{
    CommandFailure,
    running::{self, Running},
};
use crate::upstream::{Connection, inspect};

/// Longest time for an answer. rosmaster needs half a minute for `getParam('/')` with a million parameters.
const ANSWER_LIMIT: Duration = Duration::from_secs(120);
/// Largest answer, in bytes.
const MAX_REPLY: usize = 512 << 20;

/// A connection to the running rosrescue.
pub(super) struct Live {
    connection: Connection,
    pub(super) uri: String,
}

impl Live {
    pub(super) async fn connect(running: &Running) -> Result<Self, CommandFailure> {
        let address = &running.address;
        let stream = running
            .connect(Instant::now() + running::ANSWER_LIMIT)
            .await?;
        let connection = Connection::over(stream, address, MAX_REPLY).await;
        Ok(Self {
            connection: connection.map_err(|error| running.nobody(error.to_string()))?,
            uri: address.to_string(),
        })
    }

    /// Reads the master's state. Parameter subscriptions cannot be read. They are taken from `previous` for nodes whose
    /// address is the same.
    pub(super) async fn state(&mut self, previous: &Master) -> Result<Master, CommandFailure> {
        // No master has this token.
        let token = Token::new("", 0);
        let uri = self.uri.clone();
        let failed = |why: &dyn Display| {
            CommandFailure::Failed(format!("cannot read the master at {uri}: {why}"))
        };
        let read = async {
            let first = inspect::read_first(&mut self.connection, &token).await;
            let first = first.map_err(|error| failed(&error))?;
            if !first.has_params() {
                let why = "it holds a parameter that no master can return; delete that first";
                return Err(failed(&why));
            }
            let state = inspect::read_second(first, &mut self.connection, previous).await;
            state.map_err(|error| failed(&error))
        };
        let limit = format!("no answer in {} s", ANSWER_LIMIT.as_secs());
        timeout(ANSWER_LIMIT, read)
            .await
            .unwrap_or_else(|_| Err(failed(&limit)))
    }

    /// Makes `calls` in one multicall. Each result is the error message, or `None` if the call succeeded.
    pub(super) async fn call_all(
        &mut self,
        calls: Vec<Request>,
    ) -> Result<Vec<Option<String>>, CommandFailure> {
        let count = calls.len();
        let failed = |why: String| {
            CommandFailure::Failed(format!("the calls to {} failed: {why}", self.uri))
        };
        let call = Request::multicall(calls);
        let reply = timeout(ANSWER_LIMIT, self.connection.call(&call)).await;
        let reply =
            reply.map_err(|_| failed(format!("no answer in {} s", ANSWER_LIMIT.as_secs())))?;
        match reply.map_err(|error| failed(error.to_string()))? {
            Reply::Value(Value::Array(results)) if results.len() == count => {
                Ok(results.iter().map(refusal).collect())
            }
            Reply::Fault { text, .. } => Err(failed(text)),
            Reply::Value(_) => Err(failed("the answer is not that of a ROS master".to_owned())),
        }
    }
}

/// The error message of a multicall's entry, if it failed.
fn refusal(result: &Value) -> Option<String> {
    let answer = match result {
        Value::Array(one) => one.first().and_then(Value::as_array),
        _ => None,
    };
    match answer {
        Some([Value::Int(1), ..]) => None,
        Some([_, message, ..]) => Some(message.as_str().unwrap_or("no reason given").to_owned()),
        _ => Some("its answer is not that of a master".to_owned()),
    }
}
