//! What this process uses of the computer, as the metrics that all of Prometheus' client libraries have.

use std::fs;

use rustix::process::{Resource, getrlimit};

use super::Stat;
use crate::status::metrics::ProcessMetric;

/// The metrics of this process, which was `started` at this time in seconds since 1970. Those that the kernel does not
/// tell are left out.
pub(crate) fn usage(started: f64) -> Vec<ProcessMetric> {
    let stat = Stat::read(std::process::id());
    let memory = stat.map(Stat::memory);
    let open = fs::read_dir("/proc/self/fd").map(|open| open.count() as f64);
    let most = getrlimit(Resource::Nofile).current;
    #[rustfmt::skip]
    let values = [
        ("process_cpu_seconds_total", "processor time of this process, in seconds", stat.map(Stat::cpu_seconds)),
        ("process_resident_memory_bytes", "memory of this process, in bytes", memory.map(|(_, resident)| resident as f64)),
        ("process_virtual_memory_bytes", "virtual memory of this process, in bytes", memory.map(|(all, _)| all as f64)),
        ("process_threads", "threads of this process", stat.map(|stat| stat.threads as f64)),
        ("process_open_fds", "open file descriptors", open.ok()),
        ("process_max_fds", "limit of open file descriptors", most.map(|most| most as f64)),
        ("process_start_time_seconds", "when this process was started, in seconds since 1970", Some(started)),
    ];
    let known = values.into_iter();
    known
        .filter_map(|(name, help, value)| Some((name, help, value?)))
        .collect()
}
