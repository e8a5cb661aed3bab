//! The earliest sign that a process is being ended: the end of one of its threads.
//!
//! A signal that ends a process ends each of its threads on its own, and only the last one of them
//! gives back the memory and then closes the descriptors, one by one. A master with 80 nodes has some
//! 100 of each: its connections tell of its death after 4 to 12 ms, most of its threads after 1 to 4.

use std::{fs, future::poll_fn, io, task::Poll};

use rustix::{fs::OFlags, process::PidfdFlags};
use tokio::net::unix::pipe::Receiver;

use crate::process::pidfd;

/// So many threads are watched: one of them may be the last. A rosmaster with `-w 1` has no more that
/// live as long as it does, one that calls nodes and one that serves.
const WATCHED: usize = 2;
/// The descriptor is to tell of the end of a thread, not of a process. Linux 6.9 or later.
const PIDFD_THREAD: PidfdFlags = PidfdFlags::from_bits_retain(OFlags::EXCL.bits());

/// Resolves when one of the oldest threads of the process `pid` has ended, other than the first:
/// Linux tells of that one's end only with that of the whole process. In rosmaster the oldest ones
/// live as long as the master does.
///
/// # Errors
///
/// What the system says: the process is gone, or the kernel cannot watch threads.
pub(super) fn of(pid: i32) -> io::Result<impl Future<Output = ()> + Send + use<>> {
    // In the order in which they were started.
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

    /// Starts threads, says so, and ends one of them, or itself, at a line on its standard input.
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

    /// Whether this kernel can do it: Linux 6.9 or later.
    fn is_possible() -> bool {
        let name = rustix::system::uname();
        let mut numbers = name.release().to_str().unwrap().split(['.', '-']);
        let mut next = || numbers.next().unwrap().parse::<u32>().unwrap();
        (next(), next()) >= (6, 9)
    }

    #[tokio::test]
    async fn the_end_of_a_thread_is_told() {
        if !is_possible() {
            assert!(of(std::process::id().try_into().unwrap()).is_err());
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
            let mut end = Box::pin(of(child.id().try_into().unwrap()).unwrap());
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
        assert!(of(i32::MAX).is_err());
    }
}
