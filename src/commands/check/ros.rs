//! Finds out what answers at a port, and how ROS runs on this computer.

use std::{
    fs,
    path::{Path, PathBuf},
    time::Duration,
};

use ros1_master::{
    master::{self, CALLER_ID, Method, Request},
    xmlrpc::{Call, Value},
};
use serde::Deserialize;
use tokio::net::TcpStream;

use crate::{
    commands::running::Running,
    nodes::client::{self, Reaction},
    process, resolver,
    ros_env::MasterUri,
    status::software,
    upstream::Connection,
};

/// Longest time for a server to answer.
const ANSWER_LIMIT: Duration = Duration::from_secs(3);
/// Longest time for Python to import a module.
const IMPORT_LIMIT: Duration = Duration::from_secs(20);
/// Largest answer to getPid, in bytes.
const MAX_REPLY: usize = 64 << 10;

/// What answers at an address.
#[derive(Clone, Debug)]
pub(super) enum Responder {
    Rosrescue {
        version: String,
        uri: String,
        /// The master behind that rosrescue. `None` if it runs as `core`.
        proxied: Option<MasterUri>,
        /// Clients that bypass rosrescue.
        bypassing: Vec<String>,
    },
    /// A master, with the process id that it reports.
    Master(Option<i32>),
    /// A program that does not speak XML-RPC.
    Other,
    /// No program listens at the address.
    Nobody,
    /// A program does not answer in time, or the address cannot be reached.
    Silent,
}

/// The fields of `/status.json` that the check needs.
#[derive(Deserialize)]
struct Page {
    version: String,
    uri: String,
    mode: String,
    master: String,
    bypassing: Vec<String>,
}

impl Responder {
    pub(super) async fn identify(address: &MasterUri) -> Self {
        let running = Running {
            address: address.clone(),
        };
        let page = tokio::time::timeout(ANSWER_LIMIT, running.get("/status.json")).await;
        if let Ok(Ok((_, json))) = &page
            && let Ok(page) = serde_json::from_slice::<Page>(json)
        {
            return Self::Rosrescue {
                version: page.version,
                uri: page.uri,
                proxied: MasterUri::parse(&page.master)
                    .ok()
                    .filter(|_| page.mode == "proxy"),
                bypassing: page.bypassing,
            };
        }
        let (uri, get_pid) = (address.to_string(), master::get_pid());
        match client::call_for_value(&uri, &get_pid, ANSWER_LIMIT).await {
            (Reaction::Alive, None) if speaks(address).await.is_none() => Self::Other,
            (Reaction::Alive, pid) => Self::Master(pid.as_ref().and_then(Value::as_int)),
            (Reaction::Dead, _) => Self::Nobody,
            (Reaction::Silent, _) if page.is_err() => Self::Silent,
            (Reaction::Silent, _) => Self::Other,
        }
    }
}

/// The HTTP version of the master at `address`, if it answers.
pub(super) async fn speaks(address: &MasterUri) -> Option<String> {
    let ask = async {
        let addresses = resolver::addresses(&address.host, address.port).await;
        let stream = TcpStream::connect(&*addresses.ok()?).await.ok()?;
        let connection = Connection::over(stream, address, MAX_REPLY).await;
        let mut connection = connection.ok()?;
        let get_pid = Request::new(Method::GetPid, [CALLER_ID]);
        connection.call(&get_pid).await.ok()?;
        Some(software::speaks(
            connection.keeps_alive()?,
            connection.server(),
        ))
    };
    tokio::time::timeout(ANSWER_LIMIT, ask).await.ok()?
}

/// The nodes registered at `uri`, each with its address.
pub(super) async fn nodes(uri: &str) -> Vec<(String, MasterUri)> {
    let ask = async |method: &str, params: Vec<Value>| {
        let params = std::iter::once("/rosrescue_check".into()).chain(params);
        let call = Call::new(method, params.collect());
        client::call_for_value(uri, &call, ANSWER_LIMIT).await.1
    };
    let mut nodes = Vec::new();
    let state = ask("getSystemState", Vec::new()).await;
    let mut names = Vec::new();
    for list in state.iter().filter_map(Value::as_array).flatten() {
        for entry in list.as_array().unwrap_or_default() {
            if let Some([_, Value::Array(nodes)]) = entry.as_array() {
                names.extend(nodes.iter().filter_map(Value::as_str).map(str::to_owned));
            }
        }
    }
    names.sort();
    names.dedup();
    for name in names {
        let Some(Value::String(api)) = ask("lookupNode", vec![name.as_str().into()]).await else {
            continue;
        };
        nodes.extend(MasterUri::parse(&api).ok().map(|address| (name, address)));
    }
    nodes
}

