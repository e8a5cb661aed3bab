//! `rosrescue install` runs rosrescue as a systemd service, and `rosrescue uninstall` undoes that.
//!
//! The units are static: the Debian package has them, and `install` writes them where the package is missing. What
//! differs from robot to robot is in a drop-in for each unit.

mod units;

use std::{
    collections::BTreeMap,
    ffi::OsString,
    fmt, fs,
    io::{self, IsTerminal},
    net::{SocketAddr, TcpListener},
    path::{Path, PathBuf},
    process::{self as system, Stdio},
    time::Duration,
};

use clap::{CommandFactory, FromArgMatches};
use serde::Serialize;

use self::units::{MARK, UnitSettings};
use super::{
    CommandFailure, Exit, agrees,
    check::units::{self as others, UnitKind},
    eprint_line, print,
};
use crate::{
    cli::{Cli, Command, InstallArgs, ScopeArgs, UninstallArgs, config_file},
    config::Config,
    printable::{Lines, Page, display_lines, line},
    process, resolver,
    ros_env::MasterUri,
    server::listener,
};

/// Longest time for the lookup of the host in `ROS_MASTER_URI`.
const LOOKUP: Duration = Duration::from_secs(6);
const UNITS: [&str; 2] = ["rosrescue.service", "rosrescue.socket"];
/// ROS's variables that concern the master.
const SETTINGS: [&str; 5] = [
    "ROS_MASTER_URI",
    "ROS_IP",
    "ROS_HOSTNAME",
    "ROS_HOME",
    "ROS_LOG_DIR",
];
/// Further variables that a ROS in an unusual place needs. Its `setup.bash` sets them.
const PATHS: [&str; 4] = ["PATH", "PYTHONPATH", "LD_LIBRARY_PATH", "ROS_PACKAGE_PATH"];

/// One change to the computer.
#[derive(Debug, Serialize)]
#[serde(tag = "change", rename_all = "snake_case")]
enum Change {
    Write { path: PathBuf, text: String },
    Remove { path: PathBuf },
    Run { command: Vec<String> },
}

/// All changes in order, and notes for the operator.
#[derive(Debug, Default, Serialize)]
struct SystemChanges {
    changes: Vec<Change>,
    notes: Vec<String>,
    /// Reasons not to make the changes.
    obstacles: Vec<String>,
}

pub(super) async fn run(args: &InstallArgs) -> Result<Exit, CommandFailure> {
    let place = UnitPaths::new(&args.scope)?;
    needs_root(&place, &args.scope)?;
    carry_out(&install(args, &place).await?, &args.scope)
}

pub(super) async fn undo(args: &UninstallArgs) -> Result<Exit, CommandFailure> {
    let place = UnitPaths::new(&args.scope)?;
    needs_root(&place, &args.scope)?;
    carry_out(&uninstall(&place), &args.scope)
}

/// Refuses a service of the computer without root, before any other obstacle is reported.
fn needs_root(place: &UnitPaths, args: &ScopeArgs) -> Result<(), CommandFailure> {
    if place.user || args.dry_run || rustix::process::geteuid().is_root() {
        return Ok(());
    }
    let words: Vec<_> = std::env::args().skip(1).collect();
    Err(CommandFailure::Usage(format!(
        "a service of this computer needs root: run `sudo rosrescue {}`, or use --user for a service of your own",
        words.join(" ")
    )))
}

/// Where the unit files go, and which systemd runs the service.
struct UnitPaths {
    /// Whether the service is a user's own, and not the system's.
    user: bool,
    units: PathBuf,
}

