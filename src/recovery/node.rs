//! Talking to a node at its own port.

use std::{
    collections::BTreeMap,
    net::{IpAddr, SocketAddr, ToSocketAddrs},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use hyper::header::HeaderValue;
use tokio::{
    net::TcpStream,
    sync::{Semaphore, watch},
    time::timeout,
};

use crate::{
    census::Claims,
    master::CALLER_ID,
    proxy::upstream::Connection,
    ros_env::MasterUri,
    xmlrpc::{Call, Reply, Value},
};

/// Largest reply that is taken from a node, in bytes.
const MAX_REPLY: usize = 16 << 20;
/// Names that are looked up at the same time. A name server that does not answer costs a thread for
/// some ten seconds.
const LOOKUPS: usize = 64;

/// What a node said to a question.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sign {
    /// It answered.
    Alive,
    /// Its port refuses: the process is gone.
    Dead,
    /// No answer in time, or none that makes sense. That is no proof of death.
    Silent,
}

/// Makes `call` to the node at `api` and waits for a sign of life for at most `limit`.
pub async fn ask(api: &str, call: &Call, limit: Duration) -> Sign {
    ask_for(api, call, limit).await.0
}

/// As [`ask`], with the value that the node returned.
pub async fn ask_for(api: &str, call: &Call, limit: Duration) -> (Sign, Option<Value>) {
    let Ok(address) = MasterUri::parse(api) else {
        return (Sign::Silent, None);
    };
    let question = async {
        let mut connection = match connect(&address).await {
            Ok(connection) => connection,
            Err(sign) => return (sign, None),
        };
        put(&mut connection, call).await
    };
    timeout(limit, question)
        .await
        .unwrap_or((Sign::Silent, None))
}

/// What a node says of itself.
#[derive(Debug)]
pub struct Interview {
    /// Whether it lives.
    pub sign: Sign,
    /// Its process id.
    pub pid: Option<i32>,
    /// What it publishes and subscribes, if it can be asked.
    pub claims: Option<Claims>,
}

/// Asks the node at `api` for its process id, which must come within `limit`, and if it lives for
/// what it publishes and subscribes, with as much time again. `getName` would tell more, but roscpp
/// has none.
pub async fn interview(api: &str, limit: Duration) -> Interview {
    let ask = |method: &str| Call::new(method, vec![CALLER_ID.into()]);
    let (sign, pid) = ask_for(api, &ask("getPid"), limit).await;
    let mut interview = Interview {
        sign,
        pid: pid.as_ref().and_then(Value::as_int),
        claims: None,
    };
    if sign == Sign::Alive {
        let (publications, subscriptions) = (ask("getPublications"), ask("getSubscriptions"));
        let answers = tokio::join!(
            ask_for(api, &publications, limit),
            ask_for(api, &subscriptions, limit)
        );
        if let ((_, Some(publications)), (_, Some(subscriptions))) = answers {
            interview.claims = Claims::read(&publications, &subscriptions);
        }
    }
    interview
}

async fn connect(address: &MasterUri) -> Result<Connection, Sign> {
    let hosts = resolve(&address.host).await.ok_or(Sign::Silent)?;
    let mut refused = false;
    for host in hosts.iter() {
        match TcpStream::connect(SocketAddr::new(*host, address.port)).await {
            Ok(stream) => {
                let name = HeaderValue::from_static("to-a-node");
                let connection = Connection::over(stream, address, name, MAX_REPLY);
                return connection.await.map_err(|_| Sign::Silent);
            }
            Err(error) if error.kind() == std::io::ErrorKind::ConnectionRefused => refused = true,
            // Where one of its addresses cannot be reached, it may live there.
            Err(_) => return Err(Sign::Silent),
        }
    }
    Err(if refused { Sign::Dead } else { Sign::Silent })
}

async fn put(connection: &mut Connection, call: &Call) -> (Sign, Option<Value>) {
    match connection.call(call).await {
        Ok(Reply::Value(Value::Array(answer))) => {
            let mut answer = answer.into_iter();
            let success = answer.next() == Some(Value::Int(1));
            (Sign::Alive, answer.nth(1).filter(|_| success))
        }
        // A method that it does not have.
        Ok(Reply::Fault { .. }) => (Sign::Alive, None),
        Ok(Reply::Value(_)) | Err(_) => (Sign::Silent, None),
    }
}

/// A name's addresses; none if it has none.
type Found = Option<Arc<[IpAddr]>>;

static PERMITS: Semaphore = Semaphore::const_new(LOOKUPS);
static UNDER_WAY: Mutex<BTreeMap<String, watch::Receiver<Option<Found>>>> =
    Mutex::new(BTreeMap::new());

fn under_way() -> MutexGuard<'static, BTreeMap<String, watch::Receiver<Option<Found>>>> {
    UNDER_WAY.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Looks up a host, IPv4 first, as roscpp does. A name is looked up once for all who ask at the same
/// time, in a thread of its own: neither the runtime nor the end of the process waits for a name
/// server that does not answer.
async fn resolve(host: &str) -> Found {
    if let Ok(address) = host.parse() {
        return Some([address].into());
    }
    let mut answer = {
        let mut under_way = under_way();
        match under_way.get(host) {
            Some(answer) => answer.clone(),
            None => {
                let (tell, answer) = watch::channel(None);
                under_way.insert(host.to_owned(), answer.clone());
                tokio::spawn(look_up(host.to_owned(), tell));
                answer
            }
        }
    };
    let found = answer.wait_for(Option::is_some).await.ok()?;
    found.clone().flatten()
}

async fn look_up(host: String, tell: watch::Sender<Option<Found>>) {
    // Never closed.
    let permit = PERMITS.acquire().await;
    let name = host.clone();
    let search = move || {
        let _permit = permit;
        let found = (name.as_str(), 0).to_socket_addrs();
        let found = found.ok().map(|addresses| {
            let mut addresses: Vec<_> = addresses.map(|address| address.ip()).collect();
            addresses.sort_by_key(IpAddr::is_ipv6);
            addresses.dedup();
            addresses.into()
        });
        // First: who asks from now on gets a fresh answer.
        under_way().remove(&name);
        tell.send_replace(Some(found));
    };
    // Without a thread the sender is dropped, which is an answer too.
    let named = std::thread::Builder::new().name("lookup".to_owned());
    if named.spawn(search).is_err() {
        under_way().remove(&host);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_name_is_looked_up_and_an_address_is_not() {
        let local = resolve("localhost").await.expect("it has an address");
        assert!(local.iter().all(IpAddr::is_loopback));
        assert_eq!(resolve("::1").await.unwrap().len(), 1);
        assert!(under_way().get("::1").is_none());
    }
}