/// An installed rosmaster.
#[derive(Clone, Debug)]
pub(super) struct Program {
    pub(super) path: PathBuf,
    /// The version from its package.
    pub(super) version: Option<String>,
    /// The first line of the script.
    pub(super) interpreter: String,
    /// Python's error when it runs the program. `None` if there is no error, or if the program is not written in
    /// Python.
    pub(super) broken: Option<String>,
}

impl Program {
    /// Finds the given program, or the one that `core` would run.
    pub(super) async fn find(given: Option<&Path>) -> Result<Self, String> {
        let path = process::find_rosmaster(given).map_err(|error| error.to_string())?;
        let interpreter = process::interpreter(&path).unwrap_or_default();
        let broken = match interpreter.split_first() {
            Some(_) if given.is_some() => None,
            Some((python, arguments)) => import(python, arguments, "rosmaster.main", &path).await,
            None => None,
        };
        Ok(Self {
            version: version(&path),
            interpreter: interpreter.join(" "),
            path,
            broken,
        })
    }
}

/// The version in the `package.xml` of `program`. Ubuntu 16.04 does not install that file for rosmaster, so the version
/// of rosgraph is used: both are released together, with one number.
fn version(program: &Path) -> Option<String> {
    let real = program.canonicalize().ok()?;
    let prefix = real.parent()?.parent()?;
    let mut packages = ["rosmaster", "rosgraph"].into_iter().filter_map(|name| {
        fs::read_to_string(prefix.join("share").join(name).join("package.xml")).ok()
    });
    let package = packages.next()?;
    let (_, rest) = package.split_once("<version>")?;
    Some(rest.split_once('<')?.0.trim().to_owned())
}

/// Imports `module` with the ROS of `program`. The error is Python's message.
async fn import(
    python: &str,
    arguments: &[String],
    module: &str,
    program: &Path,
) -> Option<String> {
    let mut command = process::python(Path::new(python), program);
    let import = format!("import {module}");
    let run = command.args(arguments).args(["-c", &import]).output();
    match tokio::time::timeout(IMPORT_LIMIT, run).await {
        Ok(Ok(output)) if output.status.success() => None,
        Ok(Ok(output)) => {
            let said = String::from_utf8_lossy(&output.stderr);
            let last = said.lines().rfind(|line| !line.trim().is_empty());
            Some(last.unwrap_or("no reason given").to_owned())
        }
        Ok(Err(error)) => Some(error.to_string()),
        Err(_) => Some(format!("no end in {} s", IMPORT_LIMIT.as_secs())),
    }
}

/// The python3 that nodes with `#!/usr/bin/env python3` run with, if it is not the system's and lacks ROS.
pub(super) async fn strange_python() -> Option<PathBuf> {
    let python = process::find_program("python3", &[])?;
    if ["/usr/bin/python3", "/bin/python3"]
        .iter()
        .any(|own| python == Path::new(own))
    {
        return None;
    }
    let name = python.to_string_lossy().into_owned();
    let broken = import(&name, &[], "rosgraph", Path::new("/")).await;
    broken.map(|_| python)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The first layout is that of Ubuntu 16.04.
    #[test]
    fn the_version_is_that_of_rosmaster_or_else_of_rosgraph() {
        let folder = tempfile::tempdir().unwrap();
        let program = folder.path().join("bin/rosmaster");
        fs::create_dir(folder.path().join("bin")).unwrap();
        fs::write(&program, "").unwrap();
        assert_eq!(version(&program), None);
        for (name, number) in [("rosgraph", "1.11.16"), ("rosmaster", "1.12.17")] {
            let share = folder.path().join("share").join(name);
            fs::create_dir_all(&share).unwrap();
            let package = format!("<package><version> {number}</version></package>");
            fs::write(share.join("package.xml"), package).unwrap();
            assert_eq!(version(&program).as_deref(), Some(number));
        }
    }
}
