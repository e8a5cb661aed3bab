//! Judges the installed ROS, and what else starts a master.

use super::{
    super::{
        facts::SetupFacts,
        launch::Launches,
        ros::Responder,
        units::{ADD_WAIT, REMOVE_ROSCORE, UnitKind},
    },
    Findings, named,
};
use crate::status::software;

/// Maximum number of settings in launch files that are listed. More would hide the other findings.
const SETTINGS_MOST: usize = 10;

impl Findings {
    pub(super) fn ros(&mut self, facts: &SetupFacts) {
        match &facts.rosmaster {
            None => {}
            Some(Err(why)) => self.bad(
                "rosmaster",
                why.clone(),
                "`sudo apt-get install python3-rosmaster` on Debian, `sudo apt-get install ros-noetic-rosmaster` with \
                 the packages of ros.org",
            ),
            Some(Ok(program)) => {
                let path = program.path.display();
                let version = program.version.as_deref().unwrap_or("of unknown version");
                match &program.broken {
                    Some(why) => self.bad(
                        "rosmaster",
                        format!("{path} fails with {}: {why}", program.interpreter),
                        "`conda deactivate` (or `deactivate` in a venv), then `source /opt/ros/*/setup.bash`",
                    ),
                    None => {
                        let http = software::keeps_alive(version, &facts.kernel);
                        let http = http.map(|keeps| software::speaks(keeps, None));
                        let speaks = http.map(|http| format!(", {http}")).unwrap_or_default();
                        self.ok("rosmaster", format!("{path}, {version}{speaks}"));
                    }
                }
                if !facts.has_rosout {
                    let todo = "`sudo apt-get install rosout` on Debian, `sudo apt-get install ros-noetic-rosout` with \
                                the packages of ros.org, or --no-rosout";
                    self.warn("rosout", "is not installed: nothing collects /rosout", todo);
                }
            }
        }
        if let Some(python) = &facts.strange_python {
            self.warn(
                "python",
                format!("{} comes first on the PATH and has no ROS", python.display()),
                "nodes that begin with #!/usr/bin/env python3 fail: `conda deactivate`, or `export PATH=/usr/bin:$PATH`",
            );
        }
        let Some((uri, server)) = &facts.proxied else {
            return;
        };
        match server {
            Responder::Master(_) => {
                let speaks = facts.proxied_speaks.as_deref();
                let speaks = speaks
                    .map(|speaks| format!(": {speaks}"))
                    .unwrap_or_default();
                self.ok("master", format!("{uri} answers{speaks}"));
            }
            Responder::Rosrescue { proxied, .. } => {
                let todo = match proxied {
                    Some(real) => format!("`rosrescue check --master {real}`"),
                    None => "it has a master of its own: `rosrescue check` without --master".to_owned(),
                };
                self.bad("master", format!("--master {uri} is a rosrescue"), todo);
            }
            Responder::Other => {
                let todo = "give the address of the real rosmaster: `ss -ltnp | grep rosmaster` shows its port";
                self.bad(
                    "master",
                    format!("what answers at {uri} is not a ROS master"),
                    todo,
                );
            }
            Responder::Nobody | Responder::Silent => self.warn(
                "master",
                format!("no answer from {uri}"),
                format!(
                    "at its first start, proxy lets calls wait for a master: `rosmaster --core -p {}`",
                    uri.port
                ),
            ),
        }
    }

