//! The connection to a master that is examined, with the limits of each request.

use std::{
    io,
    net::SocketAddr,
    sync::Arc,
    time::{Duration, Instant},
};

use rescue_core::{
    lifecycle::{Probing, Supervision},
    replay::{self, Inspection, Plan, Token},
};
use ros1_master::{
    master::{self, Master, Request},
    xmlrpc::{Python, Reply},
};
use tokio::task::JoinHandle;

use super::examine::{Contact, ExamineError, Prepared};
use crate::{
    ledger::{Ledger, durability::Mark},
    limit::rarely,
    nodes::client::{self, Reaction},
    process::{self, listeners},
    status::software,
    upstream::{
        CallError, Connection, RawReply, Upstream, inspect, sentinel::Sentinel, sockets,
        verify::Verification,
    },
};

/// Time limit for an injection. 1,000 nodes take 0.3 s on a Xeon.
const INJECTION_LIMIT: Duration = Duration::from_secs(60);
/// Time limit for each step in which a late master catches up. Writes wait meanwhile.
const CATCH_UP_LIMIT: Duration = Duration::from_secs(1);
/// Longest time for rosout to show that it lives. Calls wait meanwhile.
const ROSOUT_LIMIT: Duration = Duration::from_millis(100);
/// Time limit for calls of closed connections to end. A `setParam` of 60,000 keys takes some 10 s.
const SETTLE_LIMIT: Duration = Duration::from_secs(60);
/// Pause between two checks whether calls of closed connections have ended. No event reports their end.
const SETTLE_PAUSE: Duration = Duration::from_millis(5);

/// How the driver reaches masters, and how it tells a hung one from a slow one.
#[derive(Clone)]
pub(crate) struct Reach {
    pub(crate) upstream: Arc<Upstream>,
    pub(crate) supervision: Supervision,
    pub(crate) probing: Probing,
    /// Longest time for the master to answer a probe.
    pub(crate) probe_timeout: Duration,
    /// Pause between two renewals of the sentinel.
    pub(crate) renewal: Duration,
}

/// A connection to the master that `sentinel` is connected to. If the sentinel is still open afterwards, everything that
/// was read and written concerns that one master.
pub(crate) struct LiveMaster {
    reach: Reach,
    sentinel: Arc<Sentinel>,
    connection: Connection,
    /// Whether the master is only catching up, so that each request has a short time.
    catches_up: bool,
}

impl Reach {
    /// Connects to the master that `sentinel` is connected to, to examine it.
    pub(super) async fn to_examine(
        &self,
        sentinel: &Arc<Sentinel>,
    ) -> Result<LiveMaster, ExamineError> {
        let connection = self.while_alive(self.upstream.connect()).await?;
        Ok(self.live(sentinel, connection, false))
    }

    /// Connects to a late master, which must catch up.
    pub(super) async fn to_catch_up(
        &self,
        sentinel: &Arc<Sentinel>,
    ) -> Result<LiveMaster, ExamineError> {
        let connection = within(CATCH_UP_LIMIT, self.upstream.connect()).await?;
        Ok(self.live(sentinel, connection, true))
    }

    fn live(
        &self,
        sentinel: &Arc<Sentinel>,
        connection: Connection,
        catches_up: bool,
    ) -> LiveMaster {
        LiveMaster {
            reach: self.clone(),
            sentinel: sentinel.clone(),
            connection,
            catches_up,
        }
    }

    /// Whether the present master has a run id. False if it does not answer.
    pub(super) async fn has_run_id(&self) -> bool {
        let asked = async {
            let mut connection = self.upstream.connect().await?;
            let reply = connection.call(&replay::has_run_id()).await?;
            Ok::<_, ExamineError>(reply)
        };
        let reply = within(self.probe_timeout, asked).await;
        reply.is_ok_and(|reply| replay::is_run_id_set(&reply))
    }

    /// Waits for slow `work` while the master answers probes.
    async fn while_alive<T, E: Into<ExamineError>>(
        &self,
        work: impl Future<Output = Result<T, E>>,
    ) -> Result<T, ExamineError> {
        tokio::select! {
            // On a busy computer both branches may be ready.
            biased;
            done = within(INJECTION_LIMIT, work) => done,
            limit = self.silence() => Err(ExamineError::Silent { limit }),
        }
    }
}

