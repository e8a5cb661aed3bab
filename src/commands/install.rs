//! `rosrescue install` runs rosrescue as a systemd service, and `rosrescue uninstall` undoes that.
//!
//! The units are static: the Debian package has them, and `install` writes them where the package is missing. What
//! differs from robot to robot is in a drop-in for each unit.

mod caller;
mod service;
mod system_changes;
mod unit_paths;
mod units;

use std::{
    collections::BTreeMap,
    fs, io,
    net::{SocketAddr, TcpListener},
    path::{Path, PathBuf},
    time::Duration,
};

use self::{
    caller::{account, caller_environment, home, named_user},
    service::{Service, read_service},
    system_changes::{Change, SystemChanges, carry_out},
    unit_paths::{UNITS, UnitPaths},
    units::{InstalledService, MARK, UnitSettings},
};
use super::{
    CommandFailure, Exit,
    check::units::{self as others, ADD_WAIT, REMOVE_ROSCORE, UnitKind},
};
use crate::{
    cli::{InstallArgs, ScopeArgs, UninstallArgs},
    process, resolver,
    ros_env::MasterUri,
};

/// Longest time for the lookup of the host in `ROS_MASTER_URI`.
const LOOKUP: Duration = Duration::from_secs(6);
/// ROS's variables that concern the master.
const SETTINGS: [&str; 6] = [
    "ROS_MASTER_URI",
    "ROS_IP",
    "ROS_HOSTNAME",
    "ROS_IPV6",
    "ROS_HOME",
    "ROS_LOG_DIR",
];
/// Further variables that a ROS in an unusual place needs. Its `setup.bash` sets them.
const PATHS: [&str; 4] = ["PATH", "PYTHONPATH", "LD_LIBRARY_PATH", "ROS_PACKAGE_PATH"];

pub(super) async fn run(args: &InstallArgs) -> Result<Exit, CommandFailure> {
    let paths = UnitPaths::new(&args.scope)?;
    let program = std::env::current_exe().map_err(|error| {
        CommandFailure::Failed(format!("cannot find this program's file: {error}"))
    })?;
    let with_root = as_system_program(&program).unwrap_or_else(again_with_sudo);
    needs_root(&paths, &args.scope, &with_root)?;
    carry_out(&install(args, &paths, &program).await?, &args.scope)
}

pub(super) async fn undo(args: &UninstallArgs) -> Result<Exit, CommandFailure> {
    let paths = UnitPaths::new(&args.scope)?;
    needs_root(&paths, &args.scope, &again_with_sudo())?;
    carry_out(&uninstall(&paths), &args.scope)
}

/// Refuses a service of the computer without root, before any other obstacle is reported. `with_root` is what to run
/// instead.
fn needs_root(paths: &UnitPaths, args: &ScopeArgs, with_root: &str) -> Result<(), CommandFailure> {
    if paths.user || args.dry_run || rustix::process::geteuid().is_root() {
        return Ok(());
    }
    Err(CommandFailure::Usage(format!(
        "a service of this computer needs root: run {with_root}, or use --user for a service of your own"
    )))
}

/// The command that runs this command line as root.
fn again_with_sudo() -> String {
    let words: Vec<_> = std::env::args().skip(1).collect();
    format!("`sudo rosrescue {}`", words.join(" "))
}