    /// Reports masters beside rosrescue.
    pub(super) fn masters(&mut self, facts: &SetupFacts) {
        let port = facts.port.as_ref().ok().map(|port| port.number);
        let proxied = facts.proxied.as_ref().map(|(uri, _)| uri.port);
        let others = facts.masters.iter().filter(|process| {
            let at = |port: Option<u16>| port.is_some_and(|port| process.ports.contains(&port));
            // The finding about the port reports a master at `port`. A master at `proxied` is intended.
            !at(port) && !at(proxied)
        });
        let others: Vec<_> = others.collect();
        let pids: Vec<_> = others
            .iter()
            .map(|process| process.pid.to_string())
            .collect();
        let others: Vec<_> = others.into_iter().map(named).collect();
        if !others.is_empty() {
            self.warn(
                "masters",
                format!("other masters run on this computer: {}", others.join(", ")),
                format!(
                    "their nodes do not see the nodes of rosrescue. Stop those you do not need: `kill {}`",
                    pids.join(" ")
                ),
            );
        }
    }

    pub(super) fn systemd(&mut self, facts: &SetupFacts) {
        let mut own = 0;
        // A proxy's master is intended, and one at another port is a different robot's.
        let is_rival = |port| {
            let own = facts.port.as_ref().map(|own| own.number);
            facts.proxied.is_none() && own.is_ok_and(|own| own == port)
        };
        for unit in &facts.units {
            let name = &unit.name;
            let systemctl = match unit.is_users {
                true => "systemctl --user",
                false => "sudo systemctl",
            };
            match (unit.kind, unit.is_enabled) {
                (UnitKind::Rosrescue, true) => {
                    own += 1;
                    self.ok("systemd", format!("{name} starts at boot"));
                }
                (UnitKind::Rosrescue, false) => {
                    let todo = format!("`{systemctl} enable {name}`");
                    self.note("systemd", format!("{name} does not start at boot"), todo);
                }
                (UnitKind::Roscore(port), true) if is_rival(port) => {
                    let todo = format!("`{systemctl} disable --now {name}`");
                    let what = format!("{name} starts another master at boot");
                    self.bad("systemd", what, todo);
                }
                (UnitKind::RoscoreAndNodes(port), true) if is_rival(port) => {
                    let todo = format!("{REMOVE_ROSCORE}: `{systemctl} edit --full {name}`");
                    let what = format!("{name} starts another master at boot, and nodes");
                    self.bad("systemd", what, todo);
                }
                (UnitKind::Roslaunch, true) => self.warn(
                    "systemd",
                    format!("{name} runs roslaunch, which starts a master if it finds none"),
                    format!(
                        "{ADD_WAIT}, and After=rosrescue.service: `{systemctl} edit --full {name}`"
                    ),
                ),
                _ => {}
            }
        }
        if own == 0
            && facts
                .units
                .iter()
                .all(|unit| unit.kind != UnitKind::Rosrescue)
        {
            let todo = "`sudo rosrescue install` adds one that starts at boot";
            self.note("systemd", "there is no rosrescue service", todo);
        }
    }

    /// Reports launch files that send nodes to another master.
    pub(super) fn launches(&mut self, launches: &Launches) {
        const SUBJECT: &str = "launch files";
        let count = launches.settings.len();
        for one in launches.settings.iter().take(SETTINGS_MOST) {
            self.warn(
                SUBJECT,
                format!("{}:{} sets ROS_MASTER_URI to {}", one.file.display(), one.line, one.uri),
                format!(
                    "its nodes use that master, not rosrescue. If they belong to this robot, remove the <env>: `nano \
                     +{} {}`",
                    one.line,
                    one.file.display()
                ),
            );
        }
        if count > SETTINGS_MOST {
            let what = format!("{} more set ROS_MASTER_URI", count - SETTINGS_MOST);
            self.warn(
                SUBJECT,
                what,
                "fix the first ones, then run `rosrescue check` again",
            );
        }
        let files = launches.files;
        if launches.is_cut {
            let todo = "`ROS_PACKAGE_PATH=$HOME/catkin_ws/src rosrescue check` reads only the robot's own packages";
            self.note(SUBJECT, format!("read {files}, and there are more"), todo);
        } else if count == 0 && files > 0 {
            self.ok(
                SUBJECT,
                format!("read {files}; none sets another ROS_MASTER_URI"),
            );
        }
    }
}
