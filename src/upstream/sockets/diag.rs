//! Asks the kernel for its TCP sockets in some states (`sock_diag(7)`), which costs much less than the tables in /proc:
//! those list every socket as text.

use std::{
    io,
    net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr},
};

use super::Socket;
use rustix::net::{
    AddressFamily, RecvFlags, SendFlags, SocketFlags, SocketType, netlink, recv, send, socket_with,
};

/// Numbers of the kernel: the request and its answers, the end of the answers, `NLM_F_REQUEST | NLM_F_DUMP`.
const BY_FAMILY: u16 = 20;
const DONE: u16 = 3;
const DUMP: u16 = 0x1 | 0x300;
const TCP: u8 = 6;
const INET: u8 = 2;
const INET6: u8 = 10;
/// Length of the header of each message.
const HEADER: usize = 16;
/// Length of the request, with its header.
const REQUEST: u32 = 72;

/// The TCP sockets of this network namespace in these states.
///
/// # Errors
///
/// If the kernel or a sandbox does not offer this.
pub(super) fn in_states(states: &[u8]) -> io::Result<Vec<Socket>> {
    let socket = socket_with(
        AddressFamily::NETLINK,
        SocketType::DGRAM,
        SocketFlags::CLOEXEC,
        Some(netlink::SOCK_DIAG),
    )?;
    let mut all = Vec::new();
    for family in [INET, INET6] {
        send(&socket, &request(family, states), SendFlags::empty())?;
        let mut buffer = vec![0; 32_768];
        loop {
            let (_, length) = recv(&socket, &mut buffer[..], RecvFlags::empty())?;
            if read(buffer.get(..length).unwrap_or_default(), &mut all)? {
                break;
            }
        }
    }
    Ok(all)
}

fn request(family: u8, states: &[u8]) -> Vec<u8> {
    let bits: u32 = states.iter().map(|state| 1 << state).sum();
    let mut request = Vec::new();
    request.extend(REQUEST.to_ne_bytes());
    request.extend(BY_FAMILY.to_ne_bytes());
    request.extend(DUMP.to_ne_bytes());
    // The sequence number and the sender.
    request.extend([0; 8]);
    request.extend([family, TCP, 0, 0]);
    request.extend(bits.to_ne_bytes());
    // Any address.
    request.resize(REQUEST as usize, 0);
    request
}

/// Reads the sockets in `messages`. Returns whether they are the last ones.
fn read(mut messages: &[u8], all: &mut Vec<Socket>) -> io::Result<bool> {
    while let Some((length, _)) = messages.split_first_chunk::<4>() {
        let length = u32::from_ne_bytes(*length) as usize;
        let body = messages.get(HEADER..length).unwrap_or_default();
        let kind = messages.get(4..6).and_then(|kind| kind.try_into().ok());
        match kind.map(u16::from_ne_bytes) {
            Some(BY_FAMILY) => all.extend(socket(body)),
            Some(DONE) => return Ok(true),
            _ => return Err(io::ErrorKind::Unsupported.into()),
        }
        messages = messages
            .get(length.next_multiple_of(4).max(HEADER)..)
            .unwrap_or_default();
    }
    Ok(false)
}

/// Reads a socket (`struct inet_diag_msg`).
fn socket(body: &[u8]) -> Option<Socket> {
    let number = |at: usize| Some(u32::from_ne_bytes(body.get(at..at + 4)?.try_into().ok()?));
    let address = |ip: usize, port: usize| {
        let port = u16::from_be_bytes(body.get(port..port + 2)?.try_into().ok()?);
        let ip: [u8; 16] = body.get(ip..ip + 16)?.try_into().ok()?;
        let ip: IpAddr = match (*body.first()?, ip) {
            (INET, [a, b, c, d, ..]) => Ipv4Addr::new(a, b, c, d).into(),
            _ => Ipv6Addr::from(ip).to_canonical(),
        };
        Some(SocketAddr::new(ip, port))
    };
    Some(Socket {
        local: address(8, 4)?,
        remote: address(24, 6)?,
        state: *body.get(1)?,
        user: number(64)?,
        inode: number(68)?.into(),
    })
}