impl LiveMaster {
    /// HTTP version and Python version of the master, as text.
    pub(super) fn speaks(&self) -> String {
        software::speaks(self.keeps_alive(), self.connection.server())
    }

    /// How rosrescue makes sure that calls reach this master, whose process id is `pid`.
    pub(super) async fn verification(&self, pid: i32) -> Verification {
        let (keeps_alive, sentinel) = (self.keeps_alive(), &self.sentinel);
        let sees_master =
            !keeps_alive && sentinel.is_local() && listens(pid, sentinel.peer()).await;
        Verification::choose(keeps_alive, sees_master, sentinel)
    }

    fn keeps_alive(&self) -> bool {
        self.connection.keeps_alive() != Some(false)
    }

    /// Makes the connection again if the master has closed it: after each answer, or because it was silent for as long as
    /// a rosmaster's `-t`. To plan the injection of a large state takes longer on a busy computer.
    async fn connected(&mut self) -> Result<(), ExamineError> {
        // While the sentinel is open, no other process can have accepted the new connection.
        if self.connection.reopen_if_closed().await? && !self.sentinel.is_open() {
            let ended = io::Error::other("the master has ended");
            return Err(CallError::NotConnected(ended).into());
        }
        Ok(())
    }
}

impl Contact for LiveMaster {
    async fn settle(&mut self) -> Result<(), ExamineError> {
        let master = self.sentinel.peer();
        let settled = async {
            self.reach.upstream.no_writers().await;
            while may_run_a_call(master).await {
                tokio::time::sleep(SETTLE_PAUSE).await;
            }
        };
        if tokio::time::timeout(SETTLE_LIMIT, settled).await.is_ok() {
            return Ok(());
        }
        match self.reach.supervision {
            // rosrescue replaces this master, as it replaces a master that hangs.
            Supervision::Ours => Err(ExamineError::Silent {
                limit: SETTLE_LIMIT,
            }),
            Supervision::Theirs => {
                rarely!(
                    warn,
                    "the master may still be running calls of closed connections after {SETTLE_LIMIT:?}; changes that these calls still make may be lost. Restart the master if this happens again"
                );
                Ok(())
            }
        }
    }

    async fn read_first(&mut self, token: &Token) -> Result<Inspection, ExamineError> {
        self.connected().await?;
        let look = inspect::read_first(&mut self.connection, token);
        self.reach.while_alive(look).await
    }

    async fn read_second(
        &mut self,
        first: Inspection,
        previous: &Master,
    ) -> Result<Master, ExamineError> {
        self.connected().await?;
        let look = inspect::read_second(first, &mut self.connection, previous);
        self.reach.while_alive(look).await
    }

    async fn call(&mut self, call: Request) -> Result<Reply, ExamineError> {
        self.connected().await?;
        let reply = self.connection.call(&call);
        self.reach.while_alive(reply).await
    }

    async fn inject(&mut self, plan: &Plan) -> Result<RawReply, ExamineError> {
        let (request, answer) = (plan.request().clone(), plan.answer());
        self.connected().await?;
        let reply = self.connection.call_expecting(request, answer);
        match self.catches_up {
            true => within(CATCH_UP_LIMIT, reply).await,
            false => self.reach.while_alive(reply).await,
        }
    }

    async fn wait_for_disk(&mut self, ledger: &Ledger, record: Mark) {
        ledger.durable(record).await;
    }

    async fn is_dead(&mut self, port: &str) -> bool {
        client::call(port, &master::get_pid(), ROSOUT_LIMIT).await == Reaction::Dead
    }

    async fn may_be_of_roscore(&mut self, pid: i32) -> bool {
        self.reach.supervision == Supervision::Theirs
            && may_be_of_roscore(pid, &self.sentinel).await
    }

    fn python(&self) -> Python {
        self.connection.python()
    }

    fn now(&self) -> Instant {
        Instant::now()
    }
}

/// Prepares the injection into an empty master, in a thread of its own.
pub(super) fn prepare(ledger: Arc<Ledger>) -> JoinHandle<Prepared> {
    crate::task::spawn_blocking(move || Prepared::in_advance(&ledger))
}

/// Runs [`sockets::may_run_a_call`] in another thread: it takes 100 ms with 15,000 sockets, where a sandbox allows only
/// the table in /proc.
async fn may_run_a_call(master: SocketAddr) -> bool {
    let looked = crate::task::spawn_blocking(move || sockets::may_run_a_call(master));
    looked.await.unwrap_or(false)
}