impl UnitPaths {
    fn new(args: &ScopeArgs) -> Result<Self, CommandFailure> {
        let (user, units) = (args.user, PathBuf::from("/etc/systemd/system"));
        if !user {
            return Ok(Self { user, units });
        }
        if rustix::process::geteuid().is_root() && std::env::var_os("SUDO_USER").is_some() {
            let text = "--user: run it as yourself, without sudo";
            return Err(CommandFailure::Usage(text.to_owned()));
        }
        let folder = |name: &str| {
            let folder = std::env::var_os(name).map(PathBuf::from);
            folder.filter(|folder| folder.is_absolute())
        };
        let config = folder("XDG_CONFIG_HOME").or_else(|| Some(folder("HOME")?.join(".config")));
        let config =
            config.ok_or_else(|| CommandFailure::Usage("--user: HOME is not set".to_owned()))?;
        let units = config.join("systemd/user");
        Ok(Self { user, units })
    }

    /// Whether the Debian package provides the units: only for the system's systemd, and only if `program` is the
    /// package's.
    fn is_packaged(&self, program: &Path) -> bool {
        let unit = Path::new("/usr/lib/systemd/system").join(UNITS[0]);
        !self.user && program == Path::new("/usr/bin/rosrescue") && unit.exists()
    }

    /// The two units and their drop-ins.
    fn files(&self) -> [PathBuf; 4] {
        let [service, socket] = UNITS.map(|unit| self.units.join(unit));
        let dropins = UNITS.map(|unit| self.units.join(format!("{unit}.d/install.conf")));
        let [service_dropin, socket_dropin] = dropins;
        [service, socket, service_dropin, socket_dropin]
    }

    fn systemctl(&self, words: &[&str]) -> Vec<String> {
        let manager: &[&str] = match self.user {
            true => &["systemctl", "--user"],
            false => &["systemctl"],
        };
        let words = manager.iter().chain(words);
        words.map(|&word| word.to_owned()).collect()
    }

    /// Whether systemctl confirms `question`, such as `is-active`, for `unit`.
    fn systemctl_confirms(&self, question: &str, unit: &str) -> bool {
        let command = self.systemctl(&[question, "--quiet", unit]);
        run_command(&command, Stdio::null()).is_ok_and(|status| status.success())
    }

    /// Whether systemd runs and can start the service.
    fn systemd_runs(&self) -> bool {
        let run = std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from);
        Path::new("/run/systemd/system").exists()
            && (!self.user || run.is_some_and(|run| run.join("systemd/private").exists()))
    }

    /// The systemctl option that starts or stops a unit at once, if systemd runs.
    fn now_option(&self) -> &'static [&'static str] {
        if self.systemd_runs() { &["--now"] } else { &[] }
    }

    fn other_units(&self) -> Vec<others::Unit> {
        let user = [self.units.clone(), "/etc/systemd/user".into()];
        let folders = if self.user { &user[..] } else { &[] };
        others::in_folders(folders, !self.user)
    }
}

