//! Watches for the earliest sign that a process is dying: the end of one of its threads.
//!
//! A signal that ends a process ends each thread separately. Only the last thread frees the memory and then closes the
//! descriptors, one by one. A master with 80 nodes has some 100 threads and some 100 descriptors. After its death, most
//! of its threads end within 1 to 4 ms, and its connections within 4 to 12 ms.

use std::{fs, future::poll_fn, io, task::Poll};

use rustix::{fs::OFlags, process::PidfdFlags};
use tokio::net::unix::pipe::Receiver;

use crate::process::pidfd;

/// Number of threads to watch. One is not enough, because it may end last. In a rosmaster with `-w 1`, only two threads
/// live as long as the process: one calls nodes, one serves.
const WATCHED: usize = 2;
/// Flag that makes the descriptor report the end of a thread instead of a process. Needs Linux 6.9
/// or later.
const PIDFD_THREAD: PidfdFlags = PidfdFlags::from_bits_retain(OFlags::EXCL.bits());

/// Completes when one of the oldest threads of the process `pid` has ended. In rosmaster the oldest threads live as
/// long as the process. The first thread is not watched, because Linux reports its end only with that of the process.
///
/// # Errors
///
/// If the process is gone, or if the kernel cannot watch threads.
pub(super) fn watch(pid: i32) -> io::Result<impl Future<Output = ()> + Send + use<>> {
    // Threads are listed in the order in which they were started.
    let threads = fs::read_dir(format!("/proc/{pid}/task"))?;
    let others = threads.skip(1).take(WATCHED).map(|entry| {
        let name = entry?.file_name();
        let thread = name.to_str().and_then(|name| name.parse().ok());
        pidfd::open(thread.ok_or(io::ErrorKind::InvalidData)?, PIDFD_THREAD)
    });
    let watched = others.collect::<io::Result<Vec<Receiver>>>()?;
    Ok(poll_fn(move |context| {
        let mut ended = |thread: &Receiver| thread.poll_read_ready(context).is_ready();
        match watched.iter().any(&mut ended) {
            true => Poll::Ready(()),
            false => Poll::Pending,
        }
    }))
}

#[cfg(test)]
mod tests {
    use std::{
        process::{Command, Stdio},
        time::Duration,
    };

    use super::*;

    /// A program that starts threads and says so. When it reads a line, it ends one of its threads or itself.
    const PROGRAM: &str = "
import sys, threading, time
end = threading.Event()
threading.Thread(target=end.wait).start()
threading.Thread(target=time.sleep, args=(3600,), daemon=True).start()
print(flush=True)
sys.stdin.readline()
end.set()
time.sleep(3600)
";

    /// Whether this kernel can watch threads: Linux 6.9 or later.
    fn is_possible() -> bool {
        let name = rustix::system::uname();
        let mut numbers = name.release().to_str().unwrap().split(['.', '-']);
        let mut next = || numbers.next().unwrap().parse::<u32>().unwrap();
        (next(), next()) >= (6, 9)
    }

    #[tokio::test]
    async fn the_end_of_a_thread_is_reported() {
        if !is_possible() {
            assert!(watch(std::process::id().try_into().unwrap()).is_err());
            return;
        }
        for kill in [false, true] {
            let mut child = Command::new("/usr/bin/python3")
                .args(["-c", PROGRAM])
                .stdin(Stdio::piped())
                .stdout(Stdio::piped())
                .spawn()
                .unwrap();
            io::Read::read_exact(child.stdout.as_mut().unwrap(), &mut [0]).unwrap();
            let mut end = Box::pin(watch(child.id().try_into().unwrap()).unwrap());
            let early = tokio::time::timeout(Duration::from_millis(50), &mut end).await;
            assert!(early.is_err(), "nothing has ended");
            if kill {
                child.kill().unwrap();
            } else {
                io::Write::write_all(child.stdin.as_mut().unwrap(), b"\n").unwrap();
            }
            tokio::time::timeout(Duration::from_secs(60), end)
                .await
                .unwrap();
            child.kill().unwrap();
            child.wait().unwrap();
        }
    }

    #[tokio::test]
    async fn a_process_that_is_gone_is_not_watched() {
        assert!(watch(i32::MAX).is_err());
    }
}
