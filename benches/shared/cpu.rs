//! Processor time and memory of processes, from `/proc`.

use std::{collections::HashMap, fs, path::Path, time::Duration};

/// A process and those of its descendants that run the same program, such as guardian and worker of
/// rosrescue, or master and worker of nginx.
pub(crate) fn family(root: u32) -> Vec<u32> {
    let name = |pid: u32| fs::read_to_string(format!("/proc/{pid}/comm")).unwrap_or_default();
    let mut family = vec![root];
    let mut next = 0;
    while let Some(&pid) = family.get(next) {
        next += 1;
        for task in entries(&format!("/proc/{pid}/task")) {
            let children = format!("/proc/{pid}/task/{task}/children");
            let children = fs::read_to_string(children).unwrap_or_default();
            let children = children.split_whitespace().flat_map(str::parse);
            family.extend(children.filter(|child| name(*child) == name(root)));
        }
    }
    family
}

/// Resident memory of these processes in KiB.
pub(crate) fn resident_kib(pids: &[u32]) -> u64 {
    pids.iter().filter_map(|pid| kib(*pid, "VmRSS:")).sum()
}

/// Maximum resident memory of a process so far, in KiB.
pub(crate) fn peak_kib(pid: u32) -> u64 {
    kib(pid, "VmHWM:").unwrap_or_default()
}

fn kib(pid: u32, name: &str) -> Option<u64> {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let line = status.lines().find(|line| line.starts_with(name))?;
    line.split_whitespace().nth(1)?.parse().ok()
}

/// Processor time of each thread so far, user and system, in nanoseconds. `utime` and `stime` would count
/// hundredths of a second, which is too coarse for work of a few microseconds.
#[derive(Debug)]
pub(crate) struct Cpu(HashMap<(u32, u32), u64>);

impl Cpu {
    pub(crate) fn read(pids: &[u32]) -> Self {
        let mut times = HashMap::new();
        for &pid in pids {
            let tasks = format!("/proc/{pid}/task");
            for thread in entries(&tasks) {
                let path = Path::new(&tasks).join(thread.to_string());
                let text = fs::read_to_string(path.join("schedstat")).unwrap_or_default();
                let time = text.split_whitespace().next();
                // A thread may end in the meantime.
                if let Some(Ok(time)) = time.map(str::parse) {
                    times.insert((pid, thread), time);
                }
            }
        }
        Self(times)
    }

    /// Processor time used between `before` and this reading. A thread that has ended in between is not
    /// counted.
    pub(crate) fn since(&self, before: &Self) -> Duration {
        let used = self.0.iter().map(|(thread, now)| {
            let then = before.0.get(thread).copied().unwrap_or_default();
            now.saturating_sub(then)
        });
        Duration::from_nanos(used.sum())
    }
}

/// The numeric names in a folder of `/proc`.
fn entries(folder: &str) -> Vec<u32> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let names = entries.map(|entry| entry.file_name());
    names
        .filter_map(|name| name.to_str()?.parse().ok())
        .collect()
}