async fn install(args: &InstallArgs, place: &UnitPaths) -> Result<SystemChanges, CommandFailure> {
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
    let run_as = account(args, place, &caller)?;
    let program = std::env::current_exe();
    let program = program.map_err(|error| {
        CommandFailure::Failed(format!("cannot find this program's file: {error}"))
    })?;

    let mut plan = SystemChanges::default();
    if let Some(user) = &run_as
        && named_user(args, &caller).is_none()
        && rustix::process::geteuid().is_root()
    {
        plan.notes.push(format!(
            "shown for {user}. Without sudo, name the user that runs the service, as in --run-as robot"
        ));
    }
    plan.obstacles
        .extend(misplaced(&program).filter(|_| !place.user));
    if let Some(obstacle) = other_master(&settings, &service.advertised).await {
        match args.other_master {
            true => plan.notes.push(obstacle),
            false => plan.obstacles.push(format!(
                "{obstacle}, then run this again, or confirm it with --other-master"
            )),
        }
    }
    let (disabled, before) = plan.plan_other_units(place, &service);
    let files = place.files();
    let [unit, socket_unit, dropin, socket_dropin] =
        files.each_ref().map(|path| fs::read_to_string(path).ok());
    let old = dropin.unwrap_or_default();
    let all_disabled = [&disabled[..], &units::disabled(&old)].concat();
    let robot = UnitSettings {
        program: &program,
        command,
        run_as: run_as.as_deref(),
        settings: &settings,
        listen: &service.listen,
        before: &before,
        disabled: &all_disabled,
    };
    let [new_unit, new_socket_unit] = match place.is_packaged(&program) {
        true => [None, None],
        false => units::units(place.user).map(Some),
    };
    let (new, new_socket) = (robot.service(), robot.socket());
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
    if is_changed && place.systemd_runs() {
        plan.run(place.systemctl(&["daemon-reload"]));
    }
    for unit in &disabled {
        plan.run(place.systemctl(&[&["disable"], place.now_option(), &[unit]].concat()));
    }
    let is_running = place.systemd_runs()
        && UNITS
            .iter()
            .all(|unit| place.systemctl_confirms("is-active", unit));
    let is_enabled = UNITS
        .iter()
        .all(|unit| place.systemctl_confirms("is-enabled", unit));
    if is_changed && is_running {
        // The settings that say what runs, and as which user.
        let key = |text: &str| {
            let keys = ["User=", "ExecStart=/"];
            let lines = text.lines();
            let lines = lines.filter(|line| keys.iter().any(|key| line.starts_with(key)));
            let words = lines.map(|line| line.split(' ').take(2).collect::<String>());
            words.collect::<Vec<_>>()
        };
        plan.renew(place, is_socket_new || key(&old) != key(&new));
    } else if !is_enabled || (!is_running && place.systemd_runs()) {
        plan.start(place, &service, !disabled.is_empty());
    }
    if !place.systemd_runs() {
        plan.notes
            .push("systemd is not running here: the service starts at the next boot".to_owned());
    }
    let lingers = || {
        caller
            .get("USER")
            .is_some_and(|user| Path::new("/var/lib/systemd/linger").join(user).exists())
    };
    if place.user && !lingers() {
        plan.notes.push("the service runs while you are logged in. To run it from boot on: `loginctl enable-linger`".to_owned());
    }
    Ok(plan)
}

fn uninstall(place: &UnitPaths) -> SystemChanges {
    let mut plan = SystemChanges::default();
    let files = place.files();
    let dropin = fs::read_to_string(&files[2]).unwrap_or_default();
    let is_ours =
        |path: &PathBuf| fs::read_to_string(path).is_ok_and(|text| text.starts_with(MARK));
    let ours: Vec<_> = files.into_iter().filter(is_ours).collect();
    if ours.is_empty() {
        plan.notes
            .push("`rosrescue install` has installed nothing here".to_owned());
        return plan;
    }
    plan.run(place.systemctl(&[&["disable"], place.now_option(), &UNITS].concat()));
    plan.changes
        .extend(ours.into_iter().map(|path| Change::Remove { path }));
    if place.systemd_runs() {
        plan.run(place.systemctl(&["daemon-reload"]));
    }
    for unit in units::disabled(&dropin) {
        plan.run(place.systemctl(&[&["enable"], place.now_option(), &[&unit]].concat()));
    }
    plan
}

/// Shows the plan, asks, and makes the changes.
fn carry_out(plan: &SystemChanges, args: &ScopeArgs) -> Result<Exit, CommandFailure> {
    if args.dry_run || plan.changes.is_empty() || !plan.obstacles.is_empty() {
        print(plan, &args.output)?;
        return Ok(if plan.obstacles.is_empty() {
            Exit::Good
        } else {
            Exit::Bad
        });
    }
    if args.yes {
        print(plan, &args.output)?;
    } else if args.output.json || !io::stdin().is_terminal() {
        let text = "cannot ask here: look at the changes with --dry-run, then make them with --yes";
        return Err(CommandFailure::Usage(text.to_owned()));
    } else {
        plan.to_string().lines().for_each(eprint_line);
        if !agrees("Make these changes?").unwrap_or(false) {
            return Err(CommandFailure::Failed("changed nothing".to_owned()));
        }
    }
    for change in &plan.changes {
        change.apply()?;
    }
    Ok(Exit::Good)
}

