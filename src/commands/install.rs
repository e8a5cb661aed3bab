//! `rosrescue install`: makes a service of systemd of it.

pub(super) mod apply;
pub(super) mod facts;
mod found;
pub(super) mod manifest;
pub(super) mod place;
pub(super) mod plan;
mod units;

use std::{collections::BTreeMap, fs, path::PathBuf};

use clap::{CommandFactory, FromArgMatches};

use self::{
    manifest::Manifest,
    place::Place,
    plan::{Facts, Plan, Wanted},
    units::Units,
};
use super::{Exit, Failure, print};
use crate::{
    cli::{Cli, Command, InstallArgs, ScopeArgs},
    config::Config,
    process,
    server::listener,
};

/// ROS's variables that concern a master.
const SETTINGS: [&str; 5] = [
    "ROS_MASTER_URI",
    "ROS_IP",
    "ROS_HOSTNAME",
    "ROS_HOME",
    "ROS_LOG_DIR",
];
/// What a ROS in an unusual place needs besides. `setup.bash` sets them.
const PATHS: [&str; 4] = ["PATH", "PYTHONPATH", "LD_LIBRARY_PATH", "ROS_PACKAGE_PATH"];

pub(super) async fn run(args: &InstallArgs) -> Result<Exit, Failure> {
    let place = place(&args.scope)?;
    let plan = plan(args, &place)?;
    if args.scope.dry_run || !plan.obstacles.is_empty() {
        print(&plan, &args.scope.output)?;
        let good = plan.obstacles.is_empty();
        return Ok(if good { Exit::Good } else { Exit::Bad });
    }
    carry_out(&plan, &place, &args.scope, true)
}

/// Asks and does it.
pub(super) fn carry_out(
    plan: &Plan,
    place: &Place,
    args: &ScopeArgs,
    remembers: bool,
) -> Result<Exit, Failure> {
    needs_root(place)?;
    if plan.changes.is_empty() {
        // What was found may have changed all the same.
        print(plan, &args.output)?;
    } else if !apply::is_wanted(plan, args)? {
        return Err(Failure::Failed("nothing was changed".to_owned()));
    } else if args.yes {
        print(plan, &args.output)?;
    }
    apply::apply(plan, place, remembers)?;
    Ok(Exit::Good)
}

pub(super) fn place(args: &ScopeArgs) -> Result<Place, Failure> {
    if !args.user {
        return Ok(Place::system());
    }
    let env = |name: &str| std::env::var(name).ok();
    let place =
        Place::user(&env).ok_or_else(|| Failure::Usage("--user: HOME is not set".to_owned()))?;
    if rustix::process::geteuid().is_root() && env("SUDO_USER").is_some() {
        return Err(Failure::Usage(
            "--user: as yourself, without sudo".to_owned(),
        ));
    }
    Ok(place)
}

fn needs_root(place: &Place) -> Result<(), Failure> {
    if place.user || rustix::process::geteuid().is_root() {
        return Ok(());
    }
    let words: Vec<_> = std::env::args().skip(1).collect();
    let words = words.join(" ");
    Err(Failure::Usage(format!(
        "a service of the computer needs root: `sudo rosrescue {words}`, or --user for a service of your own"
    )))
}

