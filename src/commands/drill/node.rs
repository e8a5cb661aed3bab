//! The drill's own node: answers the master's calls, and keeps what it was told.

use std::{
    collections::{BTreeMap, BTreeSet},
    convert::Infallible,
    io,
    net::{IpAddr, Ipv4Addr, SocketAddr},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use http_body_util::{BodyExt, Full, Limited};
use hyper::{
    Request, Response,
    body::{Bytes, Incoming},
    header::{CONTENT_TYPE, HeaderValue},
    server::conn::http1,
    service::service_fn,
};
use hyper_util::rt::TokioIo;
use ros1_master::xmlrpc::{self, Call, Reply, Value};
use tokio::{net::TcpListener, sync::watch};

use super::PREFIX;
use crate::{
    ros_env::{self, MasterUri},
    server::listener,
};

/// Largest call that is read, in bytes.
const MAX_CALL: usize = 16 << 20;

/// The notifications that the node got, and its subscriptions.
#[derive(Debug, Default)]
pub(super) struct NodeLog {
    /// The number in the last `paramUpdate` of a drill's parameter.
    pub(super) param: watch::Sender<i32>,
    /// Parameters and namespaces that other programs have changed.
    changed: Mutex<BTreeSet<String>>,
    /// Topic and publishers of each `publisherUpdate`.
    updates: Mutex<Vec<(String, Vec<String>)>>,
    /// The reason in a `shutdown` that the node got.
    shutdown: Mutex<Option<String>>,
    /// The topics that the node subscribes to, with their types.
    subscriptions: Mutex<BTreeMap<String, String>>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl NodeLog {
    pub(super) fn updates(&self) -> Vec<(String, Vec<String>)> {
        lock(&self.updates).clone()
    }

    /// Parameters and namespaces that others have changed.
    pub(super) fn changed(&self) -> BTreeSet<String> {
        lock(&self.changed).clone()
    }

    pub(super) fn shutdown(&self) -> Option<String> {
        lock(&self.shutdown).clone()
    }

    /// Adds or removes a subscription to `topic`. The health check asks the node for its subscriptions.
    pub(super) fn subscribes(&self, topic: &str, yes: bool) {
        let mut subscriptions = lock(&self.subscriptions);
        match yes {
            true => subscriptions.insert(topic.to_owned(), "*".to_owned()),
            false => subscriptions.remove(topic),
        };
    }

    /// The node's answer (status, message and value). `None` for a method that it lacks.
    fn answer(&self, call: Call) -> Option<[Value; 3]> {
        let mut params = call.params.into_iter().skip(1);
        let value = match call.method.as_str() {
            "getPid" => i32::try_from(std::process::id()).unwrap_or(-1).into(),
            "getPublications" | "getBusStats" | "getBusInfo" => Value::Array(Vec::new()),
            "getSubscriptions" => {
                let pairs = lock(&self.subscriptions);
                let pairs = pairs.iter().map(|(topic, of)| vec![&**topic, of].into());
                Value::Array(pairs.collect())
            }
            "paramUpdate" => {
                let (key, value) = (params.next(), params.next());
                let key = key.as_ref().and_then(Value::as_str).unwrap_or_default();
                match value {
                    Some(Value::Int(number)) if key.starts_with(PREFIX) => {
                        self.param.send_replace(number);
                    }
                    // After an outage the node is told everything below the namespace again.
                    Some(Value::Struct(all)) if key == "/" => {
                        let ours = all
                            .iter()
                            .find(|(key, _)| format!("/{key}").starts_with(PREFIX));
                        if let Some(number) = ours.and_then(|(_, value)| value.as_int()) {
                            self.param.send_replace(number);
                        }
                    }
                    _ => {
                        // The master appends a slash to keys when it compares them.
                        let key = key.trim_end_matches('/').to_owned();
                        lock(&self.changed).insert(key);
                    }
                }
                0.into()
            }
            "publisherUpdate" => {
                if let (Some(Value::String(topic)), Some(Value::Array(list))) =
                    (params.next(), params.next())
                {
                    let list = list.iter().filter_map(Value::as_str).map(str::to_owned);
                    lock(&self.updates).push((topic, list.collect()));
                }
                0.into()
            }
            "shutdown" => {
                let why = params.next();
                let why = why.as_ref().and_then(Value::as_str).unwrap_or_default();
                *lock(&self.shutdown) = Some(why.to_owned());
                0.into()
            }
            _ => return None,
        };
        Some([1.into(), "".into(), value])
    }
}

/// A node that answers until it is dropped.
#[derive(Debug)]
pub(super) struct DrillNode {
    pub(super) name: String,
    /// The address that this node registers.
    pub(super) api: String,
    pub(super) log: Arc<NodeLog>,
    server: tokio::task::JoinHandle<()>,
}

impl DrillNode {
    /// Starts a node at this computer's address, chosen as rospy and roscpp do.
    pub(super) async fn start(name: String) -> io::Result<Self> {
        let env = |name: &str| std::env::var(name).ok();
        let any = ros_env::bind_addresses(&env).first().copied();
        let any = any.unwrap_or(IpAddr::V4(Ipv4Addr::UNSPECIFIED));
        let listener = TcpListener::bind(SocketAddr::new(any, 0)).await?;
        let hostname = rustix::system::uname();
        let hostname = hostname.nodename().to_string_lossy().into_owned();
        let api = MasterUri {
            host: ros_env::advertised_host(&env, &hostname, listener::local_address()),
            port: listener.local_addr()?.port(),
        };
        let log = Arc::new(NodeLog::default());
        let server = crate::task::spawn(serve(listener, log.clone()));
        Ok(Self {
            name,
            api: api.to_string(),
            log,
            server,
        })
    }
}

impl Drop for DrillNode {
    fn drop(&mut self) {
        self.server.abort();
    }
}

async fn serve(listener: TcpListener, log: Arc<NodeLog>) {
    loop {
        let Ok((stream, _)) = listener.accept().await else {
            tokio::task::yield_now().await;
            continue;
        };
        let log = log.clone();
        let service = service_fn(move |request| answer(log.clone(), request));
        // It does not matter if a caller closes the connection.
        crate::task::spawn(http1::Builder::new().serve_connection(TokioIo::new(stream), service));
    }
}

async fn answer(
    log: Arc<NodeLog>,
    request: Request<Incoming>,
) -> Result<Response<Full<Bytes>>, Infallible> {
    let body = Limited::new(request.into_body(), MAX_CALL).collect().await;
    let call = body
        .ok()
        .and_then(|body| xmlrpc::decode_call(&body.to_bytes()).ok());
    let reply = match call.and_then(|call| log.answer(call)) {
        Some(answer) => Reply::Value(Value::Array(answer.into())),
        None => Reply::Fault {
            code: 1,
            text: "the drill's node lacks this method".to_owned(),
        },
    };
    let mut reply = Response::new(Full::new(xmlrpc::encode_reply(&reply).into()));
    let xml = HeaderValue::from_static("text/xml");
    reply.headers_mut().insert(CONTENT_TYPE, xml);
    Ok(reply)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nodes::client;
    use ros1_master::master;

    #[tokio::test]
    async fn the_node_answers_for_itself_and_keeps_its_notifications() {
        let node = DrillNode::start("/drill".to_owned()).await.unwrap();
        node.log.subscribes("/chatter", true);
        let ask = async |call| {
            let limit = std::time::Duration::from_secs(60);
            client::call_for_value(&node.api, &call, limit).await.1
        };
        let pid = i32::try_from(std::process::id()).unwrap();
        assert_eq!(ask(master::get_pid()).await, Some(pid.into()));
        let pairs = Value::Array(vec![vec!["/chatter", "*"].into()]);
        assert_eq!(ask(master::question("getSubscriptions")).await, Some(pairs));
        ask(master::param_update("/rosrescue_drill_1/", 7.into())).await;
        assert_eq!(*node.log.param.borrow(), 7);
        ask(master::param_update("/robot/wheels/", 4.into())).await;
        assert_eq!(node.log.changed(), ["/robot/wheels".to_owned()].into());
        assert_eq!(*node.log.param.borrow(), 7);
        let publishers = ["http://a:1/".to_owned()];
        ask(master::publisher_update("/chatter", &publishers)).await;
        let updates = [("/chatter".to_owned(), publishers.to_vec())];
        assert_eq!(node.log.updates(), updates);
        ask(master::shutdown("/drill")).await;
        assert!(node.log.shutdown().is_some());
        assert_eq!(ask(master::question("getName")).await, None);
    }
}
