//! A cluster of etcd servers.

use std::{
    fs::File,
    process::{Child, Command},
    time::{Duration, Instant},
};

use rescue_core::cluster::journal::Keys;
use rosrescue::cluster::etcd::{Credentials, Etcd, Options};
use rustix::process::Signal;

use super::patience::PATIENCE;
use super::process::{signal, stop};
use super::scratch::{Scratch, free_port};

/// How long an answer may take on two busy cores.
pub(crate) const LIMIT: Duration = Duration::from_secs(20);

#[derive(Debug)]
pub(crate) struct Servers {
    pub(crate) scratch: Scratch,
    members: Vec<Member>,
    arguments: Vec<String>,
    scheme: &'static str,
}

#[derive(Debug)]
struct Member {
    client: u16,
    peer: u16,
    child: Option<Child>,
}

impl Servers {
    pub(crate) async fn new(count: usize) -> Self {
        Self::with(Scratch::new(), count, "http", &[]).await
    }

    /// Starts a cluster whose members get further arguments for etcd.
    pub(crate) async fn with(
        scratch: Scratch,
        count: usize,
        scheme: &'static str,
        arguments: &[&str],
    ) -> Self {
        let members = (0..count).map(|_| Member {
            client: free_port(),
            peer: free_port(),
            child: None,
        });
        let mut servers = Self {
            scratch,
            members: members.collect(),
            arguments: arguments
                .iter()
                .map(|argument| (*argument).to_owned())
                .collect(),
            scheme,
        };
        (0..count).for_each(|index| servers.start(index));
        if scheme == "http" {
            let keys = Keys::new("robot");
            let client = servers.client();
            client.view(&keys, PATIENCE).await.unwrap();
            // A member answers only after the others have got to know its address.
            let start = Instant::now();
            while let Some(error) = client.status(LIMIT).await.into_iter().find_map(Result::err) {
                assert!(start.elapsed() < PATIENCE, "{error}");
                tokio::time::sleep(Duration::from_millis(10)).await;
            }
        }
        servers
    }

    pub(crate) fn start(&mut self, index: usize) {
        let all = self.members.iter().enumerate();
        let all = all.map(|(at, member)| format!("m{at}=http://127.0.0.1:{}", member.peer));
        let all = all.collect::<Vec<_>>().join(",");
        let Member { client, peer, .. } = self.members[index];
        let (client, peer) = (
            format!("{}://127.0.0.1:{client}", self.scheme),
            format!("http://127.0.0.1:{peer}"),
        );
        let log = self.scratch.path(format!("etcd{index}.log"));
        let log = File::options().create(true).append(true).open(log).unwrap();
        let mut command = Command::new("etcd");
        command
            .args(["--name", &Self::folder(index), "--initial-cluster", &all])
            .arg("--data-dir")
            .arg(self.scratch.path(Self::folder(index)))
            .args([
                "--listen-client-urls",
                &client,
                "--advertise-client-urls",
                &client,
            ])
            .args([
                "--listen-peer-urls",
                &peer,
                "--initial-advertise-peer-urls",
                &peer,
            ])
            .args(["--logger", "zap"])
            .args(&self.arguments)
            .stdout(log.try_clone().unwrap())
            .stderr(log);
        self.scratch.prepare(&mut command);
        let child = command
            .spawn()
            .expect("etcd is not installed: run `. tests/install_etcd.sh`");
        self.members[index].child = Some(child);
    }

    pub(crate) fn pid(&self, index: usize) -> u32 {
        self.members[index].child.as_ref().unwrap().id()
    }

    pub(crate) fn kill(&mut self, index: usize) {
        let mut child = self.members[index].child.take().unwrap();
        child.kill().unwrap();
        child.wait().unwrap();
    }

    /// Stops a member, so that it hangs.
    pub(crate) fn stop(&self, index: usize) {
        stop(self.pid(index));
    }

    pub(crate) fn go_on(&self, index: usize) {
        signal(self.pid(index), Signal::CONT);
    }

    pub(crate) fn count(&self) -> usize {
        self.members.len()
    }

    /// The endpoints of all members, starting with number `first`.
    pub(crate) fn endpoints(&self, first: usize) -> Vec<String> {
        let all = self
            .members
            .iter()
            .cycle()
            .skip(first)
            .take(self.members.len());
        all.map(|member| format!("{}://127.0.0.1:{}", self.scheme, member.client))
            .collect()
    }

    /// The address for other members, which serves no client.
    pub(crate) fn peer(&self, index: usize) -> String {
        format!("http://127.0.0.1:{}", self.members[index].peer)
    }

    pub(crate) fn client(&self) -> Etcd {
        self.client_of(0, Credentials::default())
    }

    pub(crate) fn client_of(&self, first: usize, access: Credentials) -> Etcd {
        let endpoints = self.endpoints(first);
        Etcd::new(&Options { endpoints, access }).unwrap()
    }

    /// The number of the member that leads etcd.
    pub(crate) async fn leader(&self) -> usize {
        let (client, start) = (self.client(), Instant::now());
        loop {
            assert!(start.elapsed() < PATIENCE, "etcd has no leader");
            let all = client.status(Duration::from_secs(1)).await;
            if let Some(at) = all
                .iter()
                .position(|status| matches!(status, Ok(it) if it.is_leader))
            {
                return at;
            }
        }
    }

    /// Sends a request to etcd's JSON gateway and returns the answer, like `etcdctl`.
    pub(crate) fn post(&self, path: &str, body: &serde_json::Value) -> serde_json::Value {
        self.post_to(0, path, body)
    }

    pub(crate) fn post_to(
        &self,
        index: usize,
        path: &str,
        body: &serde_json::Value,
    ) -> serde_json::Value {
        let url = format!("127.0.0.1:{}", self.members[index].client);
        post(&url, path, body)
    }

    /// The name of a member, which is also that of its folder.
    pub(crate) fn folder(index: usize) -> String {
        format!("m{index}")
    }
}

/// Sends a request without rosrescue's etcd client.
fn post(authority: &str, path: &str, body: &serde_json::Value) -> serde_json::Value {
    use std::io::{Read, Write};
    let mut stream = std::net::TcpStream::connect(authority).unwrap();
    let body = body.to_string();
    write!(
        stream,
        "POST /v3/{path} HTTP/1.0\r\nContent-Length: {}\r\n\r\n{body}",
        body.len()
    )
    .unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    let (_, body) = answer.split_once("\r\n\r\n").unwrap();
    serde_json::from_str(body).unwrap()
}
