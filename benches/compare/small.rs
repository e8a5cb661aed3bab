//! Simulates a small computer: one core and a quarter of its time, by the kernel's bandwidth control for
//! cgroups.

use std::{
    fs,
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

use crate::shared::cpu::Cpu;

/// The share of the core's time.
const SHARE: f64 = 0.25;
/// The period in which the group gets its share, in microseconds. The default of 100 ms would cause pauses of
/// 75 ms, which no slow processor has.
const PERIOD: u32 = 10_000;
/// For how long the real share is measured.
const SPIN: Duration = Duration::from_secs(1);

/// This process and everything that it starts, in a cgroup with a quota on one core. When this is dropped,
/// the process leaves the group; all other processes in it must have ended.
#[derive(Debug)]
pub(crate) struct SmallComputer {
    group: PathBuf,
    outside: PathBuf,
    cores: CpuSet,
}

impl SmallComputer {
    /// Enters a group. The error says why that is impossible: no version of cgroups is writable.
    pub(crate) fn enter() -> Result<Self, String> {
        let (parent, own, version) = mount()?;
        let group = parent.join(format!("rosrescue-compare-{}", std::process::id()));
        let cores = sched_getaffinity(None).map_err(|error| error.to_string())?;
        let write = |path: PathBuf, text: &str| {
            fs::write(&path, text).map_err(|error| format!("{}: {error}", path.display()))
        };
        fs::create_dir(&group).map_err(|error| format!("{}: {error}", group.display()))?;
        let computer = Self {
            outside: own.join("cgroup.procs"),
            group: group.clone(),
            cores,
        };
        let quota = f64::from(PERIOD) * SHARE;
        if version == 2 {
            write(group.join("cpu.max"), &format!("{quota} {PERIOD}"))?;
        } else {
            write(group.join("cpu.cfs_period_us"), &PERIOD.to_string())?;
            write(group.join("cpu.cfs_quota_us"), &quota.to_string())?;
        }
        write(group.join("cgroup.procs"), &std::process::id().to_string())?;
        let mut one = CpuSet::new();
        let first = (0..CpuSet::MAX_CPU).find(|core| cores.is_set(*core));
        one.set(first.unwrap_or_default());
        sched_setaffinity(None, &one).map_err(|error| error.to_string())?;
        Ok(computer)
    }

    /// The share of the core's time that a busy process really gets.
    pub(crate) fn share(&self) -> f64 {
        let pids = [std::process::id()];
        let (begin, before) = (Instant::now(), Cpu::read(&pids));
        while begin.elapsed() < SPIN {
            std::hint::spin_loop();
        }
        let used = Cpu::read(&pids).since(&before);
        used.as_secs_f64() / begin.elapsed().as_secs_f64()
    }
}

impl Drop for SmallComputer {
    fn drop(&mut self) {
        let _ = fs::write(&self.outside, std::process::id().to_string());
        let _ = sched_setaffinity(None, &self.cores);
        let _ = fs::remove_dir(&self.group);
    }
}

/// Where a group can be created in the hierarchy that controls processor time, the present group of this
/// process, and the version of cgroups.
fn mount() -> Result<(PathBuf, PathBuf, u8), String> {
    let read = |path: &str| fs::read_to_string(path).map_err(|error| format!("{path}: {error}"));
    let (mounts, groups) = (read("/proc/self/mounts")?, read("/proc/self/cgroup")?);
    for line in mounts.lines() {
        let words: Vec<_> = line.split(' ').collect();
        let [_, place, kind, options, ..] = words.as_slice() else {
            continue;
        };
        let own = |controller: &str| {
            groups.lines().find_map(|line| {
                let mut fields = line.splitn(3, ':').skip(1);
                let names = fields.next()?.split(',').any(|name| name == controller);
                fields.next().filter(|_| names).map(str::to_owned)
            })
        };
        let place = Path::new(place);
        let below = |own: Option<String>| {
            let own = own.unwrap_or_default();
            place.join(own.trim_start_matches('/'))
        };
        let has_cpu = |controls: &str, separator| controls.split(separator).any(|it| it == "cpu");
        if *kind == "cgroup" && has_cpu(options, ',') {
            let own = below(own("cpu"));
            return Ok((own.clone(), own, 1));
        }
        let controls = place.join("cgroup.subtree_control");
        let controls = fs::read_to_string(controls).unwrap_or_default();
        if *kind == "cgroup2" && has_cpu(controls.trim(), ' ') {
            // A group that contains processes cannot have groups below it, except for the root.
            return Ok((place.to_owned(), below(own("")), 2));
        }
    }
    Err("no cgroup hierarchy here controls processor time".to_owned())
}
