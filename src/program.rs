//! Arguments, logging, signals and exit statuses of the program `rosrescue`.

use std::{
    error::Error,
    ffi::OsString,
    io::{IsTerminal, Write},
    net::IpAddr,
    panic::{self, AssertUnwindSafe},
    process::ExitCode,
    time::{Duration, Instant},
};

use crate::{
    app,
    cli::{Cli, Command, LogFormat, LoggingArgs},
    commands,
    config::Config,
    guardian::{
        self,
        handover::{Guard, Sockets},
    },
    logging::Stderr,
    printable::Printable,
    resolver,
    ros_env::MasterUri,
    server::{hosts::own_names, listener},
    task::boxed,
};
use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;
use tracing_appender::non_blocking::WorkerGuard;
use tracing_subscriber::{
    Layer, filter::Targets, fmt, layer::SubscriberExt, util::SubscriberInitExt,
};

/// How long other threads may finish slow work, such as a name lookup, after rosrescue has stopped serving.
const LAST_JOBS: Duration = Duration::from_millis(500);
/// Longest time for the lookup of the host in `ROS_MASTER_URI`.
const LOOKUP: Duration = Duration::from_secs(6);
/// A signal to all processes named rosrescue, as sent by killall, reaches a worker twice: directly
/// and through its guardian. A second signal within this time counts as the first one.
const SAME_SIGNAL: Duration = Duration::from_millis(250);

/// Shortest run under systemd that ends with an error. systemd starts the next one after 50 ms, so that calls do not
/// wait long after a crash, and never gives up: without this pause, a wrong option would fill the journal.
const FAILED_RUN: Duration = Duration::from_secs(2);

/// Runs the program.
///
/// It is here and not in `main.rs`, so that the compiler generates the code of the whole program once.
pub fn main() -> ExitCode {
    let started = Instant::now();
    // This must come first: it removes variables from the environment, which is only safe with a
    // single thread.
    let sockets = Sockets::inherited();
    // There is an error if the socket unit is wrong.
    let by_systemd = matches!(
        &sockets,
        Err(_)
            | Ok(Some(Sockets {
                guard: Guard::Systemd,
                ..
            }))
    );
    let ended = sockets.map_err(Box::from).and_then(execute);
    ended.unwrap_or_else(|error| {
        let status = report(&*error);
        if by_systemd {
            std::thread::sleep(FAILED_RUN.saturating_sub(started.elapsed()));
        }
        status
    })
}

