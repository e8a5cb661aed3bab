//! Calls a node at its own port.

use std::{
    net::{IpAddr, SocketAddr},
    time::Duration,
};

use rescue_core::health::Claims;
use ros1_master::{
    master::{self, question},
    xmlrpc::{Call, Reply, Value},
};
use socket2::SockRef;
use tokio::{net::TcpStream, time::timeout};

use crate::{resolver, ros_env::MasterUri, upstream::Connection};
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
    let Ok(address) = MasterUri::parse(api) else {
        return (Reaction::Silent, None);
    };
    let question = async {
        let mut connection = match connect(&address, limit).await {
            Ok(connection) => connection,
            Err(sign) => return (sign, None),
        };
        put(&mut connection, call).await
    };
    timeout(limit, question)
        .await
        .unwrap_or((Reaction::Silent, None))
}

/// The host of `api`, resolved to its first address. `None` if it has no address within `limit`.
pub(super) async fn host(api: &str, limit: Duration) -> Option<IpAddr> {
    let MasterUri { host, port } = MasterUri::parse(api).ok()?;
    let found = timeout(limit, resolver::addresses(&host, port)).await;
    found.ok()?.ok()?.first().map(SocketAddr::ip)
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
        Ok(Reply::Value(_)) | Err(_) => (Reaction::Silent, None),
    }
}