impl SystemChanges {
    fn run(&mut self, command: Vec<String>) {
        self.changes.push(Change::Run { command });
    }

    /// Handles other units that start a master or roslaunch. Returns those to disable, and those to start after
    /// rosrescue.
    fn plan_other_units(
        &mut self,
        place: &UnitPaths,
        service: &Service,
    ) -> (Vec<String>, Vec<String>) {
        let (mut disabled, mut before) = (Vec::new(), Vec::new());
        let all = place.other_units().into_iter();
        for others::Unit { name, kind, .. } in all.filter(|unit| unit.is_enabled) {
            match kind {
                UnitKind::Roscore if !service.runs_rosmaster => self.obstacles.push(format!(
                    "{name} starts a master at port 11311, which rosrescue needs: give the master another port, as \
                     in `rosmaster --core -p 11312`, then run this again"
                )),
                UnitKind::Roscore => {
                    self.notes.push(format!(
                        "{name} starts a master: rosrescue replaces it, and uninstall enables it again"
                    ));
                    disabled.push(name);
                }
                UnitKind::Roslaunch => {
                    self.notes.push(format!(
                        "{name} runs roslaunch. It will start after rosrescue. Add `--wait` to its roslaunch, so \
                         that it never starts a master (robot_upstart: `rosrun robot_upstart install --wait …`)"
                    ));
                    before.push(name);
                }
                UnitKind::Rosrescue => {}
            }
        }
        (disabled, before)
    }

    fn start(&mut self, place: &UnitPaths, service: &Service, port_will_be_free: bool) {
        let mut options = place.now_option().to_vec();
        if !service.runs_rosmaster && place.systemd_runs() {
            // A proxy counts as started once it has a master, which can take long.
            options.push("--no-block");
        }
        self.run(place.systemctl(&[&["enable"], &options[..], &UNITS].concat()));
        let in_use = |address: &SocketAddr| {
            TcpListener::bind(address).is_err_and(|error| error.kind() == io::ErrorKind::AddrInUse)
        };
        if place.systemd_runs() && !port_will_be_free && service.listen.iter().any(in_use) {
            let port = service.listen.first().map_or(0, SocketAddr::port);
            self.obstacles.push(format!(
                "port {port} is in use: stop the robot and its roscore, then run this again"
            ));
        }
    }

    /// Makes the running service use its new files.
    fn renew(&mut self, place: &UnitPaths, restart: bool) {
        if restart {
            self.run(place.systemctl(&["stop", UNITS[1]]));
            self.run(place.systemctl(&[&["start"], &UNITS[..]].concat()));
        } else {
            // This kills rosrescue, and the next rosrescue adopts the running master. Calls wait for some 0.2 s.
            self.run(place.systemctl(&["kill", "--signal=KILL", "--kill-who=main", UNITS[0]]));
        }
    }
}

impl Change {
    fn apply(&self) -> Result<(), CommandFailure> {
        match self {
            Self::Write { path, text } => {
                let folder = path.parent().unwrap_or(path);
                let written = fs::create_dir_all(folder).and_then(|()| fs::write(path, text));
                written.map_err(|error| {
                    CommandFailure::Failed(format!("cannot write {}: {error}", path.display()))
                })
            }
            Self::Remove { path } => {
                let removed = fs::remove_file(path);
                // The folder may hold drop-ins of others.
                if let Some(folder) = path
                    .parent()
                    .filter(|it| it.extension().is_some_and(|end| end == "d"))
                {
                    let _ = fs::remove_dir(folder);
                }
                removed.map_err(|error| {
                    CommandFailure::Failed(format!("cannot remove {}: {error}", path.display()))
                })
            }
            Self::Run { command } => {
                let said = command.join(" ");
                match run_command(command, Stdio::inherit()) {
                    Ok(status) if status.success() => Ok(()),
                    Ok(status) => Err(CommandFailure::Failed(format!(
                        "`{said}` failed ({status}): see above, or `journalctl -u rosrescue`. `rosrescue uninstall` \
                         undoes what was done"
                    ))),
                    Err(error) => Err(CommandFailure::Failed(format!("`{said}`: {error}"))),
                }
            }
        }
    }
}

