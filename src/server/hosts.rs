//! The names under which a browser may reach this computer.
//!
//! In an attack by DNS rebinding, a page of `HOSTNAME.evil.example` calls its own name, which leads to this computer. So
//! a name counts only if it was configured, or if this computer's own files say that it is a name of this computer.

use std::{fs, net::IpAddr};

use rescue_core::admission::without_dot;

use crate::resolver;

/// The names of this computer: those in `configured`, and the names that `/etc/hosts` and `/etc/resolv.conf` add.
pub(crate) fn own_names(configured: Vec<String>) -> Vec<String> {
    let read = |file| fs::read_to_string(file).unwrap_or_default();
    let (hosts, resolv) = (read("/etc/hosts"), read("/etc/resolv.conf"));
    with_files(configured, &hosts, &resolv, resolver::is_own)
}

fn with_files(
    configured: Vec<String>,
    hosts: &str,
    resolv: &str,
    is_own: impl Fn(IpAddr) -> bool,
) -> Vec<String> {
    let mut names = configured;
    names.retain(|name| !name.is_empty());
    for line in hosts.lines() {
        let mut words = words(line);
        let address = words.next().and_then(|word| word.parse().ok());
        if address.is_some_and(&is_own) {
            names.extend(words.map(str::to_owned));
        }
    }
    let short: Vec<_> = names
        .iter()
        .filter(|name| name.parse::<IpAddr>().is_err())
        .map(|name| name.split_once('.').map_or(&**name, |(first, _)| first))
        .filter(|name| !name.eq_ignore_ascii_case("localhost"))
        .map(str::to_owned)
        .collect();
    // `.local` is the domain of the link, by multicast DNS.
    let domains = resolv.lines().flat_map(|line| {
        let mut words = words(line);
        let is_list = matches!(words.next(), Some("search" | "domain"));
        words.filter(move |_| is_list)
    });
    let domains: Vec<_> = domains.chain(["local"]).collect();
    for name in short {
        names.extend(domains.iter().map(|domain| format!("{name}.{domain}")));
        names.push(name);
    }
    for name in &mut names {
        *name = without_dot(name).to_lowercase();
    }
    names.sort_unstable();
    names.dedup();
    names
}

/// The words of a line without its comment.
fn words(line: &str) -> impl Iterator<Item = &str> {
    let text = line.split(['#', ';']).next().unwrap_or_default();
    text.split_whitespace()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_counts_if_it_is_configured_or_in_this_computers_own_files() {
        let hosts =
            "127.0.0.1 localhost\n127.0.1.1 robot.lab robot # own\n10.0.0.9 other\n10.0.0.5 arm\n";
        let resolv = "nameserver 10.0.0.1\nsearch example.com. lab.example\n; domain not.this\n";
        let own = |address: IpAddr| address.is_loopback() || address.to_string() == "10.0.0.5";
        let names = with_files(vec!["Robot".into(), "".into()], hosts, resolv, own);
        let has = |name: &str| names.iter().any(|own| own == name);
        for name in [
            "robot",
            "robot.lab",
            "robot.local",
            "robot.example.com",
            "robot.lab.example",
            "arm",
            "arm.local",
            "localhost",
        ] {
            assert!(has(name), "{name}: {names:?}");
        }
        for name in [
            "other",
            "robot.evil.example",
            "robot.not.this",
            "localhost.local",
            "",
            "evil.robot",
        ] {
            assert!(!has(name), "{name}: {names:?}");
        }
        let names = with_files(vec!["10.0.0.5".into()], "", "search evil.example", own);
        assert_eq!(names, ["10.0.0.5"]);
    }
}
