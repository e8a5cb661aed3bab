//! Judges whether rosrescue can listen at its port.

use super::{
    super::{
        facts::{Port, Process, SetupFacts},
        ros::Responder,
        units::{Unit, UnitKind},
    },
    Findings, named,
};

impl Findings {
    pub(super) fn port(&mut self, facts: &SetupFacts) {
        let Ok(Port {
            number,
            error,
            taken,
        }) = &facts.port
        else {
            // The finding about ROS_MASTER_URI reports this error.
            return;
        };
        if let Some(error) = error {
            let todo = "run `rosrescue core -p 11411`, and `export ROS_MASTER_URI=http://localhost:11411` where nodes \
                        start";
            return self.bad("port", format!("cannot listen at {number}: {error}"), todo);
        }
        let Some(taken) = taken else {
            return self.ok("port", format!("{number} is free"));
        };
        let by = match taken.by.as_slice() {
            [] => "a process that only root can see".to_owned(),
            all => all.iter().map(named).collect::<Vec<_>>().join(", "),
        };
        match &taken.server {
            Responder::Rosrescue { version, .. } => {
                self.ok(
                    "port",
                    format!("{number}: rosrescue {version} runs here: {by}"),
                );
                if version != facts.version {
                    let own = facts.version;
                    let restart = match pids(&taken.by) {
                        Ok(pids) => format!("when the robot is at rest, `kill {pids}`, and start it again"),
                        Err(hint) => hint.to_owned(),
                    };
                    let is_users =
                        |unit: &Unit| unit.kind == UnitKind::Rosrescue && unit.is_users;
                    let systemctl = match facts.units.iter().any(is_users) {
                        true => "systemctl --user",
                        false => "sudo systemctl",
                    };
                    self.note(
                        "port",
                        format!("the running rosrescue is {version}, this program is {own}"),
                        format!(
                            "a service: `{systemctl} kill --signal=KILL --kill-who=main rosrescue.service`. \
                             Otherwise {restart}"
                        ),
                    );
                }
            }
            Responder::Master(pid) => {
                let stop = match pid {
                    Some(pid) => format!("stop it: `kill {pid}`"),
                    None => stop(&taken.by),
                };
                self.bad(
                    "port",
                    format!("{number} is in use by a master without rosrescue: {by}"),
                    format!(
                        "{stop}, or Ctrl-C where roscore or roslaunch runs. To keep it, start it with `rosmaster \
                         --core -p 11312`, and `rosrescue proxy --master http://localhost:11312`"
                    ),
                );
            }
            Responder::Silent => self.bad(
                "port",
                format!("{number} is in use by a program that does not answer: {by}"),
                match pids(&taken.by) {
                    Ok(pids) => format!(
                        "`kill -CONT {pids}` continues it if it is stopped. If that does not help, `kill -KILL \
                         {pids}`, and start it again"
                    ),
                    Err(hint) => hint.to_owned(),
                },
            ),
            _ => self.bad(
                "port",
                format!("{number} is in use by a program that is not a master: {by}"),
                format!(
                    "{}, or run `rosrescue core -p 11411`, and `export ROS_MASTER_URI=http://localhost:11411` where \
                     nodes start",
                    stop(&taken.by)
                ),
            ),
        }
    }
}

/// How to stop the processes that have a port.
fn stop(processes: &[Process]) -> String {
    match pids(processes) {
        Ok(pids) => format!("stop it: `kill {pids}`"),
        Err(hint) => hint.to_owned(),
    }
}

/// The ids of the processes that have a port, as arguments of `kill`, or else how to find out what has it. systemd, which
/// also holds the port of a socket unit, is left out.
fn pids(processes: &[Process]) -> Result<String, &'static str> {
    let others = processes.iter().filter(|it| it.name != "systemd");
    let pids: Vec<_> = others.map(|it| it.pid.to_string()).collect();
    match pids.is_empty() {
        false => Ok(pids.join(" ")),
        true if processes.is_empty() => Err("`sudo rosrescue check` names the process"),
        true => Err(
            "`systemctl list-sockets` names the socket unit and its service. If that is rosrescue, `journalctl -u \
             rosrescue` shows why it does not start. Otherwise stop the socket unit",
        ),
    }
}