/// Whether the process `pid` seems to listen at the port of `master`.
async fn listens(pid: i32, master: SocketAddr) -> bool {
    let look = move || u32::try_from(pid).is_ok_and(|pid| listeners::listens(pid, master.port()));
    crate::task::spawn_blocking(look).await.unwrap_or(false)
}

/// Whether a roscore, or a roslaunch, may have started the master `pid`. A master whose process is hidden, in a
/// container or on another computer, may be a roscore's.
async fn may_be_of_roscore(pid: i32, sentinel: &Sentinel) -> bool {
    let (local, master) = (sentinel.is_local(), sentinel.peer());
    let look = move || {
        let pid = u32::try_from(pid).ok().filter(|_| local)?;
        let sockets = sockets::accepting(&sockets::listening(), master);
        let open = listeners::open_sockets(pid);
        let is_master = sockets.iter().any(|socket| open.contains(socket));
        let parent = process::parent_of(pid).filter(|_| is_master)?;
        Some(process::runs(parent, "roscore") || process::runs(parent, "roslaunch"))
    };
    let seen = crate::task::spawn_blocking(look).await;
    seen.ok().flatten().unwrap_or(true)
}

async fn within<T, E: Into<ExamineError>>(
    limit: Duration,
    work: impl Future<Output = Result<T, E>>,
) -> Result<T, ExamineError> {
    match tokio::time::timeout(limit, work).await {
        Ok(result) => result.map_err(Into::into),
        Err(_) => Err(ExamineError::Silent { limit }),
    }
}

#[cfg(test)]
mod tests {
    use rescue_core::lifecycle::Input;
    use ros1_master::xmlrpc::Value;
    use tokio::{
        io::{AsyncReadExt, AsyncWriteExt},
        net::TcpListener,
    };

    use super::*;
    use crate::ros_env::MasterUri;

    async fn seen_closed(master: &mut LiveMaster) {
        while !master.connection.is_closed() {
            tokio::task::yield_now().await;
        }
    }

    #[tokio::test]
    async fn a_connection_is_made_again_only_to_the_same_master() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let uri = MasterUri::parse(&format!("http://{address}")).unwrap();
        let timeout = Duration::from_secs(20);
        let reach = Reach {
            upstream: Arc::new(Upstream::new(uri, timeout, 3)),
            supervision: Supervision::Theirs,
            probing: Probing {
                interval: timeout,
                count: 1,
                start_limit: timeout,
            },
            probe_timeout: timeout,
            renewal: timeout,
        };
        let sentinel = Arc::new(reach.upstream.connect_sentinel().await.unwrap());
        let mut master = reach.to_examine(&sentinel).await.unwrap();
        let (watched, _) = listener.accept().await.unwrap();
        // Both masters close the connection before the call, and after their answer.
        for head in ["HTTP/1.1 200 OK", "HTTP/1.0 200 OK"] {
            let (closed, _) = listener.accept().await.unwrap();
            drop(closed);
            seen_closed(&mut master).await;
            let answer = async {
                let (mut stream, _) = listener.accept().await.unwrap();
                let mut request = Vec::new();
                while !request.ends_with(b"</methodCall>") {
                    stream.read_buf(&mut request).await.unwrap();
                }
                let body = ros1_master::xmlrpc::encode_reply(&Reply::Value(Value::Int(7)));
                let head = format!("{head}\r\nContent-Length: {}\r\n\r\n", body.len());
                stream.write_all(head.as_bytes()).await.unwrap();
                stream.write_all(&body).await.unwrap();
            };
            let both = async { tokio::join!(master.call(replay::has_run_id()), answer) };
            let (reply, ()) = tokio::time::timeout(timeout, both).await.unwrap();
            assert_eq!(reply.unwrap(), Reply::Value(Value::Int(7)), "{head}");
            seen_closed(&mut master).await;
            master.connection.reopen_if_closed().await.unwrap();
        }
        drop(watched);
        let (closed, _) = listener.accept().await.unwrap();
        drop(closed);
        seen_closed(&mut master).await;
        // On a busy computer the kernel may deliver the end of the sentinel later.
        while sentinel.is_open() {
            tokio::task::yield_now().await;
        }
        let error = master.call(replay::has_run_id()).await.unwrap_err();
        assert_eq!(error.as_input(), Input::ConnectionLost, "{error}");
    }
}
