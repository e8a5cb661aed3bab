//! One endpoint of etcd: its connections, TLS, and session token.

use std::{
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use bytes::Bytes;
use http_body_util::{BodyExt, Full, Limited};
use hyper::{
    Request, Response,
    body::Incoming,
    client::conn::http1::{self, SendRequest},
    header::{AUTHORIZATION, CONTENT_TYPE, HOST},
};
use hyper_util::rt::TokioIo;
use tokio::{
    io::{AsyncRead, AsyncWrite},
    net::TcpStream,
};

use super::{
    EtcdError, Tls,
    tls::{Secured, TlsSettings},
    wire,
};

/// Longest time to connect to one address. In a local network, connecting takes about a millisecond.
const CONNECT_LIMIT: Duration = Duration::from_secs(1);
/// Maximum size of an answer, in bytes. The largest answers are the pages of a range.
const ANSWER_BYTES_MAX: usize = 64 << 20;
/// Maximum number of idle connections that are kept.
const IDLE_MOST: usize = 4;

/// The credentials of this computer at etcd.
#[derive(Clone, Default)]
pub struct Credentials {
    pub tls: Tls,
    /// User name and password.
    pub user: Option<(String, String)>,
}

/// Hides the password.
impl std::fmt::Debug for Credentials {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let user = self.user.as_ref().map(|(name, _)| name);
        f.debug_struct("Credentials")
            .field("tls", &self.tls)
            .field("user", &user)
            .finish()
    }
}

type Connection = SendRequest<Full<Bytes>>;

#[derive(Debug)]
pub(super) struct Endpoint {
    url: String,
    host: String,
    port: u16,
    tls: Option<Secured>,
    access: Arc<Credentials>,
    idle: Mutex<Vec<Connection>>,
    token: Mutex<Option<String>>,
}

