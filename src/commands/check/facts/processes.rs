//! Processes of this computer that use a master.

use std::fs;

use crate::process::{self, listeners};

#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Process {
    pub(crate) pid: u32,
    /// The program's name.
    pub(crate) name: String,
    pub(crate) ports: Vec<u16>,
}

impl Process {
    pub(super) fn read(pid: u32) -> Self {
        Self {
            pid,
            name: process::name_of(pid),
            ports: listeners::ports(pid),
        }
    }
}

/// Masters in this network namespace that were not started by rosrescue.
pub(super) fn masters() -> Vec<Process> {
    process::all_pids()
        .filter(|pid| ["rosmaster", "roscore"].contains(&&*process::name_of(*pid)))
        .filter(|pid| process::is_in_our_network(*pid) && !process::belongs_to_any_rosrescue(*pid))
        .map(Process::read)
        .collect()
}

/// Listening processes in this network namespace that were started with another `ROS_MASTER_URI` than `own`. Only root
/// sees the processes of other users.
pub(super) fn strays(own: &str) -> Vec<(Process, String)> {
    const NAME: &[u8] = b"ROS_MASTER_URI=";
    let strays = process::all_pids().filter_map(|pid| {
        let environment = fs::read(format!("/proc/{pid}/environ")).ok()?;
        let mut variables = environment.split(|byte| *byte == 0);
        let uri = variables.find_map(|variable| variable.strip_prefix(NAME))?;
        let uri = String::from_utf8_lossy(uri).into_owned();
        let is_stray = !uri.is_empty() && uri.trim_end_matches('/') != own.trim_end_matches('/');
        if !is_stray || !process::is_in_our_network(pid) || process::belongs_to_any_rosrescue(pid) {
            return None;
        }
        let process = Process::read(pid);
        // Shells have the variable too, but they do not listen.
        (!process.ports.is_empty() && process.name != "rosrescue").then_some((process, uri))
    });
    strays.collect()
}
