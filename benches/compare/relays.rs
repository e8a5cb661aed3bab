//! HAProxy and nginx as plain child processes in the foreground, before a rosmaster.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use crate::{
    party::Kind,
    shared::support::{Process, Scratch},
};

/// What a relay is run by, and the Debian package that has it.
fn program(kind: Kind) -> Option<(&'static str, &'static str)> {
    match kind {
        Kind::Haproxy => Some(("haproxy", "haproxy")),
        Kind::Nginx => Some(("nginx", "nginx-light")),
        Kind::Bare | Kind::Core | Kind::Proxy | Kind::CoreBefore | Kind::ProxyBefore => None,
    }
}

/// The program on the PATH, or where Debian has it, which is not on everybody's PATH.
fn find(name: &str) -> Option<PathBuf> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let mut folders: Vec<_> = std::env::split_paths(&path).collect();
    folders.push("/usr/sbin".into());
    let mut programs = folders.iter().map(|folder| folder.join(name));
    programs.find(|program| program.is_file())
}

/// The packages that are not installed.
pub(crate) fn missing() -> Vec<&'static str> {
    let programs = [Kind::Haproxy, Kind::Nginx].into_iter().filter_map(program);
    let missing = programs.filter(|(name, _)| find(name).is_none());
    missing.map(|(_, package)| package).collect()
}

/// The relay of this kind at `port`, before the master at `master`.
pub(crate) fn start(kind: Kind, scratch: &Scratch, port: u16, master: u16) -> Process {
    let (name, _) = program(kind).expect("a relay");
    let folder = scratch.path("");
    let file = scratch.path(format!("{name}.conf"));
    let mut command = Command::new(find(name).expect("an installed program"));
    scratch.prepare(&mut command);
    let text = if kind == Kind::Haproxy {
        command.args(["-db", "-f"]).arg(&file);
        haproxy(port, master)
    } else {
        command.arg("-p").arg(&folder).arg("-c").arg(&file);
        nginx(port, master, &folder)
    };
    fs::write(&file, text).expect("a file in the scratch folder");
    Process::start(name, &mut command)
}

/// A client's connection keeps its own to the master. A shared pool would hold some that the rosmaster is just closing,
/// as it does with those that are idle for its socket timeout, 5 s.
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

/// Kept-alive connections end before a rosmaster closes them.
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
