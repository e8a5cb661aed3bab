//! Parses the addresses to serve, and derives the announced address.

use std::net::{IpAddr, SocketAddr};

use super::UsageError;
use crate::ros_env::{self, Lookup};

/// The announced host name or address. The first of `listen` is announced if it is a single address and the environment
/// sets no other, because rosrescue then listens only there.
pub(super) fn advertised_host(
    listen: &[SocketAddr],
    env: Lookup<'_>,
    hostname: &str,
    local_address: Option<IpAddr>,
) -> String {
    match listen.first().map(SocketAddr::ip) {
        Some(served) if !served.is_unspecified() && ros_env::address_override(env).is_none() => {
            served.to_string()
        }
        _ => ros_env::advertised_host(env, hostname, local_address),
    }
}

pub(super) fn parse_address(text: &str, form: &'static str) -> Result<IpAddr, UsageError> {
    let bare = text.trim_start_matches('[').trim_end_matches(']');
    match bare {
        "localhost" => Ok(IpAddr::V4(std::net::Ipv4Addr::LOCALHOST)),
        _ => bare.parse().map_err(|_| UsageError::Listen {
            given: text.to_owned(),
            form,
        }),
    }
}

/// Parses `ADDR:PORT`, `ADDR`, `:PORT`, `PORT`, or a missing option.
pub(super) fn listen_addresses(
    given: Option<&str>,
    env: Lookup<'_>,
) -> Result<Vec<SocketAddr>, UsageError> {
    const FORM: &str = "ADDR:PORT, ADDR, :PORT or PORT, as in 127.0.0.1:11311";
    let usual_port = || ros_env::master_port(env).map_err(UsageError::MasterUri);
    let usual_addresses = || ros_env::bind_addresses(env);
    let (addresses, port) = match given.map(|text| (text, text.parse())) {
        None => (usual_addresses(), usual_port()?),
        // The same default as for `core`, because both may use the same environment.
        Some((_, Ok(address))) => (vec![address], usual_port()?),
        Some((text, Err(_))) => {
            let (address, port) = text.rsplit_once(':').unwrap_or(("", text));
            let port = port.parse().map_err(|_| UsageError::Listen {
                given: text.to_owned(),
                form: FORM,
            })?;
            let addresses = match address {
                "" => usual_addresses(),
                _ => vec![parse_address(address, FORM)?],
            };
            (addresses, port)
        }
    };
    Ok(addresses
        .into_iter()
        .map(|address| SocketAddr::new(address, port))
        .collect())
}
