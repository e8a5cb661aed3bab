//! Checks that must hold for the headers of any request: rosrescue admits none that a browser sends for a page of
//! another site.

use std::net::IpAddr;

use http::{
    HeaderMap, Uri,
    header::{HOST, HeaderName, HeaderValue, ORIGIN},
};
use rescue_core::admission;

/// The names of the simulated computer.
const NAMES: [&str; 2] = ["robot", "robot.local"];

/// Reads the bytes as header lines, and decides whether requests with them are admitted.
pub(crate) fn check(bytes: &[u8]) {
    let mut headers = HeaderMap::new();
    for line in bytes.split(|byte| *byte == b'\n') {
        let mut parts = line.splitn(2, |byte| *byte == b':');
        let name = parts.next().map(HeaderName::from_bytes);
        let value = parts
            .next()
            .map(|value| HeaderValue::from_bytes(value.trim_ascii()));
        if let (Some(Ok(name)), Some(Ok(value))) = (name, value) {
            headers.append(name, value);
        }
    }
    let names = NAMES.map(str::to_owned);
    let post = admission::check_post(&headers, &names);
    let get = admission::check_get(&headers, &names);
    for refusal in [&post, &get].into_iter().filter_map(|of| of.as_ref().err()) {
        // Strangers fill no log.
        assert!(refusal.reason.chars().count() < 200, "{}", refusal.reason);
    }
    let host = headers.get(HOST).and_then(authority);
    let is_rebound = host.as_ref().is_some_and(|(name, _)| !is_own(name));
    assert!(get.is_err() || !is_rebound, "a GET for {host:?}");
    let mut origins = headers.get_all(ORIGIN).iter();
    let is_foreign = origins.any(|origin| site(origin).is_some() && site(origin) != host);
    assert!(
        get.is_err() || !is_foreign,
        "a GET from a page of another site"
    );
    if headers.contains_key(ORIGIN) {
        assert!(post.is_err() || !is_rebound, "a POST for {host:?}");
        assert!(
            post.is_err() || !is_foreign,
            "a POST from a page of another site"
        );
    }
}

/// Host and port of an origin with the scheme `http`. `None` for what no browser sends; then `Some` with an empty host
/// for an origin with another scheme.
fn site(origin: &HeaderValue) -> Option<(String, u16)> {
    let uri: Uri = origin.to_str().ok()?.parse().ok()?;
    match uri.scheme_str()? {
        "http" => Some((uri.host()?.to_lowercase(), uri.port_u16().unwrap_or(80))),
        _ => Some((String::new(), 0)),
    }
}

/// Host and port of a `Host` header. `None` for what no browser sends.
fn authority(host: &HeaderValue) -> Option<(String, u16)> {
    let uri: Uri = format!("http://{}/", host.to_str().ok()?).parse().ok()?;
    // A browser sends no name of a user.
    let is_plain = !uri.authority()?.as_str().contains('@');
    let port = uri.port_u16().unwrap_or(80);
    is_plain.then(|| (uri.host().unwrap_or_default().to_lowercase(), port))
}

/// Whether a page of this host can only be one of rosrescue's own.
fn is_own(host: &str) -> bool {
    // A browser takes an address with a dot at its end for the address, and asks no name server.
    let name = host.strip_suffix('.').unwrap_or(host);
    let bare = name.trim_start_matches('[').trim_end_matches(']');
    bare.parse::<IpAddr>().is_ok() || name == "localhost" || NAMES.contains(&name)
}
