//! What stands between rosrescue and a master, and swallows replies.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::{Arc, Mutex};
use std::thread;

use super::rescue::{Rescue, Setup};
use super::ros::Rosmaster;
use super::scratch::Scratch;

/// A marker in a request, and how many replies to such requests are to be swallowed yet.
type Hunger = Arc<Mutex<(Vec<u8>, u32)>>;

/// Relays connections to a port on this computer. Ends with the test's process.
#[derive(Debug)]
pub(crate) struct Relay {
    port: u16,
    hunger: Hunger,
    target: Arc<Mutex<u16>>,
    /// The connections to the present target.
    open: Arc<Mutex<Vec<TcpStream>>>,
}

impl Relay {
    /// A rosmaster behind a relay, and rosrescue before it.
    pub(crate) fn between(scratch: &Scratch) -> (Rosmaster, Self, Rescue) {
        let master = Rosmaster::start(scratch);
        let relay = Self::to(master.port);
        let rescue = Setup::proxy(scratch, relay.port()).start();
        (master, relay, rescue)
    }

    /// A relay to `port`.
    pub(crate) fn to(port: u16) -> Self {
        let listener = TcpListener::bind(("127.0.0.1", 0)).unwrap();
        let hunger = Hunger::default();
        let (target, open) = (Arc::new(Mutex::new(port)), Arc::default());
        let relay = Self {
            port: listener.local_addr().unwrap().port(),
            hunger: hunger.clone(),
            target: Arc::clone(&target),
            open: Arc::clone(&open),
        };
        thread::spawn(move || {
            for near in listener.incoming().map_while(Result::ok) {
                let port = *target.lock().unwrap();
                // Without a master the connection is closed.
                if let Ok(far) = TcpStream::connect(("127.0.0.1", port)) {
                    let hunger = hunger.clone();
                    open.lock().unwrap().push(near.try_clone().unwrap());
                    thread::spawn(move || carry(&near, &far, &hunger));
                }
            }
        });
        relay
    }

    /// Where it listens.
    pub(crate) fn port(&self) -> u16 {
        self.port
    }

    /// From now on it leads to `port`, and its connections end: a virtual address moves, or a cable is
    /// cut if nobody listens there.
    pub(crate) fn turn_to(&self, port: u16) {
        *self.target.lock().unwrap() = port;
        for connection in self.open.lock().unwrap().drain(..) {
            let _ = connection.shutdown(Shutdown::Both);
        }
    }

    /// The next `count` requests that hold `marker` reach the master, and their replies do not come
    /// back: the connection is closed instead.
    pub(crate) fn swallow(&self, marker: &str, count: u32) {
        *self.hunger.lock().unwrap() = (marker.into(), count);
    }

    /// How many replies are to be swallowed yet.
    pub(crate) fn hunger(&self) -> u32 {
        self.hunger.lock().unwrap().1
    }
}

fn carry(near: &TcpStream, far: &TcpStream, hunger: &Hunger) {
    let request = Arc::new(Mutex::new(Vec::new()));
    let (mut from, mut to) = (near.try_clone().unwrap(), far.try_clone().unwrap());
    let seen = request.clone();
    thread::spawn(move || {
        let mut buffer = [0; 65536];
        while let Ok(count @ 1..) = from.read(&mut buffer) {
            seen.lock().unwrap().extend_from_slice(&buffer[..count]);
            if to.write_all(&buffer[..count]).is_err() {
                break;
            }
        }
        let _ = to.shutdown(Shutdown::Both);
    });
    let (mut far, mut near) = (far, near);
    let mut buffer = [0; 65536];
    while let Ok(count @ 1..) = far.read(&mut buffer) {
        // The master has run what it answers.
        let request = std::mem::take(&mut *request.lock().unwrap());
        let mut hunger = hunger.lock().unwrap();
        let (marker, left) = &mut *hunger;
        if *left > 0 && request.windows(marker.len()).any(|part| part == marker) {
            *left -= 1;
            break;
        }
        drop(hunger);
        if near.write_all(&buffer[..count]).is_err() {
            break;
        }
    }
    let _ = near.shutdown(Shutdown::Both);
    let _ = far.shutdown(Shutdown::Both);
}
