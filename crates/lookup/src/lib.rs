//! Resolves host names. Callers that ask for the same name at about the same time share one lookup. Each lookup runs in
//! a thread of its own, so a dead name server delays neither the tokio runtime nor the end of the process.

use std::{
    collections::BTreeMap,
    io,
    net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, ToSocketAddrs, UdpSocket},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use tokio::sync::{Semaphore, SemaphorePermit, watch};

/// Maximum number of lookups at the same time, one per name. There is a limit because a dead name server blocks each
/// thread for 10 to 30 seconds.
const LOOKUPS: usize = 64;

/// Maximum number of further lookups of names that are being looked up already.
const REPEATED: usize = 32;

/// The addresses of a name without a port, or why there are none.
type Found = Result<Arc<[SocketAddr]>, Arc<io::Error>>;

/// How long callers share the first lookup of a name. They share each further one twice as long as the one before. A
/// lookup that began before the name was known may wait for a dead name server for half a minute, while a new one
/// succeeds at once.
const SHARED_FOR: Duration = Duration::from_secs(1);

/// The last lookup of a name that is under way.
struct Lookup {
    began: Instant,
    /// For how long others share it.
    shared_for: Duration,
    answer: watch::Receiver<Option<Found>>,
}

static PERMITS: Semaphore = Semaphore::const_new(LOOKUPS);
static REPEATS: Semaphore = Semaphore::const_new(REPEATED);
static UNDER_WAY: Mutex<BTreeMap<String, Lookup>> = Mutex::new(BTreeMap::new());

fn under_way() -> MutexGuard<'static, BTreeMap<String, Lookup>> {
    UNDER_WAY.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Looks up the addresses of `host` and adds `port`. IPv4 addresses come first, as in roscpp.
///
/// # Errors
///
/// If the host has no address, or the lookup fails.
pub async fn addresses(host: &str, port: u16) -> io::Result<Vec<SocketAddr>> {
    if let Ok(address) = host.parse::<IpAddr>() {
        return Ok(vec![SocketAddr::new(address, port)]);
    }
    let mut answer = share_or_begin(host);
    let found = answer.wait_for(Option::is_some).await;
    let found = found.map_err(io::Error::other)?.clone();
    match found {
        Some(Ok(addresses)) => Ok(addresses.iter().map(|at| with_port(*at, port)).collect()),
        Some(Err(error)) => Err(io::Error::new(error.kind(), error)),
        None => Err(io::ErrorKind::NotFound.into()),
    }
}

/// The answer of a lookup of `host` that is under way or begins now.
fn share_or_begin(host: &str) -> watch::Receiver<Option<Found>> {
    let mut under_way = under_way();
    let (shared_for, permit) = match under_way.get(host) {
        None => (SHARED_FOR, None),
        Some(last) if last.began.elapsed() < last.shared_for => return last.answer.clone(),
        Some(last) => match REPEATS.try_acquire() {
            Ok(permit) => (2 * last.shared_for, Some(permit)),
            Err(_) => return last.answer.clone(),
        },
    };
    let (tell, answer) = watch::channel(None);
    let began = Instant::now();
    let lookup = Lookup {
        began,
        shared_for,
        answer: answer.clone(),
    };
    under_way.insert(host.to_owned(), lookup);
    tokio::spawn(look_up(host.to_owned(), began, permit, tell));
    answer
}

/// Whether `address` belongs to this computer. If it does, the kernel chooses `address` itself as the source address of
/// packets to `address`. Sends no packet. A link-local address leads nowhere without its scope, so the kernel's list of
/// addresses says whose it is.
pub fn is_own(address: IpAddr) -> bool {
    let any = match address {
        IpAddr::V4(_) => IpAddr::V4(Ipv4Addr::UNSPECIFIED),
        IpAddr::V6(_) => IpAddr::V6(Ipv6Addr::UNSPECIFIED),
    };
    if let IpAddr::V6(link_local) = address
        && link_local.is_unicast_link_local()
    {
        let table = std::fs::read_to_string("/proc/net/if_inet6");
        return table.is_ok_and(|table| lists(&table, link_local));
    }
    let source = || {
        let socket = UdpSocket::bind((any, 0))?;
        socket.connect((address, 9))?;
        Ok::<_, io::Error>(socket.local_addr()?.ip())
    };
    address.is_loopback() || address.is_unspecified() || source().is_ok_and(|own| own == address)
}

