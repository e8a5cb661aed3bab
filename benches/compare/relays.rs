//! HAProxy and nginx as plain child processes in front of a rosmaster.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use crate::{
    party::Kind,
    shared::support::{Process, Scratch},
};

/// The name of a relay's program, and of the Debian package that contains it.
fn program(kind: Kind) -> Option<(&'static str, &'static str)> {
    match kind {
        Kind::Haproxy => Some(("haproxy", "haproxy")),
        Kind::Nginx => Some(("nginx", "nginx-light")),
        Kind::Bare | Kind::Core | Kind::Proxy | Kind::CoreBefore | Kind::ProxyBefore => None,
    }
}

/// Finds a program in the PATH, or where Debian installs it, which is not in every user's PATH.
fn find(name: &str) -> Option<PathBuf> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let mut folders: Vec<_> = std::env::split_paths(&path).collect();
    folders.push("/usr/sbin".into());
    let mut programs = folders.iter().map(|folder| folder.join(name));
    programs.find(|program| program.is_file())
}

/// The Debian packages that are not installed.
pub(crate) fn missing() -> Vec<&'static str> {
    let programs = [Kind::Haproxy, Kind::Nginx].into_iter().filter_map(program);
    let missing = programs.filter(|(name, _)| find(name).is_none());
    missing.map(|(_, package)| package).collect()
}

/// Starts a relay at `port` in front of the master at `master`.
pub(crate) fn start(kind: Kind, scratch: &Scratch, port: u16, master: u16) -> Process {
    let (name, _) = program(kind).expect("a relay");
    let folder = scratch.path("");
    let file = scratch.path(format!("{name}.conf"));
    let mut command = Command::new(find(name).expect("the program of the relay is not installed"));
    scratch.prepare(&mut command);
    let text = if kind == Kind::Haproxy {
        command.args(["-db", "-f"]).arg(&file);
        haproxy(port, master)
    } else {
        command.arg("-p").arg(&folder).arg("-c").arg(&file);
        nginx(port, master, &folder)
    };
    fs::write(&file, text).expect("cannot write to the scratch folder");
    Process::start(name, &mut command)
}

/// The configuration of HAProxy. Each client connection has its own connection to the master. A shared pool
/// would contain some that rosmaster is just closing, because it closes idle ones after its socket timeout of
/// 5 s.
fn haproxy(port: u16, master: u16) -> String {
    format!(
        "global
  nbthread 1
  maxconn 4096
defaults
  mode http
  option http-keep-alive
  http-reuse never
  timeout connect 5s
  timeout client 120s
  timeout server 120s
frontend nodes
  bind 127.0.0.1:{port}
  default_backend master
backend master
  server rosmaster 127.0.0.1:{master}
"
    )
}

/// The configuration of nginx. Kept connections are closed before rosmaster closes them.
fn nginx(port: u16, master: u16, folder: &Path) -> String {
    let kinds = ["client_body", "proxy", "fastcgi", "uwsgi", "scgi"];
    let folder = folder.display();
    let temporary = kinds.map(|kind| format!("  {kind}_temp_path {folder}/{kind};\n"));
    format!(
        "user root;
daemon off;
worker_processes 1;
pid {folder}/nginx.pid;
error_log stderr;
events {{ worker_connections 4096; }}
http {{
{}  access_log off;
  client_max_body_size 64m;
  client_body_buffer_size 1m;
  keepalive_timeout 60s;
  keepalive_requests 1000000000;
  upstream master {{
    server 127.0.0.1:{master};
    keepalive 512;
    keepalive_requests 1000000000;
    keepalive_timeout 2s;
  }}
  server {{
    listen 127.0.0.1:{port};
    location / {{
      proxy_pass http://master;
      proxy_http_version 1.1;
      proxy_set_header Connection \"\";
      proxy_read_timeout 120s;
      proxy_buffers 64 16k;
      proxy_max_temp_file_size 0;
    }}
  }}
}}
",
        temporary.concat()
    )
}
