//! What `install` and `uninstall` are going to do. Pure: from what is known to what has to be changed.

use std::{
    collections::BTreeMap,
    fmt,
    path::{Path, PathBuf},
};

use serde::Serialize;

use super::{
    found::{Found, Kind},
    manifest::{Disabled, Manifest, Present},
    place::Place,
};

/// One change of the computer.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "change", rename_all = "snake_case")]
pub(in crate::commands) enum Change {
    Write {
        path: PathBuf,
        /// Lines that come (`+`) and go (`-`); none for the program.
        lines: Vec<String>,
        #[serde(skip)]
        content: Vec<u8>,
        mode: u32,
    },
    Remove {
        path: PathBuf,
    },
    Run {
        command: Vec<String>,
        /// What it is for, if that is not plain.
        why: String,
    },
}

/// All of them, and what a person should know.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub(in crate::commands) struct Plan {
    pub(in crate::commands) changes: Vec<Change>,
    pub(in crate::commands) notes: Vec<String>,
    /// Why it cannot be done.
    pub(in crate::commands) obstacles: Vec<String>,
    /// What will be known of it.
    #[serde(skip)]
    pub(in crate::commands) manifest: Manifest,
}

/// A file that is to be there.
#[derive(Clone, Debug)]
pub(super) struct Wanted {
    pub(super) path: PathBuf,
    pub(super) content: Vec<u8>,
    pub(super) mode: u32,
}

/// What the plan is made of.
#[derive(Clone, Debug)]
pub(super) struct Facts<'a> {
    pub(super) place: &'a Place,
    pub(super) wanted: Vec<Wanted>,
    pub(super) present: BTreeMap<PathBuf, Present>,
    /// Of an earlier installation.
    pub(super) earlier: Option<Manifest>,
    pub(super) found: Vec<Found>,
    /// A systemd runs that can be asked to start units.
    pub(super) systemd_runs: bool,
    /// Our own units serve.
    pub(super) is_running: bool,
    pub(super) is_enabled: bool,
    pub(super) port: u16,
    pub(super) port_taken: bool,
    /// `proxy`, whose master is somebody else's.
    pub(super) proxy: bool,
}

/// Our units.
pub(super) const UNITS: [&str; 2] = ["rosrescue.socket", "rosrescue.service"];

pub(super) fn install(facts: &Facts<'_>, chosen: Manifest) -> Plan {
    let mut plan = Plan {
        manifest: chosen,
        ..Plan::default()
    };
    let earlier = facts.earlier.clone().unwrap_or_default();
    for wanted in &facts.wanted {
        let crc = crc32c::crc32c(&wanted.content);
        plan.manifest.files.insert(wanted.path.clone(), crc);
        match facts.present.get(&wanted.path) {
            Some(present) if present.crc == crc => {}
            Some(present) if earlier.files.get(&wanted.path) != Some(&present.crc) => {
                plan.obstacles.push(foreign(&wanted.path, &earlier));
            }
            present => plan.changes.push(Change::Write {
                path: wanted.path.clone(),
                lines: difference(present.and_then(|it| it.text.as_deref()), &wanted.content),
                content: wanted.content.clone(),
                mode: wanted.mode,
            }),
        }
    }
    for (path, crc) in &earlier.files {
        let is_left = !facts.wanted.iter().any(|wanted| wanted.path == *path);
        if is_left
            && facts
                .present
                .get(path)
                .is_some_and(|present| present.crc == *crc)
        {
            plan.changes.push(Change::Remove { path: path.clone() });
        }
    }
    let files_change = !plan.changes.is_empty();
    plan.manifest.disabled.clone_from(&earlier.disabled);
    let systemctl = |words: &[&str]| facts.place.systemctl(words);
    if files_change && facts.systemd_runs {
        plan.run(systemctl(&["daemon-reload"]), "");
    }
    let mut frees_port = false;
    for found in &facts.found {
        frees_port |= plan.meet(facts, found);
    }
    let now: &[&str] = if facts.systemd_runs { &["--now"] } else { &[] };
    if !(facts.is_enabled && (facts.is_running || !facts.systemd_runs)) {
        // A proxy's start ends when its master is there, which may be tomorrow.
        let block: &[&str] = if facts.proxy && facts.systemd_runs {
            &["--no-block"]
        } else {
            &[]
        };
        plan.run(systemctl(&[&["enable"], now, block, &UNITS].concat()), "");
        if facts.port_taken && facts.systemd_runs && !facts.is_running && !frees_port {
            plan.obstacles.push(format!(
                "port {} is in use: stop the robot and its roscore, and do this again",
                facts.port
            ));
        }
    } else if files_change && facts.is_running {
        plan.renew(facts, &earlier);
    }
    if !facts.systemd_runs {
        plan.notes
            .push("no systemd runs here: the service starts with the next boot".to_owned());
    }
    if facts.place.user && !facts.place.lingers {
        plan.notes.push(
            "the service runs while you are logged in. From the boot on, and after you have logged out, with: \
             `loginctl enable-linger`"
                .to_owned(),
        );
    }
    plan
}