impl Lines for SystemChanges {
    fn lines(&self, f: &mut Page) -> fmt::Result {
        if self.changes.is_empty() {
            line!(f, "nothing to change")?;
        }
        for change in &self.changes {
            match change {
                Change::Write { path, text } => {
                    line!(f, "write   {}", path.display())?;
                    for line in text.lines() {
                        line!(f, "        {line}")?;
                    }
                }
                Change::Remove { path } => line!(f, "remove  {}", path.display())?,
                Change::Run { command } => line!(f, "run     {}", command.join(" "))?,
            }
        }
        for note in &self.notes {
            line!(f, "note    {note}")?;
        }
        for obstacle in &self.obstacles {
            line!(f, "cannot  {obstacle}")?;
        }
        Ok(())
    }
}

display_lines!(SystemChanges);

fn run_command(words: &[String], errors: Stdio) -> io::Result<system::ExitStatus> {
    let (program, arguments) = words.split_first().ok_or(io::ErrorKind::InvalidInput)?;
    let mut command = system::Command::new(program);
    let command = command.args(arguments).stdin(Stdio::null());
    command.stdout(Stdio::null()).stderr(errors).status()
}

/// The environment of the user who called sudo. sudo clears it, but sudo's own process still has it.
fn caller_environment() -> BTreeMap<String, String> {
    let own = std::env::vars_os()
        .filter_map(|(name, value)| Some((name.into_string().ok()?, value.into_string().ok()?)));
    let own: BTreeMap<_, _> = own.collect();
    let parent = rustix::process::getppid().filter(|_| own.contains_key("SUDO_USER"));
    let of_sudo = parent.and_then(|parent| {
        let parent = PathBuf::from(format!("/proc/{}", parent.as_raw_pid()));
        let name = fs::read_to_string(parent.join("comm")).ok()?;
        (name.trim() == "sudo").then(|| fs::read(parent.join("environ")).ok())?
    });
    let Some(environ) = of_sudo else { return own };
    let pairs = environ.split(|byte| *byte == 0).filter_map(|pair| {
        let (name, value) = std::str::from_utf8(pair).ok()?.split_once('=')?;
        Some((name.to_owned(), value.to_owned()))
    });
    // Only this process's environment has sudo's variables about the caller.
    let of_caller = own.iter().filter(|(name, _)| name.starts_with("SUDO_"));
    pairs
        .chain(of_caller.map(|(name, value)| (name.clone(), value.clone())))
        .collect()
}

/// The user that runs the service, if an option or sudo names it.
fn named_user(args: &InstallArgs, caller: &BTreeMap<String, String>) -> Option<String> {
    let of_caller = || caller.get("SUDO_USER").cloned();
    args.run_as.clone().or_else(of_caller)
}

/// The name of the user who runs this process.
fn own_name() -> Result<String, CommandFailure> {
    let output = system::Command::new("id").arg("-un").output();
    let name = output.map(|output| String::from_utf8_lossy(&output.stdout).trim().to_owned());
    let name = name.map_err(|error| CommandFailure::Failed(format!("id: {error}")))?;
    Some(name)
        .filter(|name| !name.is_empty())
        .ok_or_else(|| CommandFailure::Failed("this user has no name: use --run-as".to_owned()))
}