async fn install(
    args: &InstallArgs,
    paths: &UnitPaths,
    program: &Path,
) -> Result<SystemChanges, CommandFailure> {
    let caller = caller_environment();
    let core = vec!["core".to_owned()];
    let command = if args.service.is_empty() {
        &core
    } else {
        &args.service
    };
    let given = |names: &[&str]| {
        let pairs = names
            .iter()
            .map(|&name| (name.to_owned(), caller.get(name).cloned()));
        let pairs = pairs
            .filter_map(|(name, value)| Some((name, value.filter(|value| !value.is_empty())?)));
        pairs.collect::<Vec<_>>()
    };
    let mut settings: BTreeMap<_, _> = given(&SETTINGS).into_iter().collect();
    let service = read_service(command, &settings)?;
    let on_path = |path: &str| process::find_rosmaster_on(path.as_ref()).is_some();
    if service.searches_rosmaster && !on_path(process::SERVICE_PATH) {
        if !on_path(caller.get("PATH").map_or("", String::as_str)) {
            let text = "found no rosmaster on the PATH or in /opt/ros: install ROS 1 or source its setup.bash, then \
                        run this again";
            return Err(CommandFailure::Failed(text.to_owned()));
        }
        settings.extend(given(&PATHS));
    }
    let run_as = account(args, paths, &caller)?;

    let mut plan = SystemChanges::default();
    if let Some(user) = &run_as
        && named_user(args, &caller).is_none()
        && rustix::process::geteuid().is_root()
    {
        plan.notes.push(format!(
            "shown for {user}. Without sudo, name the user that runs the service, as in --run-as robot"
        ));
    }
    if let Some(commands) = as_system_program(program).filter(|_| !paths.user) {
        plan.obstacles.push(format!(
            "{} is not in a system folder: run {commands}",
            program.display()
        ));
    }
    if let Some(obstacle) = other_master(&settings, &service.advertised).await {
        match args.other_master {
            true => plan.notes.push(obstacle),
            false => plan.obstacles.push(format!(
                "{obstacle}, then run this again, or confirm it with --other-master"
            )),
        }
    }
    let (disabled, before) = plan.plan_other_units(paths, &service);
    let files = paths.files();
    let [unit, socket_unit, dropin, socket_dropin] =
        files.each_ref().map(|path| fs::read_to_string(path).ok());
    let old = dropin.unwrap_or_default();
    let all_disabled = [&disabled[..], &units::disabled(&old)].concat();
    let robot = UnitSettings {
        program,
        command,
        run_as: run_as.as_deref(),
        settings: &settings,
        listen: &service.listen,
        before: &before,
        disabled: &all_disabled,
    };
    let [new_unit, new_socket_unit] = match paths.is_packaged(program) {
        true => [None, None],
        false => units::units(paths.user).map(Some),
    };
    let (new, new_socket) = (robot.service(), robot.socket());
    let own_ports = files[3].parent().map(units::ports).unwrap_or_default();
    let is_socket_new = socket_dropin.as_ref() != Some(&new_socket);
    let wanted = [
        new_unit,
        new_socket_unit,
        Some(new.clone()),
        Some(new_socket),
    ];
    let present = [unit, socket_unit, Some(old.clone()), socket_dropin];
    for ((path, wanted), present) in files.into_iter().zip(wanted).zip(present) {
        let present = present.filter(|text| !text.is_empty());
        let is_ours = present.as_ref().is_none_or(|text| text.starts_with(MARK));
        match wanted {
            _ if !is_ours => plan.obstacles.push(format!(
                "{} was not written by `rosrescue install`: move it away, then run this again",
                path.display()
            )),
            Some(text) if present.as_ref() != Some(&text) => {
                plan.changes.push(Change::Write { path, text })
            }
            None if present.is_some() => plan.changes.push(Change::Remove { path }),
            _ => {}
        }
    }
    let is_changed = !plan.changes.is_empty();
    if is_changed && paths.systemd_runs() {
        plan.run(paths.systemctl(&["daemon-reload"]));
    }
    for unit in &disabled {
        plan.run(paths.systemctl(&[&["disable"], paths.now_option(), &[unit]].concat()));
    }
    let is_running = paths.systemd_runs()
        && UNITS
            .iter()
            .all(|unit| paths.systemctl_confirms("is-active", unit));
    let is_enabled = UNITS
        .iter()
        .all(|unit| paths.systemctl_confirms("is-enabled", unit));
    let [old_service, new_service] =
        [&old, &new].map(|dropin| InstalledService::read(paths.user, dropin));
    let [from, to] = [&old_service, &new_service].map(|it| checkpoint(it, &caller));
    if (is_running || !old.is_empty())
        && service.runs_rosmaster
        && let (Some(from), Some(to)) = (&from, &to)
        && from != to
        && from.try_exists().unwrap_or(true)
    {
        plan.notes.push(move_note(from, to, run_as.as_deref()));
    }
    if is_changed && is_running {
        // With another checkpoint, the next rosrescue would not find the master that this one has started.
        let adopts = old_service.runs_like(&new_service) && (from == to || !service.runs_rosmaster);
        plan.renew(paths, is_socket_new || !adopts);
        // The running service has its own ports until it is stopped.
        if disabled.is_empty()
            && let Some(port) = port_in_use(&service.listen, &own_ports)
        {
            plan.obstacles.push(format!(
                "port {port} is in use: stop the program there or choose another port, then run this again"
            ));
        }
    } else if !is_enabled || (!is_running && paths.systemd_runs()) {
        // A service whose starts fail or a proxy that waits for its first master does not run, but its socket listens.
        let listens =
            !is_running && paths.systemd_runs() && paths.systemctl_confirms("is-active", UNITS[1]);
        if listens {
            plan.run(paths.systemctl(&["stop", UNITS[1]]));
        }
        let own = if listens { &own_ports[..] } else { &[] };
        plan.start(paths, &service, own, !disabled.is_empty());
    }
    if !paths.systemd_runs() {
        plan.notes
            .push("systemd is not running here: the service starts at the next boot".to_owned());
    }
    let lingers = || {
        caller
            .get("USER")
            .is_some_and(|user| Path::new("/var/lib/systemd/linger").join(user).exists())
    };
    if paths.user && !lingers() {
        plan.notes.push("the service runs while you are logged in. To run it from boot on: `loginctl enable-linger`".to_owned());
    }
    Ok(plan)
}

