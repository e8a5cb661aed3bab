//! The command line of rosrescue: arguments, logging, signals, exit codes.

use std::{
    io::{IsTerminal, Write},
    process::ExitCode,
    time::Duration,
};

use clap::{CommandFactory, error::ErrorKind};
use rosrescue::{
    app,
    cli::{Cli, Command, CommonArgs, LogFormat},
    config::Config,
    proxy::listener,
};
use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;
use tracing_subscriber::EnvFilter;

/// How long work beside the main one may go on when all is done.
const LAST_JOBS: Duration = Duration::from_millis(500);
/// More threads than these do not make a master faster that is Python; each keeps a heap of its own,
/// as large as its largest task was.
const THREADS_MAX: usize = 4;

fn main() -> ExitCode {
    let cli = Cli::read();
    let env = |name: &str| std::env::var(name).ok();
    let hostname = rustix::system::uname()
        .nodename()
        .to_string_lossy()
        .into_owned();
    let local = listener::local_address();
    let (config, common, verbose) = match &cli.command {
        Some(Command::Proxy(args)) => (
            Config::proxy(args, &env, &hostname, local),
            &args.common,
            args.verbose,
        ),
        Some(Command::Core(args)) => (
            Config::core(args, &env, &hostname, local),
            &args.common,
            args.verbose,
        ),
        None => {
            let args = &cli.core;
            (
                Config::core(args, &env, &hostname, local),
                &args.common,
                args.verbose,
            )
        }
    };
    let mut config = match config {
        Ok(config) => config,
        // Exit status 2, as all usage errors.
        Err(error) => Cli::command()
            .error(ErrorKind::ValueValidation, error)
            .exit(),
    };
    if let Err(error) = start_log(common, verbose) {
        Cli::command()
            .error(ErrorKind::ValueValidation, error)
            .exit();
    }
    config.fit_into(raise_file_limit());
    match run(config, hostname) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("rosrescue: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run(config: Config, hostname: String) -> Result<(), Box<dyn std::error::Error>> {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(cores.min(THREADS_MAX))
        .enable_all()
        .build()?;
    let ended = runtime.block_on(serve(config, hostname));
    // The closing checkpoint is on the disk, and has overtaken whatever was being written. What still
    // runs in a thread may be a question to a name server that never answers: the end of a process
    // does not wait for that, but the drop of a runtime would.
    runtime.shutdown_timeout(LAST_JOBS);
    ended
}

async fn serve(config: Config, hostname: String) -> Result<(), Box<dyn std::error::Error>> {
    let stop = CancellationToken::new();
    let (mut interrupt, mut terminate) = (
        signal(SignalKind::interrupt())?,
        signal(SignalKind::terminate())?,
    );
    // The terminal was closed. Whoever started us with nohup does not want to know.
    let mut hangup = match is_hangup_ignored() {
        true => None,
        false => Some(signal(SignalKind::hangup())?),
    };
    let stopper = stop.clone();
    tokio::spawn(async move {
        for first in [true, false] {
            let status = tokio::select! {
                _ = interrupt.recv() => 130,
                _ = terminate.recv() => 143,
                _ = async { hangup.as_mut()?.recv().await }, if hangup.is_some() => 129,
            };
            if first {
                stopper.cancel();
            } else {
                std::process::exit(status);
            }
        }
    });
    let mut names = vec![hostname, config.advertised.host.clone()];
    names.extend(std::env::var("ROS_HOSTNAME").ok());
    app::run(config, names, stop, say).await?;
    Ok(())
}

/// Whether we were started with SIGHUP ignored, as the kernel tells.
fn is_hangup_ignored() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    // The lowest bit is that of signal 1.
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok())
        .is_some_and(|mask| mask & 1 == 1)
}

/// Prints a line; a reader that has gone away is no reason to stop.
fn say(line: &str) {
    let mut stdout = std::io::stdout();
    let colour = stdout.is_terminal() && colour_is_welcome();
    let (on, off) = if colour {
        ("\x1b[1m", "\x1b[0m")
    } else {
        ("", "")
    };
    let _ = writeln!(stdout, "{on}{line}{off}").and_then(|()| stdout.flush());
}

fn colour_is_welcome() -> bool {
    std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty())
}

fn start_log(args: &CommonArgs, verbose: bool) -> Result<(), String> {
    let default = if verbose {
        "warn,rosrescue=debug"
    } else {
        "warn,rosrescue=info"
    };
    let filter = args.log.as_deref().unwrap_or(default);
    let filter =
        EnvFilter::try_new(filter).map_err(|error| format!("--log: `{filter}`: {error}"))?;
    let ansi = std::io::stderr().is_terminal() && colour_is_welcome();
    let log = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_target(false)
        // It would be told on stderr, and panic where the terminal is gone.
        .log_internal_errors(false)
        .with_ansi(ansi);
    match args.log_format {
        LogFormat::Text => log.init(),
        LogFormat::Json => log.json().init(),
    }
    Ok(())
}

/// As many files as the system lets us have; the usual limit of 1024 is soon reached. Answers how
/// many that is.
fn raise_file_limit() -> u64 {
    use rustix::process::{Resource, getrlimit, setrlimit};
    let mut limit = getrlimit(Resource::Nofile);
    let before = limit.current;
    limit.current = limit.maximum;
    let now = if setrlimit(Resource::Nofile, limit).is_ok() {
        limit.maximum
    } else {
        before
    };
    now.unwrap_or(u64::MAX)
}
