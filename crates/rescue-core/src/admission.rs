//! Decides from a request's head whether the request is admitted.
//!
//! ROS 1 has no authentication. Two requests can be refused without any ROS client noticing: a call that a web page
//! makes through a browser, and a `shutdown` from another computer.

use std::net::{IpAddr, Ipv6Addr};

use http::{
    HeaderMap, StatusCode,
    header::{HOST, ORIGIN},
};
use ros1_master::master::{MASTER, Request};

/// A refused request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Rejection {
    /// The HTTP status to answer.
    pub status: StatusCode,
    /// The reason, for the log and the answer.
    pub reason: String,
}

/// The browser's own word on where a request comes from. Pages cannot set or remove it.
const SEC_FETCH_SITE: &str = "sec-fetch-site";

/// Whether a POST with these headers may call the master. `names` are the names of this computer.
///
/// Every browser since 2020 sends the page's origin with each POST, or `null` if it hides the origin. No ROS client
/// sends an origin. The content type tells nothing: boards send the same ones as web pages, and a page can send a POST
/// without one.
pub fn check_post(headers: &HeaderMap, names: &[String]) -> Result<(), Rejection> {
    if headers.contains_key(ORIGIN) {
        check_name(headers, |name| is_own(name, names))?;
        check_origin(headers)?;
    }
    check_site(headers)
}

/// Whether a GET with these headers may have a page. Browsers never show the answer to pages of other sites, but a page
/// of another site could occupy `/events`, which allows few connections.
pub fn check_get(headers: &HeaderMap, names: &[String]) -> Result<(), Rejection> {
    check_name(headers, |name| is_own(name, names))?;
    check_origin(headers)
}

/// Whether the request comes from a page of this site, or not from a page.
fn check_origin(headers: &HeaderMap) -> Result<(), Rejection> {
    for origin in headers.get_all(ORIGIN) {
        let origin = String::from_utf8_lossy(origin.as_bytes());
        let site = origin.strip_prefix("http://").map(str::as_bytes);
        let own = headers.get(HOST).map(|host| host.as_bytes());
        if !site
            .zip(own)
            .is_some_and(|(a, b)| a.eq_ignore_ascii_case(b))
        {
            return Err(Rejection {
                status: StatusCode::FORBIDDEN,
                reason: format!("a page of `{origin:.100}` may not call the master"),
            });
        }
    }
    Ok(())
}

/// Whether the browser, if it is one, does not say that the request comes from a page of another site. A page at another
/// port of this computer (`same-site`) is another site.
fn check_site(headers: &HeaderMap) -> Result<(), Rejection> {
    let site = headers.get_all(SEC_FETCH_SITE).iter();
    let mut foreign = site.filter(|site| !matches!(site.as_bytes(), b"same-origin" | b"none"));
    match foreign.next() {
        None => Ok(()),
        Some(_) => Err(Rejection {
            status: StatusCode::FORBIDDEN,
            reason: "a page of another site may not call the master".to_owned(),
        }),
    }
}

/// The name without the dot that ends an absolute one.
pub fn without_dot(name: &str) -> &str {
    name.strip_suffix('.').unwrap_or(name)
}

/// Whether `name` is an address, or exactly one of `names`. After DNS rebinding, a foreign page sends its own name, which
/// leads to this computer.
fn is_own(name: &str, names: &[String]) -> bool {
    let name = without_dot(name);
    name.parse::<IpAddr>().is_ok()
        || name.eq_ignore_ascii_case("localhost")
        || names.iter().any(|own| own.eq_ignore_ascii_case(name))
}

fn check_name(headers: &HeaderMap, is_known: impl Fn(&str) -> bool) -> Result<(), Rejection> {
    let Some(host) = headers.get(HOST) else {
        return Ok(());
    };
    let host = String::from_utf8_lossy(host.as_bytes());
    // Only an IPv6 address has brackets.
    let name = match host.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
        Some((address, port)) if port.is_empty() || port.starts_with(':') => {
            Some(address).filter(|address| address.parse::<Ipv6Addr>().is_ok())
        }
        Some(_) => None,
        None => host.split(':').next(),
    };
    if name.is_some_and(is_known) {
        return Ok(());
    }
    let name = name.unwrap_or(&host);
    Err(Rejection {
        status: StatusCode::FORBIDDEN,
        reason: format!("`{name:.100}` is not a name of this computer; use its address"),
    })
}

/// Whether a call from `peer` may shut the master down.
pub fn may_shut_down(peer: IpAddr) -> bool {
    peer.to_canonical().is_loopback()
}