fn plan(args: &InstallArgs, place: &Place) -> Result<Plan, Failure> {
    let earlier = facts::earlier(place)?;
    let caller = facts::caller_environment();
    let before = earlier.clone().unwrap_or_default();
    let mut settings = before.settings.clone();
    let given = SETTINGS
        .iter()
        .filter_map(|name| Some(((*name).to_owned(), caller.get(*name)?.clone())));
    settings.extend(given.filter(|(_, value)| !value.is_empty()));
    let service = match (&*args.service, &*before.service) {
        ([], []) => vec!["core".to_owned()],
        ([], earlier) => earlier.to_vec(),
        (given, _) => given.to_vec(),
    };
    let (config, rosmaster) = read_service(&service, &settings)?;
    if rosmaster.is_needed && process::find_rosmaster_on(process::SERVICE_PATH.as_ref()).is_none() {
        let path = caller.get("PATH").cloned().unwrap_or_default();
        process::find_rosmaster_on(path.as_ref()).ok_or_else(|| {
            Failure::Failed(
                "there is no rosmaster on the PATH or in /opt/ros: install ROS 1, or `source` its setup.bash, and do this \
                 again"
                    .to_owned(),
            )
        })?;
        let paths = PATHS
            .iter()
            .filter_map(|name| Some(((*name).to_owned(), caller.get(*name)?.clone())));
        settings.extend(paths);
    }
    let run_as = match (place.user, &args.run_as) {
        (true, _) => None,
        (false, Some(user)) => Some(user.clone()),
        (false, None) => Some(before.run_as.clone().or_else(|| caller.get("SUDO_USER").cloned()).or_else(|| {
            // Nothing is done: the caller sees what it would be.
            let caller = caller.get("USER").or_else(|| caller.get("LOGNAME"));
            caller.filter(|_| args.scope.dry_run).cloned()
        }).ok_or_else(|| {
            Failure::Usage("say who runs it, as in --run-as robot: sudo was not used, which would tell".to_owned())
        })?),
    };
    let home = run_as.as_deref().map(facts::home_of).transpose()?;
    let beside = if place.user {
        Some(Place::system())
    } else {
        let home = home.map(|home| home.to_string_lossy().into_owned());
        Place::user(&|name: &str| home.clone().filter(|_| name == "HOME"))
    };
    let port = config.listen.first().map_or(0, std::net::SocketAddr::port);
    let found = facts::found(place, beside.as_ref(), port);
    let launches = found
        .iter()
        .filter(|it| it.of_user == place.user && it.kind != found::Kind::Master);
    let launches: Vec<_> = launches.map(|it| it.unit.clone()).collect();
    let (program, copy) = program(place, &before)?;
    let units = Units {
        version: env!("CARGO_PKG_VERSION"),
        program: &program,
        service: &service,
        run_as: run_as.as_deref(),
        settings: &settings,
        environment: place.environment,
        listen: &config.listen,
        before: &launches,
    };
    let unit = |name: &str, text: String| Wanted {
        path: place.units.join(name),
        content: text.into_bytes(),
        mode: 0o644,
    };
    let mut wanted: Vec<_> = copy.into_iter().collect();
    wanted.push(unit(plan::UNITS[0], units.socket()));
    wanted.push(unit(plan::UNITS[1], units.service()));
    let chosen = Manifest {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        run_as,
        service,
        settings,
        ..Manifest::default()
    };
    let paths = wanted.iter().map(|it| &it.path).chain(before.files.keys());
    let facts = Facts {
        place,
        present: facts::present(paths),
        wanted,
        earlier,
        found,
        systemd_runs: facts::systemd_runs(place),
        is_running: plan::UNITS.iter().all(|unit| facts::is_active(place, unit)),
        is_enabled: plan::UNITS
            .iter()
            .all(|unit| facts::is_enabled(place, unit)),
        port,
        port_taken: facts::is_port_taken(&config.listen),
        proxy: !rosmaster.is_own,
    };
    Ok(plan::install(&facts, chosen))
}

/// What a service has to do with a rosmaster.
struct Rosmaster {
    /// It runs one.
    is_own: bool,
    /// It has to find one.
    is_needed: bool,
}

/// What the service's command line means. The service has none of the caller's ROSRESCUE_ variables.
fn read_service(
    service: &[String],
    settings: &BTreeMap<String, String>,
) -> Result<(Config, Rosmaster), Failure> {
    let usage = |why: String| Failure::Usage(format!("`{}`: {why}", service.join(" ")));
    let command = Cli::command()
        .mut_args(|option| option.env(None::<&str>))
        .mut_subcommands(|command| command.mut_args(|option| option.env(None::<&str>)));
    let words = std::iter::once("rosrescue").chain(service.iter().map(String::as_str));
    let matches = command.try_get_matches_from(words).map_err(|error| {
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
    let (config, common, rosmaster) = match &cli.command {
        Some(Command::Proxy(args)) => (
            Config::proxy(args, &env, &hostname, local),
            &args.common,
            None,
        ),
        Some(Command::Core(args)) => (
            Config::core(args, &env, &hostname, local),
            &args.common,
            Some(&args.rosmaster),
        ),
        None => {
            let args = &cli.core;
            (
                Config::core(args, &env, &hostname, local),
                &args.common,
                Some(&args.rosmaster),
            )
        }
        Some(Command::Tool(_)) => return Err(usage("a service runs `core` or `proxy`".to_owned())),
    };
    let files = [
        common.checkpoint.as_ref(),
        rosmaster.and_then(Option::as_ref),
    ];
    if let Some(file) = files.into_iter().flatten().find(|file| file.is_relative()) {
        return Err(usage(format!(
            "write the whole path of {}: a service starts in /",
            file.display()
        )));
    }
    let config = config.map_err(|error| usage(error.to_string()))?;
    let is_needed = rosmaster.is_some_and(Option::is_none);
    Ok((
        config,
        Rosmaster {
            is_own: rosmaster.is_some(),
            is_needed,
        },
    ))
}

/// The program that the unit names, and the file that has to be there for it: a program in somebody's folder
/// may be gone tomorrow.
fn program(place: &Place, before: &Manifest) -> Result<(PathBuf, Option<Wanted>), Failure> {
    let failed =
        |error: std::io::Error| Failure::Failed(format!("this program's own file: {error}"));
    let own = std::env::current_exe().map_err(failed)?;
    let is_safe = ["/usr", "/opt", "/bin"]
        .iter()
        .any(|folder| own.starts_with(folder))
        || own == place.program;
    if is_safe && !before.files.contains_key(&own) {
        return Ok((own, None));
    }
    let path = if is_safe {
        own.clone()
    } else {
        place.program.clone()
    };
    let content = fs::read(&own).map_err(failed)?;
    Ok((
        path.clone(),
        Some(Wanted {
            path,
            content,
            mode: 0o755,
        }),
    ))
}