impl Plan {
    fn run(&mut self, command: Vec<String>, why: &str) {
        let why = why.to_owned();
        self.changes.push(Change::Run { command, why });
    }

    /// Brings the new files to a service that runs.
    fn renew(&mut self, facts: &Facts<'_>, earlier: &Manifest) {
        let (before, after) = (&earlier.service, &self.manifest.service);
        let socket = facts.place.units.join(UNITS[0]);
        let is_socket_new = earlier.files.get(&socket) != self.manifest.files.get(&socket);
        if is_socket_new
            || before.first() != after.first()
            || earlier.run_as != self.manifest.run_as
        {
            self.run(facts.place.systemctl(&["stop", UNITS[0]]), "");
            let start = facts.place.systemctl(&[&["start"], &UNITS[..]].concat());
            self.run(start, "nodes that are alive keep their state");
        } else {
            self.run(
                facts
                    .place
                    .systemctl(&["kill", "--signal=KILL", "--kill-who=main", UNITS[1]]),
                "its successor takes the running master over; callers wait for some 0.2 s",
            );
        }
    }

    /// What to do with a unit of somebody else's. Says whether that frees the port.
    fn meet(&mut self, facts: &Facts<'_>, found: &Found) -> bool {
        let (unit, path) = (&found.unit, &found.path);
        if !found.enabled && !found.active {
            return false;
        }
        let manager = if found.of_user {
            "systemctl --user"
        } else {
            "systemctl"
        };
        match found.kind {
            Kind::Master if facts.proxy => self.obstacles.push(format!(
                "{unit} ({path}) starts a master at port {}, where nodes are to find rosrescue: give it another port, as \
                 in `rosmaster --core -p 11312`, and do this again",
                facts.port
            )),
            Kind::Master if found.of_user != facts.place.user => self.obstacles.push(format!(
                "{unit} ({path}) starts a master, and another systemd runs it: `{manager} disable --now {unit}`, as \
                 the user it belongs to, and do this again"
            )),
            Kind::Master => {
                let command = facts.place.systemctl(&["disable", "--now", unit]);
                let offline = facts.place.systemctl(&["disable", unit]);
                let command = if facts.systemd_runs { command } else { offline };
                self.run(command, "it starts a master, which rosrescue does now; uninstall switches it on again");
                self.manifest.disabled.retain(|it| it.unit != *unit);
                self.manifest.disabled.push(Disabled {
                    unit: unit.clone(),
                    was_enabled: found.enabled,
                    was_active: found.active,
                });
                return found.active;
            }
            Kind::Launch { waits } => {
                let order = if found.of_user == facts.place.user {
                    "starts after rosrescue now, and finds its master".to_owned()
                } else {
                    "belongs to another systemd, and may start before rosrescue".to_owned()
                };
                let advice = if waits {
                    "it waits for a master: nothing to do"
                } else {
                    "give roslaunch `--wait`, so that it never starts a master of its own (robot_upstart: `rosrun \
                     robot_upstart install --wait …` as before)"
                };
                self.notes.push(format!("{unit} ({path}) runs roslaunch: it {order}; {advice}"));
            }
        }
        false
    }
}

