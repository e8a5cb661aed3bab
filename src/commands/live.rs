//! Reads and changes the running master through ordinary Master API calls.

use std::{fmt::Display, time::Duration};

use rescue_core::replay::Token;
use ros1_master::{
    master::{Master, Request},
    xmlrpc::{Reply, Value},
};
use tokio::{net::TcpStream, time::timeout};

use super::{CommandFailure, running::Running};
use crate::{
    resolver,
    upstream::{Connection, inspect},
};

/// Longest time to connect.
const CONNECT_LIMIT: Duration = Duration::from_secs(5);
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
        let uri = address.to_string();
        let nobody = |why: String| CommandFailure::Nobody {
            uri: uri.clone(),
            why,
        };
        let connect = async {
            let addresses = resolver::addresses(&address.host, address.port).await?;
            let stream = TcpStream::connect(&*addresses).await?;
            Connection::over(stream, address, MAX_REPLY).await
        };
        let connection = match timeout(CONNECT_LIMIT, connect).await {
            Ok(connected) => connected.map_err(|error| nobody(error.to_string()))?,
            // The backlog of a stopped rosrescue is full, so it accepts no connection.
            Err(_) => {
                return Err(CommandFailure::Silent {
                    uri,
                    why: format!("no connection in {} s", CONNECT_LIMIT.as_secs()),
                });
            }
        };
        Ok(Self { connection, uri })
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

#[cfg(test)]
mod tests {
    use std::net::{SocketAddr, TcpStream};

    use socket2::{Domain, Socket, Type};

    use super::*;
    use crate::ros_env::MasterUri;

    #[tokio::test]
    async fn a_port_that_accepts_no_connection_is_taken() {
        let listener = Socket::new(Domain::IPV4, Type::STREAM, None).unwrap();
        let any: SocketAddr = ([127, 0, 0, 1], 0).into();
        listener.bind(&any.into()).unwrap();
        listener.listen(0).unwrap();
        let address = listener.local_addr().unwrap().as_socket().unwrap();
        // Connects until the backlog is full.
        let connect = || TcpStream::connect_timeout(&address, Duration::from_millis(500)).ok();
        let _waiting: Vec<_> = std::iter::from_fn(connect).collect();
        let address = MasterUri {
            host: "127.0.0.1".to_owned(),
            port: address.port(),
        };
        let connected = Live::connect(&Running { address }).await;
        assert!(matches!(connected, Err(CommandFailure::Silent { .. })));
    }
}
