//! Decides which clients may call and which may make changes, according to `--allow` and `--allow-write`.

use std::{
    collections::HashMap,
    fmt,
    net::IpAddr,
    time::{Duration, Instant},
};

use hyper::StatusCode;
use ipnet::IpNet;
use rescue_core::admission::Rejection;
use ros1_master::master::Kind;

/// Pause between two log lines about the same address. A refused node calls again up to 20 times per second.
const SAY_AGAIN: Duration = Duration::from_secs(60);
/// Maximum number of addresses whose last log line is remembered. Calls from further addresses are counted but not
/// logged.
const REMEMBERED: usize = 1000;

/// The networks of `--allow` and `--allow-write`. An empty list allows all clients.
#[derive(Clone, Debug, Default)]
pub(crate) struct AccessRules {
    allow: Vec<IpNet>,
    allow_write: Vec<IpNet>,
}

/// What a client may do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Grant {
    Nothing,
    Read,
    Write,
}

impl AccessRules {
    pub(crate) fn new(allow: Vec<IpNet>, allow_write: Vec<IpNet>) -> Self {
        Self { allow, allow_write }
    }

    /// What a connection from `peer` to the address `own` of this computer may do. This computer may do everything,
    /// because rosmaster, rosout and the robot's own nodes run here. A client that may make changes may also read.
    pub(crate) fn grant_for(&self, peer: IpAddr, own: Option<IpAddr>) -> Grant {
        let peer = peer.to_canonical();
        let here = peer.is_loopback() || own.map(|own| own.to_canonical()) == Some(peer);
        let is_in = |nets: &[IpNet]| nets.iter().any(|net| net.contains(&peer));
        let writes = is_in(&self.allow_write);
        match (here || writes, self.allow.is_empty() || is_in(&self.allow)) {
            (true, _) => Grant::Write,
            (_, true) if self.allow_write.is_empty() => Grant::Write,
            (_, true) => Grant::Read,
            (_, false) => Grant::Nothing,
        }
    }
}

impl Grant {
    /// Accepts a request of any kind, or refuses it.
    pub(crate) fn check(self, peer: IpAddr) -> Result<(), Rejection> {
        match self {
            Self::Nothing => Err(refusal(peer, "call", "--allow")),
            Self::Read | Self::Write => Ok(()),
        }
    }

    /// Accepts or refuses a call of this kind. The kind is `None` if the call could not be decoded. Such a call, and a
    /// call of an unknown kind, counts as a change, because only the master knows what it does.
    pub(crate) fn check_call(self, peer: IpAddr, kind: Option<Kind>) -> Result<(), Rejection> {
        match (self, kind) {
            (Self::Write, _) | (Self::Read, Some(Kind::Read | Kind::Identity)) => Ok(()),
            (Self::Read | Self::Nothing, _) => Err(refusal(peer, "change", "--allow-write")),
        }
    }
}

/// The answer to a refused call. rospy and roscpp treat this status like a master that is not running yet, and call
/// again. An XML-RPC fault would end a node that is starting.
fn refusal(peer: IpAddr, what: &str, option: &str) -> Rejection {
    let reason = match what {
        "call" => {
            format!("{peer} may not call this master: its address is not in rosrescue's {option}")
        }
        _ => format!(
            "{peer} may only read from this master: its address is not in rosrescue's {option}"
        ),
    };
    Rejection {
        status: StatusCode::FORBIDDEN,
        reason,
    }
}

/// Describes the networks for the log at the start.
impl fmt::Display for AccessRules {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let list = |nets: &[IpNet]| {
            let mut names: Vec<_> = nets.iter().map(|net| net.trunc().to_string()).collect();
            names.insert(0, "this computer".to_owned());
            names.join(", ")
        };
        let may_call: Vec<_> = [&self.allow[..], &self.allow_write].concat();
        match (self.allow.is_empty(), self.allow_write.is_empty()) {
            (true, true) => f.write_str("everybody may call and change"),
            (false, true) => write!(
                f,
                "only these networks may call and change: {}",
                list(&self.allow)
            ),
            (true, false) => write!(
                f,
                "everybody may read, only these networks may change: {}",
                list(&self.allow_write)
            ),
            (false, false) => write!(
                f,
                "only these networks may call: {}; only these may change: {}",
                list(&may_call),
                list(&self.allow_write)
            ),
        }
    }
}

/// When a refusal of each address was last logged.
#[derive(Debug, Default)]
pub(crate) struct LastLogged(HashMap<IpAddr, Instant>);

