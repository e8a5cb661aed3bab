//! A complete ROS 1 master. Run it with `cargo run --example master 11311`. Nodes find it by `ROS_MASTER_URI`.

#![allow(clippy::disallowed_methods, clippy::disallowed_types)]

use ros1_master::master::{Master, Request};
use ros1_master::xmlrpc::{encode_node_call, encode_reply};
use std::io::{self, BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::{Mutex, PoisonError, mpsc};
use std::{collections::HashMap, env, process, thread};

/// The master, and a queue of calls for each node's address: they stay in order, and a slow node delays no other.
type State = Mutex<(Master, HashMap<String, mpsc::SyncSender<Vec<u8>>>)>;

fn main() -> io::Result<()> {
    let port = env::args().nth(1).unwrap_or_else(|| "11311".to_owned());
    let listener = TcpListener::bind(format!("0.0.0.0:{port}"))?;
    let host = env::var("ROS_HOSTNAME").unwrap_or_else(|_| "localhost".to_owned());
    let uri = format!("http://{host}:{port}/");
    let mut master = Master::default();
    master.set_identity(process::id().cast_signed(), uri);
    let state: &State = Box::leak(Box::new(Mutex::new((master, HashMap::new()))));
    for client in listener.incoming().flatten() {
        thread::spawn(move || serve(client, state));
    }
    Ok(())
}

fn serve(mut client: TcpStream, state: &State) -> io::Result<()> {
    let mut from = BufReader::new(client.try_clone()?);
    loop {
        let request = Request::decode(&read_body(&mut from)?).map_err(io::Error::other)?;
        let answer = encode_reply(&run(&request, state));
        let length = answer.len();
        let head = format!("HTTP/1.1 200 OK\r\nContent-Length: {length}\r\n\r\n").into_bytes();
        client.write_all(&[head, answer].concat())?;
    }
}

/// Answers a call, and queues the notifications that it causes.
fn run(request: &Request, state: &State) -> ros1_master::xmlrpc::Reply {
    let (master, queues) = &mut *state.lock().unwrap_or_else(PoisonError::into_inner);
    let applied = master.apply(request);
    for notice in applied.notices {
        let to = notice.to().to_owned();
        let queue = queues.entry(to.clone()).or_insert_with(|| {
            let (queue, calls) = mpsc::sync_channel(1000);
            // The node may be gone.
            thread::spawn(move || calls.iter().for_each(|call| drop(notify(&to, call))));
            queue
        });
        let _ = queue.try_send(encode_node_call(&notice.call()));
    }
    applied.reply
}

/// Sends `call` to the node at the address `node`, such as `http://robot:40123/`.
fn notify(node: &str, call: Vec<u8>) -> io::Result<()> {
    let at = node.trim_start_matches("http://").trim_end_matches('/');
    let length = call.len();
    let head = format!("POST / HTTP/1.1\r\nHost: {at}\r\nContent-Length: {length}\r\n\r\n");
    let mut node = TcpStream::connect(at)?;
    node.write_all(&[head.into_bytes(), call].concat())?;
    read_body(&mut BufReader::new(node)).map(drop)
}

/// The body of the next HTTP message.
fn read_body(from: &mut impl BufRead) -> io::Result<Vec<u8>> {
    let mut length = 0;
    for line in from.by_ref().lines() {
        let line = line?.to_ascii_lowercase();
        if let Some(value) = line.strip_prefix("content-length:") {
            length = value.trim().parse().map_err(io::Error::other)?;
        } else if line.is_empty() {
            let mut body = vec![0; length];
            return from.read_exact(&mut body).map(|()| body);
        }
    }
    Err(io::ErrorKind::UnexpectedEof.into())
}
