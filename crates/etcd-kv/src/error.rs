//! Errors of etcd, in words for the person who runs etcd.

use std::time::Duration;

use hyper::StatusCode;
use serde::Deserialize;
use thiserror::Error;

/// A gRPC status code.
const INVALID_ARGUMENT: i64 = 3;
const PERMISSION_DENIED: i64 = 7;
const UNAVAILABLE: i64 = 14;
const UNAUTHENTICATED: i64 = 16;

#[derive(Debug, Error)]
pub enum EtcdError {
    #[error("{0}")]
    Options(String),
    #[error("cannot connect to etcd at {endpoint}: {why}")]
    Connect { endpoint: String, why: String },
    #[error(
        "etcd at {endpoint} is not trusted, or does not trust this computer: {why}; check the certificates \
         and their dates"
    )]
    Tls { endpoint: String, why: String },
    #[error("the connection to etcd at {endpoint} has ended: {why}")]
    Lost { endpoint: String, why: String },
    #[error("etcd has not answered within {} ms", limit.as_millis())]
    Silent { limit: Duration },
    #[error("etcd at {endpoint} has no majority: {why}; it needs more than half of its members")]
    NoMajority { endpoint: String, why: String },
    #[error(
        "etcd is full and commits nothing: make room (`etcdctl compact`, `etcdctl defrag`) or \
         raise --quota-backend-bytes, then run `etcdctl alarm disarm`"
    )]
    Full,
    #[error("etcd refuses a request of this size; its --max-request-bytes is below 1.5 MiB")]
    TooLarge,
    #[error("etcd has discarded a revision that is still needed: the state must be read again")]
    Compacted,
    #[error("etcd at {endpoint} refuses access: {why}; check user, password and role")]
    Access { endpoint: String, why: String },
    #[error(
        "etcd at {endpoint} has users. Its gateway then refuses every client certificate with a CommonName: \
         give this computer one without (openssl: -subj /O=NAME)"
    )]
    CommonName { endpoint: String },
    #[error("etcd at {endpoint} no longer accepts the token of this session")]
    Token { endpoint: String },
    #[error(
        "the gateway of etcd at {endpoint} cannot reach its own server: {why}; with --client-cert-auth \
         etcd's certificate must be good for clients, too (extendedKeyUsage clientAuth)"
    )]
    Gateway { endpoint: String, why: String },
    #[error("{endpoint} is etcd's port for its peers; clients use another one, usually 2379")]
    PeerPort { endpoint: String },
    #[error("{endpoint} does not answer as etcd 3.4 or later does: {why}")]
    NotEtcd { endpoint: String, why: String },
    #[error("etcd at {endpoint} says: {why}")]
    Other { endpoint: String, why: String },
}

impl EtcdError {
    /// The error in the body of an answer of `endpoint`, which the body does not name.
    pub(super) fn of(self, endpoint: &str) -> Self {
        match self {
            Self::NotEtcd { why, .. } => Self::NotEtcd {
                endpoint: endpoint.to_owned(),
                why,
            },
            other => other,
        }
    }

    /// The error in an answer with an HTTP error status.
    pub(super) fn refused(endpoint: &str, status: StatusCode, body: &[u8]) -> Self {
        if let Ok(answer) = serde_json::from_slice::<ErrorAnswer>(body)
            && answer.code != 0
        {
            return Self::answered(endpoint, answer.code, &answer.message);
        }
        let endpoint = endpoint.to_owned();
        // Plain text is the gateway's own error.
        if body.starts_with(b"CommonName of client") {
            return Self::CommonName { endpoint };
        }
        let why = format!("its status is {status}; is the gateway off (--enable-grpc-gateway)?");
        Self::NotEtcd { endpoint, why }
    }

    /// The error with this gRPC status code and message.
    pub(super) fn answered(endpoint: &str, code: i64, message: &str) -> Self {
        let endpoint = endpoint.to_owned();
        let why = message.to_owned();
        let says = |text: &str| message.contains(text);
        match code {
            _ if says("database space exceeded") => Self::Full,
            _ if says("has been compacted") => Self::Compacted,
            _ if says("request is too large") || says("received message larger") => Self::TooLarge,
            _ if says("no leader") || says("request timed out") || says("leader changed") => {
                Self::NoMajority { endpoint, why }
            }
            // After a change of users or roles, etcd wants a new token; its own client then logs in again.
            _ if says("revision of auth store is old") || says("revision in header is old") => {
                Self::Token { endpoint }
            }
            UNAVAILABLE => Self::Gateway { endpoint, why },
            UNAUTHENTICATED => Self::Token { endpoint },
            PERMISSION_DENIED => Self::Access { endpoint, why },
            INVALID_ARGUMENT if says("user name is empty") || says("authentication failed") => {
                Self::Access { endpoint, why }
            }
            _ => Self::Other { endpoint, why },
        }
    }

    /// Whether the endpoint gave no answer.
    pub(super) fn is_unreachable(&self) -> bool {
        matches!(
            self,
            Self::Connect { .. } | Self::Lost { .. } | Self::Silent { .. }
        )
    }

    /// Whether every other member of etcd would answer with the same error, so that asking them is useless.
    pub(super) fn is_final(&self) -> bool {
        matches!(
            self,
            Self::Options(_)
                | Self::Full
                | Self::TooLarge
                | Self::Compacted
                | Self::Access { .. }
                | Self::CommonName { .. }
        )
    }
}

/// The body of an answer with an HTTP error status.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct ErrorAnswer {
    code: i64,
    message: String,
}

#[cfg(test)]
mod tests {
    use super::*;

    /// With `--auth-token jwt`. The messages are those of etcd's `rpctypes`.
    #[test]
    fn a_token_that_is_older_than_the_users_is_renewed() {
        for message in [
            "etcdserver: revision of auth store is old",
            "auth: revision in header is old",
        ] {
            let error = EtcdError::answered("https://a:2379", 3, message);
            assert!(matches!(error, EtcdError::Token { .. }), "{error:?}");
        }
    }

    #[test]
    fn a_gateway_that_refuses_a_name_in_a_certificate_is_explained() {
        // The answer of etcd 3.4.23 with `--client-cert-auth`, after `etcdctl auth enable`.
        let body = b"CommonName of client sending a request against gateway will be ignored and not used as expected\n";
        let error = EtcdError::refused("https://a:2379", StatusCode::BAD_REQUEST, body);
        assert!(error.to_string().contains("one without"), "{error}");
        let other = EtcdError::refused(
            "https://a:2379",
            StatusCode::NOT_FOUND,
            b"404 page not found\n",
        );
        assert!(matches!(other, EtcdError::NotEtcd { .. }), "{other}");
    }
}
