//! Provides what `rosrescue --version` prints: the version, and in a release build the commit and its date.
//!
//! `ROSRESCUE_COMMIT` and `SOURCE_DATE_EPOCH` take precedence over git, for builds from a tarball. A debug
//! build does not ask git, because then every commit would trigger a new build.

use std::{env, path::Path, process::Command};

fn main() {
    for variable in ["ROSRESCUE_COMMIT", "SOURCE_DATE_EPOCH"] {
        println!("cargo::rerun-if-env-changed={variable}");
    }
    println!("cargo::rerun-if-changed=build.rs");
    let release = env::var("PROFILE").is_ok_and(|profile| profile == "release");
    let of_git = if release { head() } else { None };
    let commit = given("ROSRESCUE_COMMIT").or_else(|| of_git.as_ref().map(|it| it.0.clone()));
    let date = given("SOURCE_DATE_EPOCH")
        .and_then(|seconds| date(&seconds))
        .or_else(|| of_git.map(|it| it.1));
    let version = env::var("CARGO_PKG_VERSION").unwrap_or_default();
    let mut origin = [commit, date].into_iter().flatten().collect::<Vec<_>>();
    if !release {
        origin.push("debug build".to_owned());
    }
    let version = match origin.is_empty() {
        true => version,
        false => format!("{version} ({})", origin.join(" ")),
    };
    println!("cargo::rustc-env=ROSRESCUE_VERSION={version}");
}

fn given(variable: &str) -> Option<String> {
    env::var(variable).ok().filter(|value| !value.is_empty())
}

/// Short hash and date of the commit that is checked out. `None` outside of rosrescue's own git repository.
fn head() -> Option<(String, String)> {
    let top = git(&["rev-parse", "--show-toplevel"])?;
    let here = env::var("CARGO_MANIFEST_DIR").ok()?;
    if Path::new(&top).canonicalize().ok()? != Path::new(&here).canonicalize().ok()? {
        return None;
    }
    // Changes with every commit, and when another branch is checked out.
    for file in ["HEAD", "logs/HEAD"] {
        if let Some(path) = git(&["rev-parse", "--git-path", file])
            && Path::new(&path).exists()
        {
            println!("cargo::rerun-if-changed={path}");
        }
    }
    let shown = git(&["show", "-s", "--abbrev=7", "--format=%h %cs", "HEAD"])?;
    let (commit, date) = shown.split_once(' ')?;
    let clean = git(&["status", "--porcelain", "--untracked-files=no"])?.is_empty();
    let mark = if clean { "" } else { "+" };
    Some((format!("{commit}{mark}"), date.to_owned()))
}

fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").args(arguments).output().ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    output.status.success().then(|| text.trim().to_owned())
}

/// The date of a time in seconds since 1970, from the `date` of GNU, busybox or toybox.
fn date(seconds: &str) -> Option<String> {
    let output = Command::new("date")
        .args(["-u", "-d", &format!("@{seconds}"), "+%Y-%m-%d"])
        .output();
    let text = String::from_utf8(output.ok()?.stdout).ok()?;
    Some(text.trim().to_owned()).filter(|text| !text.is_empty())
}