/// Whether `table` has `address`: `/proc/net/if_inet6` begins each line with an address of 32 digits.
fn lists(table: &str, address: Ipv6Addr) -> bool {
    let address = format!("{:032x}", address.to_bits());
    table.lines().any(|line| line.starts_with(&address))
}

/// Sets the port and keeps the scope of an IPv6 address.
fn with_port(mut address: SocketAddr, port: u16) -> SocketAddr {
    address.set_port(port);
    address
}

/// Drops the entry of the lookup that began at `began`. A later one for the same name goes on.
fn forget(host: &str, began: Instant) {
    let mut under_way = under_way();
    if under_way.get(host).is_some_and(|last| last.began == began) {
        under_way.remove(host);
    }
}

/// Looks up the addresses of `host` in a thread, and gives them to `tell`. Waits for a permit if `permit` is `None`.
async fn look_up(
    host: String,
    began: Instant,
    permit: Option<SemaphorePermit<'static>>,
    tell: watch::Sender<Option<Found>>,
) {
    let permit = match permit {
        Some(permit) => Some(permit),
        // The semaphore is never closed.
        None => PERMITS.acquire().await.ok(),
    };
    let name = host.clone();
    let search = move || {
        let _permit = permit;
        let found = (name.as_str(), 0).to_socket_addrs();
        let found = found.map_err(Arc::new).map(|addresses| {
            let mut addresses: Vec<_> = addresses.collect();
            addresses.sort_by_key(SocketAddr::is_ipv6);
            addresses.dedup();
            addresses.into()
        });
        // The entry is removed before the result is sent, so that later callers start a new lookup.
        forget(&name, began);
        tell.send_replace(Some(found));
    };
    // If no thread can be started, the sender is dropped, and the waiting callers get an error.
    let named = std::thread::Builder::new().name("lookup".to_owned());
    if named.spawn(search).is_err() {
        forget(&host, began);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_name_is_looked_up_and_an_address_is_not() {
        let local = addresses("localhost", 4711).await.unwrap();
        assert!(local.iter().all(|at| at.ip().is_loopback()), "{local:?}");
        assert!(local.iter().all(|at| at.port() == 4711), "{local:?}");
        assert_eq!(addresses("::1", 4711).await.unwrap().len(), 1);
        assert!(under_way().get("::1").is_none());
        let nobody = addresses("nobody.invalid", 4711).await;
        assert!(nobody.is_err(), "{nobody:?}");
    }

    #[test]
    fn a_link_local_address_is_found_in_the_kernels_list() {
        let table = "00000000000000000000000000000001 01 80 10 80       lo\n\
                     fe800000000000000042acfffe110002 02 40 20 80     eth0\n";
        let lists = |address: &str| lists(table, address.parse().unwrap());
        assert!(lists("fe80::42:acff:fe11:2") && !lists("fe80::42:acff:fe11:3"));
        assert!(!is_own("fe80::1:2:3:4".parse().unwrap()));
    }

    /// Puts a lookup that never ends under way.
    fn never_ending(host: &str, age: Duration) -> watch::Sender<Option<Found>> {
        let (never, answer) = watch::channel(None);
        let lookup = Lookup {
            began: Instant::now().checked_sub(age).unwrap(),
            shared_for: SHARED_FOR,
            answer,
        };
        under_way().insert(host.to_owned(), lookup);
        never
    }

    #[tokio::test]
    async fn a_lookup_that_takes_long_does_not_delay_a_later_one() {
        let _never = never_ending("ip6-localhost", SHARED_FOR);
        // The answer itself depends on this computer's `/etc/hosts`.
        let _ = addresses("ip6-localhost", 4711).await;
        assert!(under_way().get("ip6-localhost").is_none());
    }

    /// Otherwise a few names of dead computers would block the lookups of all others.
    #[tokio::test]
    async fn a_name_that_is_looked_up_again_and_again_is_looked_up_more_and_more_rarely() {
        let _never = never_ending("again.invalid", SHARED_FOR);
        let began = || under_way().get("again.invalid").map(|of| of.began);
        let (first, _) = (began(), share_or_begin("again.invalid"));
        let second = began();
        assert_ne!(first, second);
        let last = under_way().get("again.invalid").map(|of| of.shared_for);
        assert_eq!(last, Some(2 * SHARED_FOR));
    }
}
