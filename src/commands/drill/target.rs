//! Finds the processes that a drill kills, and verifies them.

use std::{collections::BTreeSet, path::Path};

use rustix::process::Signal;
use serde::Deserialize;

use super::calls::Api;
use crate::{
    cli::Victim,
    commands::{
        CommandFailure,
        running::{Running, is_here},
    },
    process::{self, listeners},
    ros_env::MasterUri,
    status::summary::Status,
};

/// The running rosrescue and its master.
#[derive(Clone, Debug)]
pub(super) struct Target {
    pub(super) running: Running,
    pub(super) api: Api,
}

impl Target {
    /// The processes to kill, each with its role; the master comes first.
    pub(super) async fn victims(
        &self,
        kill: Victim,
    ) -> Result<Vec<(&'static str, u32)>, CommandFailure> {
        let status = &self.running.status().await?;
        let mut victims = Vec::new();
        if kill != Victim::Worker {
            victims.push(("master", self.master(status).await?));
        }
        if kill != Victim::Master {
            victims.push(("worker", self.worker(status)?));
        }
        Ok(victims)
    }

    /// The master's process id, as `getPid` reports it. Fails unless that process listens at the address where
    /// rosrescue reaches the master.
    async fn master(&self, status: &Status) -> Result<u32, CommandFailure> {
        if status.elsewhere {
            return Err(CommandFailure::Usage(
                "another computer has the master: run the drill there (`rosrescue status` shows which \
                 one), or use --no-kill"
                    .to_owned(),
            ));
        }
        let address = MasterUri::parse(&status.master)
            .map_err(|error| CommandFailure::Failed(error.to_string()))?;
        if !is_here(&address).await {
            return Err(CommandFailure::Usage(format!(
                "the master at {} is not on this computer: run the drill there, or use --no-kill",
                status.master
            )));
        }
        let pid = self.master_pid().await.map_err(CommandFailure::Failed)?;
        let is_master = process::runs(pid, "rosmaster")
            || process::belongs_to(pid, Path::new(&status.checkpoint));
        if is_master && listeners::listens(pid, address.port) {
            return Ok(pid);
        }
        Err(CommandFailure::Usage(format!(
            "process {pid} calls itself the master at {}, but this computer's processes do not show \
             so: run the drill as the user of rosrescue, and not in another container",
            status.master
        )))
    }

    /// The nodes that rosrescue has unregistered because they had died, and that have not come back.
    pub(super) async fn died(&self) -> Result<BTreeSet<String>, String> {
        /// The part of `/state.json` that the drill needs.
        #[derive(Deserialize)]
        struct State {
            nodes: Vec<Row>,
        }
        #[derive(Deserialize)]
        struct Row {
            name: String,
            removed_at: Option<u64>,
        }
        let page = self.running.get("/state.json").await;
        let (_, json) = page.map_err(|error| error.to_string())?;
        let state: State = serde_json::from_slice(&json).map_err(|error| error.to_string())?;
        let died = state
            .nodes
            .into_iter()
            .filter(|row| row.removed_at.is_some());
        Ok(died.map(|row| row.name).collect())
    }

    pub(super) async fn master_pid(&self) -> Result<u32, String> {
        let pid = self.api.call("getPid", &[]).await?;
        let pid = pid.as_int().and_then(|pid| u32::try_from(pid).ok());
        pid.ok_or_else(|| "getPid gave no process id".to_owned())
    }

    /// The process id of rosrescue's worker, as the status reports it. Fails unless that process listens at rosrescue's
    /// port.
    fn worker(&self, status: &Status) -> Result<u32, CommandFailure> {
        if !status.guarded {
            return Err(CommandFailure::Usage(
                "rosrescue runs without a guardian: nothing would restart it (--no-guardian?)"
                    .to_owned(),
            ));
        }
        let port = self.running.address.port;
        match process::is_rosrescue(status.pid) && listeners::listens(status.pid, port) {
            true => Ok(status.pid),
            false => Err(CommandFailure::Usage(format!(
                "process {} calls itself rosrescue's worker, but it does not seem to listen at port \
                 {port}: run the drill as the user of rosrescue, and not in another container",
                status.pid
            ))),
        }
    }

    /// # Errors
    ///
    /// If this rosrescue runs on another computer.
    pub(super) async fn require_this_computer(&self) -> Result<(), CommandFailure> {
        let address = &self.running.address;
        if is_here(address).await {
            return Ok(());
        }
        Err(CommandFailure::Usage(format!(
            "the rosrescue at {address} is on another computer, where nothing can be killed from \
             here: run the drill there, or with --no-kill"
        )))
    }
}

/// A process that is stopped until this value is dropped.
#[derive(Debug)]
pub(super) struct Stopped(u32);

impl Stopped {
    pub(super) fn new(pid: u32) -> Self {
        process::signal_process(pid, Signal::STOP);
        Self(pid)
    }
}

impl Drop for Stopped {
    fn drop(&mut self) {
        process::signal_process(self.0, Signal::CONT);
    }
}
