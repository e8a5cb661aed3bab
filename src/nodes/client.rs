//! Calls a node at its own port.

use std::{pin::pin, time::Duration};

use rescue_core::health::Claims;
use ros1_master::{
    master::{self, question},
    xmlrpc::{Call, Reply, Value},
};
use socket2::SockRef;
use tokio::{net::TcpStream, time::timeout};

use crate::{
    resolver,
    ros_env::MasterUri,
    upstream::{CallError, Connection},
};
pub(crate) use rescue_core::health::Reaction;

/// Largest accepted reply of a node, in bytes.
const MAX_REPLY: usize = 16 << 20;

/// Makes `call` to the node at `api`, and waits at most `limit` for a sign of life.
pub(crate) async fn call(api: &str, call: &Call, limit: Duration) -> Reaction {
    call_for_value(api, call, limit).await.0
}

/// Like [`call`], and also returns the value that the node answered.
pub(crate) async fn call_for_value(
    api: &str,
    call: &Call,
    limit: Duration,
) -> (Reaction, Option<Value>) {
    let outcome = call_unless(api, call, limit, std::future::pending()).await;
    outcome.map_or((Reaction::Silent, None), |it| (it.sign, it.value))
}

/// What came of a call to a node.
#[derive(Debug, PartialEq)]
pub(super) struct Outcome {
    pub sign: Reaction,
    /// The value that the node answered.
    pub value: Option<Value>,
    /// Whether there was a connection, so that the node may have got the call.
    pub is_connected: bool,
}

/// Like [`call_for_value`], but gives up once `withdrawn` ends, and returns `None`. The node then does not get what it has
/// not received yet.
pub(super) async fn call_unless(
    api: &str,
    call: &Call,
    limit: Duration,
    withdrawn: impl Future<Output = ()>,
) -> Option<Outcome> {
    let mut is_connected = false;
    let connected = &mut is_connected;
    let mut withdrawn = pin!(withdrawn);
    let exchange = async {
        let Ok(address) = MasterUri::parse(api) else {
            return Some((Reaction::Silent, None));
        };
        let connection = tokio::select! {
            connection = connect(&address, limit) => connection,
            () = &mut withdrawn => return None,
        };
        let mut connection = match connection {
            Ok(connection) => connection,
            Err(sign) => return Some((sign, None)),
        };
        *connected = true;
        tokio::select! {
            answer = put(&mut connection, call) => return Some(answer),
            () = &mut withdrawn => {}
        }
        connection.reset();
        None
    };
    let answer = timeout(limit, exchange).await;
    let (sign, value) = answer.unwrap_or(Some((Reaction::Silent, None)))?;
    Some(Outcome {
        sign,
        value,
        is_connected,
    })
}

/// A node's answers about itself.
#[derive(Debug)]
pub(crate) struct Interview {
    pub sign: Reaction,
    pub pid: Option<i32>,
    /// The topics that the node publishes and subscribes to, if known.
    pub claims: Option<Claims>,
}

impl Interview {
    /// The result for a node that does not answer.
    pub(super) const SILENT: Self = Self {
        sign: Reaction::Silent,
        pid: None,
        claims: None,
    };
}

/// Asks the node at `api` for its process id, within `limit`. If it answers, also asks for its
/// publications and subscriptions, within another `limit`. `getName` would help more, but roscpp
/// lacks it.
pub(crate) async fn interview(api: &str, limit: Duration) -> Interview {
    let (sign, pid) = call_for_value(api, &master::get_pid(), limit).await;
    let mut interview = Interview {
        sign,
        pid: pid.as_ref().and_then(Value::as_int),
        claims: None,
    };
    if sign == Reaction::Alive {
        let (publications, subscriptions) =
            (question("getPublications"), question("getSubscriptions"));
        let answers = tokio::join!(
            call_for_value(api, &publications, limit),
            call_for_value(api, &subscriptions, limit)
        );
        if let ((_, Some(publications)), (_, Some(subscriptions))) = answers {
            interview.claims = Claims::read(&publications, &subscriptions);
        }
    }
    interview
}