/// Prints why rosrescue ends, and returns its exit status.
fn report(error: &(dyn Error + 'static)) -> ExitCode {
    match error.downcast_ref::<clap::Error>() {
        Some(usage) => {
            // It fails if the terminal is gone.
            let _ = usage.print();
            ExitCode::from(u8::try_from(usage.exit_code()).unwrap_or(2))
        }
        None => {
            // The name and address of another computer may be in it.
            let line = error.to_string();
            let _ = writeln!(std::io::stderr(), "rosrescue: {}", Printable::line(&line));
            ExitCode::FAILURE
        }
    }
}

/// Does what the command line asks for. `sockets` are those that this process has inherited.
fn execute(sockets: Option<Sockets>) -> Result<ExitCode, Box<dyn Error>> {
    if sockets.is_some() {
        // The worker is started as /proc/self/exe, so without this its name would be `exe`.
        let _ = rustix::thread::set_name(c"rosrescue");
    }
    let is_worker = sockets
        .as_ref()
        .is_some_and(|sockets| matches!(sockets.guard, Guard::Guardian { .. }));
    let (cli, words) = Cli::read(is_worker)?;
    let env = |name: &str| std::env::var(name).ok();
    let hostname = rustix::system::uname()
        .nodename()
        .to_string_lossy()
        .into_owned();
    let local = listener::local_address();
    let (config, common, verbose) = match &cli.command {
        Some(Command::Tool(tool)) => return Ok(commands::run(tool)),
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
    let mut config = config.map_err(Cli::usage_error)?;
    let _log = start_log(&common.logging, verbose).map_err(Cli::usage_error)?;
    if let Some(sockets) = &sockets
        && matches!(sockets.guard, Guard::Systemd)
    {
        config.serve_at(sockets.addresses(), &env);
    }
    let status = start(config, sockets, common.no_guardian, hostname, words)?;
    Ok(ExitCode::from(u8::try_from(status).unwrap_or(1)))
}

/// Serves `sockets`, or runs the guardian of a worker that serves them.
fn start(
    mut config: Config,
    sockets: Option<Sockets>,
    no_guardian: bool,
    hostname: String,
    words: Vec<OsString>,
) -> Result<i32, Box<dyn Error>> {
    let sockets = match sockets {
        Some(sockets) => sockets,
        None => {
            let listeners = listener::bind(&config.listen, config.port_option())?;
            if !no_guardian {
                return Ok(guardian::run(&listeners, &words)?);
            }
            Sockets::from_listeners(listeners)
        }
    };
    config.fit_into(raise_file_limit());
    run(config, sockets, hostname)?;
    Ok(0)
}

fn run(config: Config, sockets: Sockets, hostname: String) -> Result<(), Box<dyn Error>> {
    // One thread: with more, each call wakes other threads, which costs a third more CPU time. One thread answers tens
    // of thousands of reads per second. Slow work runs elsewhere (`block_in_place`, `spawn_blocking`).
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()?;
    let served = || runtime.block_on(boxed(serve(config, sockets, hostname)));
    let ended = panic::catch_unwind(AssertUnwindSafe(served));
    // The closing checkpoint is on the disk and newer than any write that still runs. A thread may be waiting for a
    // silent disk or a dead name server. Dropping the runtime would wait for that thread; ending the process does not.
    runtime.shutdown_timeout(LAST_JOBS);
    ended.unwrap_or_else(|panic| panic::resume_unwind(panic))
}

async fn serve(config: Config, sockets: Sockets, hostname: String) -> Result<(), Box<dyn Error>> {
    let stop = CancellationToken::new();
    let (mut interrupt, mut terminate) = (
        signal(SignalKind::interrupt())?,
        signal(SignalKind::terminate())?,
    );
    // SIGHUP: the terminal was closed. It is ignored under nohup.
    let mut hangup = match guardian::is_hangup_ignored() {
        true => None,
        false => Some(signal(SignalKind::hangup())?),
    };
    sockets.guard.handles_signals();
    let stopper = stop.clone();
    let guarded = matches!(sockets.guard, Guard::Guardian { .. });
    crate::task::spawn(async move {
        let mut first = None;
        loop {
            let status = tokio::select! {
                _ = interrupt.recv() => 130,
                _ = terminate.recv() => 143,
                _ = async { hangup.as_mut()?.recv().await }, if hangup.is_some() => 129,
            };
            let first = *first.get_or_insert_with(Instant::now);
            if stopper.is_cancelled() && !(guarded && first.elapsed() < SAME_SIGNAL) {
                std::process::exit(status);
            }
            stopper.cancel();
        }
    });
    if let Some(served) = sockets.addresses().first() {
        let served = MasterUri {
            port: served.port(),
            ..config.advertised.clone()
        };
        // In the background: a dead name server must not delay the start.
        crate::task::spawn(warn_of_another_master(served));
    }
    let names = vec![hostname, config.advertised.host.clone()];
    app::run(config, sockets, own_names(names), stop, print_line).await?;
    Ok(())
}

/// Warns, as roscore does, if nodes with this environment would not use the rosrescue at `served`.
async fn warn_of_another_master(served: MasterUri) {
    let given = std::env::var("ROS_MASTER_URI").unwrap_or_default();
    let Ok(uri) = MasterUri::parse(&given) else {
        return;
    };
    // At boot, the network that has the own address may come up later.
    let is_address = uri.host.parse::<IpAddr>().is_ok();
    if is_address && uri.host == served.host && uri.port == served.port {
        return;
    }
    if let Some(why) = resolver::why_not_here(&uri, served.port, LOOKUP).await {
        tracing::warn!(
            "ROS_MASTER_URI={given} {why}: nodes started with it do not use this rosrescue; where they start, run \
             `export ROS_MASTER_URI={served}`"
        );
    }
}

/// Prints a line. A closed stdout is not an error.
fn print_line(line: &str) {
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

/// Starts the log. Its last lines are written when the guard is dropped.
fn start_log(args: &LoggingArgs, verbose: bool) -> Result<WorkerGuard, String> {
    let default = if verbose {
        "warn,rosrescue=debug,etcd_kv=debug"
    } else {
        "warn,rosrescue=info"
    };
    let filter = args.log.as_deref().unwrap_or(default);
    let filter: Targets = filter
        .parse()
        .map_err(|error| format!("--log: `{filter}`: {error}"))?;
    let ansi = std::io::stderr().is_terminal() && colour_is_welcome();
    let (stderr, guard) = Stderr::start(std::env::var("JOURNAL_STREAM").ok().as_deref());
    let log = fmt::layer()
        .with_writer(stderr)
        .with_target(false)
        // These errors would go to stderr, and panic if the terminal is gone.
        .log_internal_errors(false)
        .with_ansi(ansi);
    match args.log_format {
        LogFormat::Text => tracing_subscriber::registry()
            .with(log.with_filter(filter))
            .init(),
        LogFormat::Json => tracing_subscriber::registry()
            .with(log.json().with_filter(filter))
            .init(),
    }
    Ok(guard)
}

/// Raises the limit on open files as far as allowed, because the usual 1,024 are soon reached.
/// Returns the limit.
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