fn lock<T>(of: &Mutex<T>) -> MutexGuard<'_, T> {
    of.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Endpoint {
    pub(super) fn new(
        url: &str,
        access: &Arc<Credentials>,
        config: Option<&TlsSettings>,
    ) -> Result<Self, EtcdError> {
        let refused =
            |why: &str| EtcdError::Options(format!("`{url}` is not an etcd endpoint: {why}"));
        let uri: hyper::Uri = url.parse().map_err(|_| refused("it is not a URL"))?;
        let host = uri.host().ok_or_else(|| refused("it has no host"))?;
        let host = host
            .trim_start_matches('[')
            .trim_end_matches(']')
            .to_owned();
        let tls = match (uri.scheme_str(), config) {
            (Some("http"), _) => None,
            (Some("https"), Some(config)) => {
                let secured = Secured::new(config, &host);
                Some(secured.ok_or_else(|| refused("its host is not a valid host name"))?)
            }
            (Some("https"), None) => {
                return Err(refused("https needs the certificate of etcd's authority"));
            }
            _ => return Err(refused("it must begin with http:// or https://")),
        };
        Ok(Self {
            url: url.to_owned(),
            host,
            port: uri.port_u16().unwrap_or(2379),
            tls,
            access: access.clone(),
            idle: Mutex::default(),
            token: Mutex::default(),
        })
    }

    pub(super) fn url(&self) -> &str {
        &self.url
    }

    /// Makes a request and returns the answer's body.
    pub(super) async fn call(
        &self,
        path: &str,
        body: Bytes,
        limit: Duration,
    ) -> Result<Bytes, EtcdError> {
        let called = tokio::time::timeout(limit, self.authenticated(path, body));
        called.await.unwrap_or(Err(EtcdError::Silent { limit }))
    }

    async fn authenticated(&self, path: &str, body: Bytes) -> Result<Bytes, EtcdError> {
        match self.send(path, body.clone()).await {
            Err(EtcdError::Token { .. }) if self.access.user.is_some() => {
                *lock(&self.token) = None;
                self.send(path, body).await
            }
            Err(EtcdError::NotEtcd { .. }) if self.is_for_peers().await => {
                Err(EtcdError::PeerPort {
                    endpoint: self.url.clone(),
                })
            }
            done => done,
        }
    }

    /// Whether this endpoint is etcd's port for other members. Only that port lists the members at `/members`.
    async fn is_for_peers(&self) -> bool {
        let ask = async {
            let mut connection = self.connect().await.ok()?;
            let request = Request::get("/members").header(HOST, self.authority());
            let request = request.body(Full::default()).ok()?;
            let response = connection.send_request(request).await.ok()?;
            let body = Limited::new(response.into_body(), ANSWER_BYTES_MAX);
            Some(body.collect().await.ok()?.to_bytes())
        };
        let page = ask.await.unwrap_or_default();
        serde_json::from_slice::<Vec<wire::PeerMember>>(&page).is_ok_and(|peers| !peers.is_empty())
    }

    fn authority(&self) -> String {
        format!("{}:{}", self.host, self.port)
    }

    async fn send(&self, path: &str, body: Bytes) -> Result<Bytes, EtcdError> {
        let token = self.token().await?;
        self.exchange(path, body, token.as_deref()).await
    }

    /// The token of this session at etcd. `None` if no user is configured.
    async fn token(&self) -> Result<Option<String>, EtcdError> {
        let Some((name, password)) = &self.access.user else {
            return Ok(None);
        };
        let known = lock(&self.token).clone();
        if known.is_some() {
            return Ok(known);
        }
        let request = serde_json::json!({ "name": name, "password": password });
        let answer = self
            .exchange("auth/authenticate", request.to_string().into(), None)
            .await?;
        let answer: serde_json::Value = wire::parse(&answer)?;
        let token = answer.get("token").and_then(serde_json::Value::as_str);
        let token = token.map(str::to_owned);
        lock(&self.token).clone_from(&token);
        Ok(token)
    }

    async fn exchange(
        &self,
        path: &str,
        body: Bytes,
        token: Option<&str>,
    ) -> Result<Bytes, EtcdError> {
        // etcd may have closed an idle connection. If the request fails there, a new connection gets it.
        let idle = lock(&self.idle)
            .pop()
            .filter(|connection| !connection.is_closed());
        if let Some(mut connection) = idle
            && let Ok(response) = self
                .request(&mut connection, path, body.clone(), token)
                .await
        {
            return self.read(connection, response).await;
        }
        let mut connection = self.connect().await?;
        let response = self.request(&mut connection, path, body, token).await?;
        self.read(connection, response).await
    }

    async fn read(
        &self,
        connection: Connection,
        response: Response<Incoming>,
    ) -> Result<Bytes, EtcdError> {
        let status = response.status();
        let body = Limited::new(response.into_body(), ANSWER_BYTES_MAX)
            .collect()
            .await;
        let body = body
            .map_err(|error| self.connection_lost(&*error))?
            .to_bytes();
        let mut idle = lock(&self.idle);
        if idle.len() < IDLE_MOST {
            idle.push(connection);
        }
        drop(idle);
        if status.is_success() {
            return Ok(body);
        }
        Err(EtcdError::refused(&self.url, status, &body))
    }

    /// Opens a stream of answers on a connection of its own.
    pub(super) async fn stream(
        &self,
        path: &str,
        body: Bytes,
        limit: Duration,
    ) -> Result<Incoming, EtcdError> {
        let open = async {
            let token = self.token().await?;
            let mut connection = self.connect().await?;
            let response = self
                .request(&mut connection, path, body, token.as_deref())
                .await?;
            if response.status().is_success() {
                return Ok(response.into_body());
            }
            let status = response.status();
            let body = Limited::new(response.into_body(), ANSWER_BYTES_MAX)
                .collect()
                .await;
            Err(EtcdError::refused(
                &self.url,
                status,
                &body
                    .map_err(|error| self.connection_lost(&*error))?
                    .to_bytes(),
            ))
        };
        let opened = tokio::time::timeout(limit, open).await;
        opened.unwrap_or(Err(EtcdError::Silent { limit }))
    }

    /// Drops the token, so that the next stream gets a new one.
    pub(super) fn forget_token(&self) {
        *lock(&self.token) = None;
    }

    async fn request(
        &self,
        connection: &mut Connection,
        path: &str,
        body: Bytes,
        token: Option<&str>,
    ) -> Result<Response<Incoming>, EtcdError> {
        let mut request = Request::post(format!("/v3/{path}"))
            .header(HOST, self.authority())
            .header(CONTENT_TYPE, "application/json");
        if let Some(token) = token {
            request = request.header(AUTHORIZATION, token);
        }
        let request = request
            .body(Full::new(body))
            .map_err(|error| self.connection_lost(&error))?;
        connection
            .send_request(request)
            .await
            .map_err(|error| self.connection_lost(&error))
    }

    async fn connect(&self) -> Result<Connection, EtcdError> {
        let stream = self.connect_tcp().await?;
        let Some(secured) = &self.tls else {
            return self.open(stream).await;
        };
        let stream = secured.connect(stream).await;
        self.open(stream.map_err(|error| self.connection_lost(&error))?)
            .await
    }

    async fn connect_tcp(&self) -> Result<TcpStream, EtcdError> {
        let failed = |why: String| EtcdError::Connect {
            endpoint: self.url.clone(),
            why,
        };
        let addresses = lookup::addresses(&self.host, self.port).await;
        let addresses = addresses.map_err(|error| failed(error.to_string()))?;
        let mut why = "its name has no address".to_owned();
        for address in addresses {
            match tokio::time::timeout(CONNECT_LIMIT, TcpStream::connect(address)).await {
                Ok(Ok(stream)) => {
                    stream
                        .set_nodelay(true)
                        .map_err(|error| failed(error.to_string()))?;
                    return Ok(stream);
                }
                Ok(Err(error)) => why = error.to_string(),
                Err(_) => why = format!("{address} does not answer"),
            }
        }
        Err(failed(why))
    }

    async fn open(
        &self,
        stream: impl AsyncRead + AsyncWrite + Send + Unpin + 'static,
    ) -> Result<Connection, EtcdError> {
        let opened = http1::handshake(TokioIo::new(stream)).await;
        let (connection, driver) = opened.map_err(|error| self.connection_lost(&error))?;
        // The task ends when the returned connection is dropped.
        tokio::spawn(driver);
        Ok(connection)
    }

    pub(super) fn connection_lost(&self, error: &(dyn std::error::Error + 'static)) -> EtcdError {
        let mut why = error.to_string();
        let mut source = error.source();
        while let Some(error) = source {
            why = format!("{why}: {error}");
            source = error.source();
        }
        let endpoint = self.url.clone();
        // Only rustls uses these words in its errors.
        match ["certificate", "alert", "Certificate"]
            .iter()
            .any(|word| why.contains(word))
        {
            true => EtcdError::Tls { endpoint, why },
            false => EtcdError::Lost { endpoint, why },
        }
    }
}
