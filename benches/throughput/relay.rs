//! What any hop costs: bytes go to and fro between two sockets, and nobody looks at them.

use std::{
    io::{self, Read, Write},
    net::{Ipv4Addr, Shutdown, TcpListener, TcpStream},
    thread,
};

/// Relays connections to `port` for as long as the process lives. Answers its own port.
pub(crate) fn start(port: u16) -> io::Result<u16> {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?;
    let own = listener.local_addr()?.port();
    thread::spawn(move || {
        for client in listener.incoming().flatten() {
            let Ok(master) = TcpStream::connect((Ipv4Addr::LOCALHOST, port)) else {
                continue;
            };
            let _ = (client.set_nodelay(true), master.set_nodelay(true));
            if let (Ok(client), Ok(master)) = (client.try_clone(), master.try_clone()) {
                thread::spawn(move || pass(client, master));
            }
            thread::spawn(move || pass(master, client));
        }
    });
    Ok(own)
}

fn pass(mut from: TcpStream, mut to: TcpStream) {
    let mut bytes = [0; 16 << 10];
    while let Ok(count @ 1..) = from.read(&mut bytes) {
        if to.write_all(&bytes[..count]).is_err() {
            break;
        }
    }
    let _ = to.shutdown(Shutdown::Write);
}