impl LastLogged {
    /// Whether to log a refusal of `peer` now.
    pub(crate) fn is_due(&mut self, now: Instant, peer: IpAddr) -> bool {
        let is_recent = |said: &Instant| now.duration_since(*said) < SAY_AGAIN;
        if self.0.get(&peer).is_some_and(is_recent) {
            return false;
        }
        if self.0.len() >= REMEMBERED {
            self.0.retain(|_, said| is_recent(said));
        }
        let due = self.0.len() < REMEMBERED;
        if due {
            self.0.insert(peer, now);
        }
        due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn nets(list: &[&str]) -> Vec<IpNet> {
        list.iter().map(|net| net.parse().unwrap()).collect()
    }

    fn grant(allow: &[&str], write: &[&str], peer: &str) -> Grant {
        let own = "10.0.0.7".parse().unwrap();
        AccessRules::new(nets(allow), nets(write)).grant_for(peer.parse().unwrap(), Some(own))
    }

    #[test]
    fn networks_say_who_may_call_and_who_may_change() {
        use Grant::{Nothing, Read, Write};
        const LAN: [&str; 2] = ["10.0.0.0/24", "fd00::/64"];
        for (allow, write, peer, may) in [
            (&[][..], &[][..], "192.0.2.1", Write),
            (&LAN, &[], "10.0.0.9", Write),
            (&LAN, &[], "::ffff:10.0.0.9", Write),
            (&LAN, &[], "fd00::9", Write),
            (&LAN, &[], "10.0.1.9", Nothing),
            (&LAN, &[], "fd00:0:0:1::9", Nothing),
            (&[], &LAN, "10.0.0.9", Write),
            (&[], &LAN, "192.0.2.1", Read),
            (&LAN, &["10.0.0.8/32"], "10.0.0.8", Write),
            (&LAN, &["10.0.0.8/32"], "10.0.0.9", Read),
            (&LAN, &["10.0.0.8/32"], "192.0.2.1", Nothing),
            // A client that may make changes may also read.
            (&LAN, &["192.0.2.1/32"], "192.0.2.1", Write),
            // A network of one address family contains no address of the other.
            (&["0.0.0.0/0"], &[], "fd00::9", Nothing),
            (&["::/0"], &[], "10.0.0.9", Nothing),
            // This computer may always make changes.
            (&["192.0.2.0/24"], &["192.0.2.1/32"], "127.0.0.1", Write),
            (&["192.0.2.0/24"], &["192.0.2.1/32"], "::1", Write),
            (&["192.0.2.0/24"], &["192.0.2.1/32"], "10.0.0.7", Write),
        ] {
            assert_eq!(grant(allow, write, peer), may, "{allow:?} {write:?} {peer}");
        }
    }

    #[test]
    fn what_may_change_something_is_a_change() {
        let peer = "10.0.0.9".parse().unwrap();
        let may = |grant: Grant, kind| grant.check_call(peer, kind).is_ok();
        for kind in [Kind::Identity, Kind::Read] {
            assert!(may(Grant::Read, Some(kind)), "{kind:?}");
        }
        for kind in [
            Kind::Unregister,
            Kind::Mutate,
            Kind::Unknown,
            Kind::Shutdown,
        ] {
            assert!(!may(Grant::Read, Some(kind)), "{kind:?}");
            assert!(may(Grant::Write, Some(kind)), "{kind:?}");
        }
        assert!(!may(Grant::Read, None));
        assert!(may(Grant::Write, None));
        assert!(Grant::Read.check(peer).is_ok());
        assert_eq!(Grant::Nothing.check(peer).unwrap_err().status.as_u16(), 403);
    }

    #[test]
    fn the_start_says_who_may() {
        let says =
            |allow: &[&str], write: &[&str]| AccessRules::new(nets(allow), nets(write)).to_string();
        assert_eq!(
            says(&["10.0.0.7/24"], &["fd00::/64"]),
            "only these networks may call: this computer, 10.0.0.0/24, fd00::/64; only these may change: \
             this computer, fd00::/64"
        );
        assert_eq!(
            says(&[], &["10.0.0.8/32"]),
            "everybody may read, only these networks may change: this computer, 10.0.0.8/32"
        );
    }

    #[test]
    fn an_address_is_spoken_of_once_a_minute() {
        let (mut said, now) = (LastLogged::default(), Instant::now());
        let peer = |number: usize| IpAddr::from(u128::try_from(number).unwrap().to_be_bytes());
        assert!(said.is_due(now, peer(0)));
        assert!(!said.is_due(now, peer(0)));
        assert!(said.is_due(now, peer(1)));
        assert!(said.is_due(now + SAY_AGAIN, peer(0)));
        let spoken =
            (0..3 * REMEMBERED).filter(|&number| said.is_due(now + SAY_AGAIN, peer(number)));
        assert_eq!(spoken.count(), REMEMBERED - 1);
        assert!(said.is_due(now + 3 * SAY_AGAIN, peer(2 * REMEMBERED)));
    }
}