/// Connects to a node. If it does not receive what is sent within `limit`, the kernel ends the connection. Otherwise it
/// would go on sending a call that was given up, and the node might get it after newer ones.
async fn connect(address: &MasterUri, limit: Duration) -> Result<Connection, Reaction> {
    let found = resolver::addresses(&address.host, address.port).await;
    let mut refused = false;
    for socket in found.map_err(|_| Reaction::Silent)? {
        match TcpStream::connect(socket).await {
            Ok(stream) => {
                // This fails only if the connection has ended.
                let _ = SockRef::from(&stream).set_tcp_user_timeout(Some(limit));
                let connection = Connection::over(stream, address, MAX_REPLY);
                return connection.await.map_err(|_| Reaction::Silent);
            }
            Err(error) if error.kind() == std::io::ErrorKind::ConnectionRefused => refused = true,
            // The node may live, but this computer cannot reach its address.
            Err(_) => return Err(Reaction::Silent),
        }
    }
    Err(if refused {
        Reaction::Dead
    } else {
        Reaction::Silent
    })
}

async fn put(connection: &mut Connection, call: &Call) -> (Reaction, Option<Value>) {
    match connection.call_node(call).await {
        Ok(Reply::Value(Value::Array(answer))) => {
            let mut answer = answer.into_iter();
            let success = answer.next() == Some(Value::Int(1));
            (Reaction::Alive, answer.nth(1).filter(|_| success))
        }
        // The node lacks the method.
        Ok(Reply::Fault { .. }) => (Reaction::Alive, None),
        // Some boards answer in their own words. A master does not look at answers.
        Ok(Reply::Value(_)) => (Reaction::Alive, None),
        Err(CallError::NotXmlRpc { status, .. }) if status.is_success() => (Reaction::Alive, None),
        Err(_) => (Reaction::Silent, None),
    }
}

#[cfg(test)]
mod tests {
    use std::net::SocketAddr;

    use socket2::{Domain, Socket, Type};
    use tokio::{io::AsyncReadExt, net::TcpListener};

    use super::*;

    /// The kernel drops connections that a listener with a full queue does not accept, as a network does that is away.
    #[tokio::test]
    async fn a_call_without_a_connection_is_told_from_one_without_an_answer() {
        let listener = Socket::new(Domain::IPV4, Type::STREAM, None).unwrap();
        let any: SocketAddr = "127.0.0.1:0".parse().unwrap();
        listener.bind(&any.into()).unwrap();
        listener.listen(0).unwrap();
        let address = listener.local_addr().unwrap().as_socket().unwrap();
        let api = format!("http://{address}/");
        let (call, limit) = (master::get_pid(), Duration::from_millis(300));
        let ask = || call_unless(&api, &call, limit, std::future::pending());
        assert!(ask().await.unwrap().is_connected);
        let mut queued = Vec::new();
        while let Ok(Ok(stream)) = timeout(limit, TcpStream::connect(address)).await {
            queued.push(stream);
        }
        let outcome = ask().await.unwrap();
        assert_eq!(
            (outcome.sign, outcome.is_connected),
            (Reaction::Silent, false)
        );
    }

    /// The rest of a call that is only given up would still arrive.
    #[tokio::test]
    async fn what_a_node_has_not_received_of_a_withdrawn_call_is_not_sent() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let api = format!("http://{}/", listener.local_addr().unwrap());
        let call = master::param_update("/k", Value::String("x".repeat(64 << 20)));
        let (began, begins) = tokio::sync::oneshot::channel();
        let node = async {
            let (stream, _) = listener.accept().await.unwrap();
            assert_eq!(stream.peek(&mut [0]).await.unwrap(), 1);
            began.send(()).unwrap();
            stream
        };
        let withdrawn = async { begins.await.unwrap() };
        let limit = Duration::from_secs(60);
        let (sign, mut stream) = tokio::join!(call_unless(&api, &call, limit, withdrawn), node);
        assert_eq!(sign, None);
        let error = stream.read_to_end(&mut Vec::new()).await.unwrap_err();
        assert_eq!(error.kind(), std::io::ErrorKind::ConnectionReset);
    }
}
