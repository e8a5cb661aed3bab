//! Settings for clients of a cluster of etcd servers.

use std::time::Duration;

use rescue_core::cluster::{
    journal::Keys,
    machine::{Commit, Settings, WhenAlone},
};
use rosrescue::cluster::etcd::{Credentials, Tls};

pub(crate) use crate::support::{LIMIT, Servers};

pub(crate) fn keys() -> Keys {
    Keys::new("robot")
}

pub(crate) fn settings(name: &str) -> Settings {
    Settings {
        name: name.to_owned(),
        id: format!("{name}-1"),
        uri: format!("http://{name}:11311"),
        boot: String::new(),
        version: "0.1.0".to_owned(),
        ttl: Duration::from_secs(2),
        commit: Commit::Always,
        alone: WhenAlone::Serve,
    }
}

pub(crate) fn with_user(name: &str, password: &str) -> Credentials {
    Credentials {
        user: Some((name.to_owned(), password.to_owned())),
        tls: Tls::default(),
    }
}