/// What is said of a file that is not ours.
fn foreign(path: &Path, earlier: &Manifest) -> String {
    let path_text = path.display();
    if earlier.files.contains_key(path) {
        format!(
            "{path_text} was changed since `rosrescue install` wrote it: put the change into a drop-in (`systemctl edit`) \
             and remove the file, and do this again"
        )
    } else {
        format!(
            "{path_text} was not written by `rosrescue install`: move it away, and do this again"
        )
    }
}

/// Takes back what `earlier` says.
pub(in crate::commands) fn uninstall(
    place: &Place,
    earlier: &Manifest,
    present: &BTreeMap<PathBuf, Present>,
    systemd_runs: bool,
) -> Plan {
    let mut plan = Plan::default();
    let now: &[&str] = if systemd_runs { &["--now"] } else { &[] };
    let systemctl = |words: &[&[&str]]| place.systemctl(&words.concat());
    plan.run(systemctl(&[&["disable"], now, &UNITS]), "");
    for (path, crc) in &earlier.files {
        match present.get(path) {
            None => {}
            Some(present) if present.crc == *crc => {
                plan.changes.push(Change::Remove { path: path.clone() });
            }
            Some(_) => plan.notes.push(format!(
                "{} stays: it was changed since `rosrescue install` wrote it. Remove it yourself",
                path.display()
            )),
        }
    }
    if systemd_runs {
        plan.run(place.systemctl(&["daemon-reload"]), "");
    }
    for Disabled {
        unit,
        was_enabled,
        was_active,
    } in &earlier.disabled
    {
        let start: &[&str] = if *was_active && systemd_runs {
            &["--now"]
        } else {
            &[]
        };
        match (was_enabled, start) {
            (true, _) => plan.run(
                systemctl(&[&["enable"], start, &[unit]]),
                "as it was before",
            ),
            (false, ["--now"]) => plan.run(place.systemctl(&["start", unit]), "as it was before"),
            (false, _) => {}
        }
    }
    plan.changes.push(Change::Remove {
        path: place.manifest.clone(),
    });
    plan
}

/// The lines that go and those that come, without where.
fn difference(before: Option<&str>, content: &[u8]) -> Vec<String> {
    let Ok(after) = std::str::from_utf8(content) else {
        return Vec::new();
    };
    let before = before.unwrap_or_default();
    let lacks = |text: &str, line: &str| !text.lines().any(|it| it == line);
    let gone = before
        .lines()
        .filter(|line| lacks(after, line))
        .map(|line| format!("- {line}"));
    let come = after
        .lines()
        .filter(|line| lacks(before, line))
        .map(|line| format!("+ {line}"));
    gone.chain(come).collect()
}

impl fmt::Display for Plan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.changes.is_empty() {
            writeln!(f, "nothing to change")?;
        }
        for change in &self.changes {
            match change {
                Change::Write {
                    path,
                    lines,
                    content,
                    ..
                } => {
                    let size = content.len().div_ceil(1 << 20);
                    let what = if lines.is_empty() {
                        format!(" (this program, {size} MiB)")
                    } else {
                        String::new()
                    };
                    writeln!(f, "write   {}{what}", path.display())?;
                    for line in lines {
                        writeln!(f, "        {line}")?;
                    }
                }
                Change::Remove { path } => writeln!(f, "remove  {}", path.display())?,
                Change::Run { command, why } => {
                    let why = if why.is_empty() {
                        String::new()
                    } else {
                        format!("   # {why}")
                    };
                    writeln!(f, "run     {}{why}", command.join(" "))?;
                }
            }
        }
        for note in &self.notes {
            writeln!(f, "note    {note}")?;
        }
        for obstacle in &self.obstacles {
            writeln!(f, "but     {obstacle}")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