fn uninstall(paths: &UnitPaths) -> SystemChanges {
    let mut plan = SystemChanges::default();
    let files = paths.files();
    let dropin = fs::read_to_string(&files[2]).unwrap_or_default();
    let is_ours =
        |path: &PathBuf| fs::read_to_string(path).is_ok_and(|text| text.starts_with(MARK));
    let ours: Vec<_> = files.into_iter().filter(is_ours).collect();
    if ours.is_empty() {
        plan.notes
            .push("`rosrescue install` has installed nothing here".to_owned());
        return plan;
    }
    plan.run(paths.systemctl(&[&["disable"], paths.now_option(), &UNITS].concat()));
    plan.changes
        .extend(ours.into_iter().map(|path| Change::Remove { path }));
    if paths.systemd_runs() {
        plan.run(paths.systemctl(&["daemon-reload"]));
    }
    for unit in units::disabled(&dropin) {
        plan.run(paths.systemctl(&[&["enable"], paths.now_option(), &[&unit]].concat()));
    }
    plan
}

impl SystemChanges {
    /// Handles other units that start a master or roslaunch. Returns those to disable, and those to start after
    /// rosrescue.
    fn plan_other_units(
        &mut self,
        paths: &UnitPaths,
        service: &Service,
    ) -> (Vec<String>, Vec<String>) {
        let (mut disabled, mut before) = (Vec::new(), Vec::new());
        let all = paths.other_units().into_iter();
        let needs = |port| service.listen.iter().any(|at| at.port() == port);
        for others::Unit { name, kind, .. } in all.filter(|unit| unit.is_enabled) {
            match kind {
                UnitKind::Roscore(port) | UnitKind::RoscoreAndNodes(port) if !needs(port) => {}
                UnitKind::Roscore(port) | UnitKind::RoscoreAndNodes(port)
                    if !service.runs_rosmaster =>
                {
                    self.obstacles.push(format!(
                        "{name} starts a master at port {port}, which rosrescue needs: give the master another port, \
                         as in `rosmaster --core -p 11312`, then run this again"
                    ));
                }
                UnitKind::RoscoreAndNodes(_) => self.obstacles.push(format!(
                    "{name} starts a master and nodes: {REMOVE_ROSCORE}, then run this again"
                )),
                UnitKind::Roscore(_) => {
                    self.notes.push(format!(
                        "{name} starts a master: rosrescue replaces it, and uninstall enables it again"
                    ));
                    disabled.push(name);
                }
                UnitKind::Roslaunch => {
                    self.notes.push(format!(
                        "{name} runs roslaunch, and will start after rosrescue: {ADD_WAIT}"
                    ));
                    before.push(name);
                }
                UnitKind::Rosrescue => {}
            }
        }
        (disabled, before)
    }