/// The user that runs the service. `None` for a user's own service. A dry run needs no sudo.
fn account(
    args: &InstallArgs,
    place: &UnitPaths,
    caller: &BTreeMap<String, String>,
) -> Result<Option<String>, CommandFailure> {
    if place.user {
        return Ok(None);
    }
    let Some(user) = named_user(args, caller) else {
        return match args.scope.dry_run {
            true => own_name().map(Some),
            false => Err(CommandFailure::Usage(
                "name the user that runs the service, as in --run-as robot: without sudo, install cannot know it"
                    .to_owned(),
            )),
        };
    };
    let nobody = || {
        CommandFailure::Usage(format!(
            "--run-as: there is no user `{user}` on this computer"
        ))
    };
    if user.starts_with('-') {
        return Err(nobody());
    }
    let getent = ["getent", "passwd", &user].map(str::to_owned);
    let status = run_command(&getent, Stdio::null());
    let status = status.map_err(|error| CommandFailure::Failed(format!("getent: {error}")))?;
    status
        .success()
        .then_some(Some(user.clone()))
        .ok_or_else(nobody)
}

/// Why root's service must not run the program at this path: its owner could replace it.
fn misplaced(program: &Path) -> Option<String> {
    let folders = ["/usr", "/opt", "/bin"];
    let is_safe = folders.iter().any(|folder| program.starts_with(folder));
    let program = program.display();
    (!is_safe).then(|| {
        format!(
            "{program} is not in a system folder: run `sudo install -m 755 {program} /usr/local/bin/`, then \
             `sudo rosrescue install`"
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

/// A parsed service command.
struct Service {
    listen: Vec<SocketAddr>,
    /// The address where nodes find the service.
    advertised: MasterUri,
    /// Whether the command is `core`, which starts the master itself.
    runs_rosmaster: bool,
    /// Whether the service must find rosmaster on the PATH.
    searches_rosmaster: bool,
}

/// Parses a service's command. The service gets none of the caller's ROSRESCUE_ variables.
fn read_service(
    words: &[String],
    settings: &BTreeMap<String, String>,
) -> Result<Service, CommandFailure> {
    let usage = |why: String| CommandFailure::Usage(format!("`{}`: {why}", words.join(" ")));
    let command = Cli::command()
        .mut_args(|option| option.env(None::<&str>))
        .mut_subcommands(|command| command.mut_args(|option| option.env(None::<&str>)));
    let mut all = vec![OsString::from("rosrescue")];
    all.extend(words.iter().map(OsString::from));
    config_file::insert(&command, &mut all).map_err(usage)?;
    let matches = command.try_get_matches_from(all).map_err(|error| {
        let text = error.to_string();
        let lines = text.lines().take_while(|line| !line.is_empty());
        let said = lines.map(str::trim).collect::<Vec<_>>().join(" ");
        usage(said.trim_start_matches("error: ").to_owned())
    })?;
    let cli = Cli::from_arg_matches(&matches).map_err(|error| usage(error.to_string()))?;
    let env = |name: &str| settings.get(name).cloned();
    let hostname = rustix::system::uname()
        .nodename()
        .to_string_lossy()
        .into_owned();
    let local = listener::local_address();
    let core = match &cli.command {
        Some(Command::Core(args)) => args,
        None => &cli.core,
        Some(Command::Proxy(_)) => &cli.core,
        Some(Command::Tool(_)) => return Err(usage("a service runs `core` or `proxy`".to_owned())),
    };
    let (config, common, rosmaster) = match &cli.command {
        Some(Command::Proxy(args)) => (
            Config::proxy(args, &env, &hostname, local),
            &args.common,
            None,
        ),
        _ => (
            Config::core(core, &env, &hostname, local),
            &core.common,
            Some(&core.rosmaster),
        ),
    };
    let files = [
        common.config.as_ref(),
        common.checkpoint.as_ref(),
        rosmaster.and_then(Option::as_ref),
    ];
    if let Some(file) = files.into_iter().flatten().find(|file| file.is_relative()) {
        let file = file.display();
        return Err(usage(format!(
            "write the full path of {file}: a service starts in /"
        )));
    }
    let config = config.map_err(|error| usage(error.to_string()))?;
    Ok(Service {
        listen: config.listen,
        advertised: config.advertised,
        runs_rosmaster: rosmaster.is_some(),
        searches_rosmaster: rosmaster.is_some_and(Option::is_none),
    })
}
