//! Resolves host names. Callers that ask for the same name within a second share one lookup. Each lookup runs in a
//! thread of its own, so a dead name server delays neither the tokio runtime nor the end of the process.

use std::{
    collections::BTreeMap,
    io,
    net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, ToSocketAddrs, UdpSocket},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use tokio::sync::{Semaphore, watch};

/// Maximum number of lookups at the same time. There is a limit because a dead name server blocks each thread for about
/// ten seconds.
const LOOKUPS: usize = 64;

/// The addresses of a name without a port, or why there are none.
type Found = Result<Arc<[SocketAddr]>, Arc<io::Error>>;

/// How long after the beginning of a lookup other callers share it. A lookup that began before the name was known may
/// wait for a dead name server for half a minute, while a new one succeeds at once.
const SHARED_FOR: Duration = Duration::from_secs(1);

/// The lookups under way by name, and when they began.
type Lookups = BTreeMap<String, (Instant, watch::Receiver<Option<Found>>)>;

static PERMITS: Semaphore = Semaphore::const_new(LOOKUPS);
static UNDER_WAY: Mutex<Lookups> = Mutex::new(BTreeMap::new());

fn under_way() -> MutexGuard<'static, Lookups> {
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
    let mut answer = {
        let mut under_way = under_way();
        match under_way.get(host) {
            Some((began, answer)) if began.elapsed() < SHARED_FOR => answer.clone(),
            _ => {
                let (tell, answer) = watch::channel(None);
                let began = Instant::now();
                under_way.insert(host.to_owned(), (began, answer.clone()));
                tokio::spawn(look_up(host.to_owned(), began, tell));
                answer
            }
        }
    };
    let found = answer.wait_for(Option::is_some).await;
    let found = found.map_err(io::Error::other)?.clone();
    match found {
        Some(Ok(addresses)) => Ok(addresses.iter().map(|at| with_port(*at, port)).collect()),
        Some(Err(error)) => Err(io::Error::new(error.kind(), error)),
        None => Err(io::ErrorKind::NotFound.into()),
    }
}

/// Whether `address` belongs to this computer. If it does, the kernel chooses `address` itself as the source address of
/// packets to `address`. Sends no packet.
pub fn is_own(address: IpAddr) -> bool {
    let any = match address {
        IpAddr::V4(_) => IpAddr::V4(Ipv4Addr::UNSPECIFIED),
        IpAddr::V6(_) => IpAddr::V6(Ipv6Addr::UNSPECIFIED),
    };
    let source = || {
        let socket = UdpSocket::bind((any, 0))?;
        socket.connect((address, 9))?;
        Ok::<_, io::Error>(socket.local_addr()?.ip())
    };
    address.is_loopback() || address.is_unspecified() || source().is_ok_and(|own| own == address)
}

/// Sets the port and keeps the scope of an IPv6 address.
fn with_port(mut address: SocketAddr, port: u16) -> SocketAddr {
    address.set_port(port);
    address
}

/// Drops the entry of the lookup that began at `began`. A later one for the same name goes on.
fn forget(host: &str, began: Instant) {
    let mut under_way = under_way();
    if under_way.get(host).is_some_and(|(of, _)| *of == began) {
        under_way.remove(host);
    }
}

async fn look_up(host: String, began: Instant, tell: watch::Sender<Option<Found>>) {
    // The semaphore is never closed.
    let permit = PERMITS.acquire().await;
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

    #[tokio::test]
    async fn a_lookup_that_takes_long_does_not_delay_a_later_one() {
        let (_never, answer) = watch::channel(None);
        let began = Instant::now().checked_sub(SHARED_FOR).unwrap();
        under_way().insert("ip6-localhost".to_owned(), (began, answer));
        // The answer itself depends on this computer's `/etc/hosts`.
        let _ = addresses("ip6-localhost", 4711).await;
        assert!(under_way().get("ip6-localhost").is_none());
    }
}