    fn start(
        &mut self,
        paths: &UnitPaths,
        service: &Service,
        own: &[u16],
        port_will_be_free: bool,
    ) {
        let mut options = paths.now_option().to_vec();
        if !service.runs_rosmaster && paths.systemd_runs() {
            // A proxy counts as started once it has a master, which can take long.
            options.push("--no-block");
        }
        self.run(paths.systemctl(&[&["enable"], &options[..], &UNITS].concat()));
        if paths.systemd_runs()
            && !port_will_be_free
            && let Some(port) = port_in_use(&service.listen, own)
        {
            self.obstacles.push(format!(
                "port {port} is in use: stop the robot and its roscore, then run this again"
            ));
        }
    }

    /// Makes the running service use its new files.
    fn renew(&mut self, paths: &UnitPaths, restart: bool) {
        if restart {
            self.run(paths.systemctl(&["stop", UNITS[1]]));
            self.run(paths.systemctl(&[&["start"], &UNITS[..]].concat()));
        } else {
            // This kills rosrescue, and the next rosrescue adopts the running master. Calls wait for some 0.2 s.
            self.run(paths.systemctl(&["kill", "--signal=KILL", "--kill-who=main", UNITS[0]]));
        }
    }
}

/// The port of `addresses` that a program uses, unless it is one of `own`.
fn port_in_use(addresses: &[SocketAddr], own: &[u16]) -> Option<u16> {
    let in_use = |address: &&SocketAddr| {
        TcpListener::bind(address).is_err_and(|error| error.kind() == io::ErrorKind::AddrInUse)
    };
    let mut others = addresses.iter().filter(|at| !own.contains(&at.port()));
    others.find(in_use).map(SocketAddr::port)
}

/// The checkpoint of `service`. `None` if this program does not understand its command.
fn checkpoint(service: &InstalledService, caller: &BTreeMap<String, String>) -> Option<PathBuf> {
    let (_, command) = service.command.split_first()?;
    let mut settings = service.settings.clone();
    let home = home(service.run_as.as_deref(), caller);
    settings.extend(home.map(|home| ("HOME".to_owned(), home)));
    let service = read_service(command, &settings).ok()?;
    Some(service.checkpoint)
}

/// Says that the checkpoint moves, and how to take the state along. The previous generation is a part of it: one that
/// an earlier service left at the new place would be read too.
fn move_note(from: &Path, to: &Path, run_as: Option<&str>) -> String {
    let (make, copy) = match run_as {
        Some(user) => (
            format!("sudo -u {user} mkdir -p"),
            format!("sudo install -m 600 -o {user}"),
        ),
        None => ("mkdir -p".to_owned(), "cp".to_owned()),
    };
    let folder = to.parent().filter(|folder| !folder.exists());
    let folder = folder.map(|folder| format!("{make} {}; ", folder.display()));
    let (folder, from, to) = (folder.unwrap_or_default(), from.display(), to.display());
    format!(
        "the checkpoint moves from {from} to {to}. To keep the robot's state, copy it first: \
         `{folder}{copy} {from} {to}; {copy} {from}.previous {to}.previous`"
    )
}

/// The commands that first copy the program to a system folder, unless it is in one. Root's service must not run it from
/// elsewhere, because its owner could replace it, and sudo does not find it there.
fn as_system_program(program: &Path) -> Option<String> {
    let folders = ["/usr", "/opt", "/bin"];
    let is_safe = folders.iter().any(|folder| program.starts_with(folder));
    (!is_safe).then(|| {
        format!(
            "`sudo install -m 755 {} /usr/local/bin/`, then {}",
            program.display(),
            again_with_sudo()
        )
    })
}

/// Why nodes with the `ROS_MASTER_URI` of `settings` would not use the service at `served`, and what to do.
async fn other_master(settings: &BTreeMap<String, String>, served: &MasterUri) -> Option<String> {
    let given = settings.get("ROS_MASTER_URI")?;
    let uri = MasterUri::parse(given).ok()?;
    let why = resolver::why_not_here(&uri, served.port, LOOKUP).await?;
    Some(format!(
        "ROS_MASTER_URI={given} {why}: nodes started with it would not use this service. Run `export \
         ROS_MASTER_URI={served}`"
    ))
}