/// Whether this `shutdown` was meant for a node. A master sends one to a node whose name was taken. It arrives here if
/// a client has registered rosrescue's address as a node's.
pub fn is_for_a_node(call: &Request) -> bool {
    call.caller() == Some(MASTER)
}

#[cfg(test)]
mod tests {
    use http::header::HeaderValue;

    use super::*;

    fn headers(pairs: &[(&'static str, &'static str)]) -> HeaderMap {
        pairs
            .iter()
            .map(|(k, v)| (k.parse().unwrap(), HeaderValue::from_static(v)))
            .collect()
    }

    #[test]
    fn ros_clients_pass() {
        for pairs in [
            &[
                ("host", "robot:11311"),
                ("content-type", "text/xml"),
                ("user-agent", "XMLRPC++ 0.7"),
            ][..],
            &[
                ("host", "any.name.at.all"),
                ("content-type", "text/xml; charset=utf-8"),
            ],
            // Boards, which use the default of curl, wget or ESP-IDF.
            &[
                ("host", "pc:11311\\Accept: */*"),
                ("content-type", "application/x-www-form-urlencoded"),
            ],
            &[("content-type", "text/plain;charset=UTF-8")],
            &[],
        ] {
            assert_eq!(check_post(&headers(pairs), &[]), Ok(()));
        }
    }

    #[test]
    fn web_pages_do_not() {
        let own = ["robot".to_owned()];
        for pairs in [
            &[
                ("origin", "http://evil.example"),
                ("host", "evil.example:11311"),
            ][..],
            &[
                ("origin", "http://evil.example"),
                ("host", "10.0.0.5:11311"),
            ],
            &[("origin", "http://robot:8000"), ("host", "robot:11311")],
            &[("origin", "null"), ("host", "robot:11311")],
            &[("origin", "http://robot:11311")],
            &[("sec-fetch-site", "cross-site"), ("host", "localhost")],
            &[("sec-fetch-site", "same-site"), ("host", "localhost")],
            &[
                ("sec-fetch-site", "cross-site"),
                ("origin", "http://robot:11311"),
                ("host", "robot:11311"),
            ],
        ] {
            let refusal = check_post(&headers(pairs), &own).unwrap_err();
            assert_eq!(refusal.status.as_u16(), 403, "{pairs:?}");
        }
        for host in ["Robot:11311", "10.0.0.5:11311", "[::1]:11311"] {
            let mut same_site = headers(&[("origin", "http://robot:11311")]);
            let origin = format!("http://{}", host.to_lowercase());
            same_site.insert(ORIGIN, origin.parse().unwrap());
            same_site.insert(HOST, host.parse().unwrap());
            same_site.insert(SEC_FETCH_SITE, HeaderValue::from_static("same-origin"));
            assert_eq!(check_post(&same_site, &own), Ok(()));
        }
        let rebound = [
            ("origin", "http://robot.evil.example"),
            ("host", "robot.evil.example"),
        ];
        assert!(check_post(&headers(&rebound), &own).is_err());
        assert!(check_get(&headers(&rebound), &own).is_err());
    }

    #[test]
    fn the_status_page_is_shown_under_the_names_of_this_computer() {
        let check = |host: &'static str, own: &[&str]| {
            let own: Vec<_> = own.iter().map(|name| (*name).to_owned()).collect();
            check_get(&headers(&[("host", host)]), &own).is_ok()
        };
        for (host, own) in [
            ("[::1]:11311", &[][..]),
            ("10.0.0.5", &[]),
            ("localhost:11311", &[]),
            ("ROBOT:11311", &["robot"]),
            ("robot.local:11311", &["robot", "robot.local"]),
            ("robot.example.com.:11311", &["robot.example.com"]),
        ] {
            assert!(check(host, own), "{host} {own:?}");
        }
        for (host, own) in [
            ("evil.example", &["robot"][..]),
            ("robot.evil.example:11311", &["robot", "robot.local"]),
            ("robot2.local", &["robot"]),
            ("evil.robot", &["robot"]),
            ("localhost.evil.example", &["localhost"]),
            ("10.evil.example", &["10.0.0.5"]),
            (".evil.example", &["robot"]),
            ("", &["robot"]),
            ("[robot]:11311", &["robot"]),
            ("[::1]evil.example", &["robot"]),
        ] {
            assert!(!check(host, own), "{host} {own:?}");
        }
    }

    #[test]
    fn only_this_computer_shuts_the_master_down() {
        for (peer, may) in [
            ("127.0.0.1", true),
            ("::1", true),
            ("::ffff:127.0.0.1", true),
            ("10.0.0.7", false),
        ] {
            assert_eq!(may_shut_down(peer.parse().unwrap()), may, "{peer}");
        }
    }
}
