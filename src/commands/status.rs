//! `rosrescue status`: how the running one is.

use serde_json::Value;

use super::{Exit, Failure, print, running::Running};
use crate::cli::StatusArgs;

pub(super) async fn run(args: &StatusArgs) -> Result<Exit, Failure> {
    let running = Running::find(&args.target)?;
    let (_, json) = running.get("/status.json").await?;
    let status: Value = serde_json::from_slice(&json)
        .map_err(|error| Failure::Failed(format!("{}: {error}", running.address)))?;
    if args.output.json {
        print(&status, &args.output)?;
    } else {
        let (_, text) = running.get("/").await?;
        print(&String::from_utf8_lossy(&text), &args.output)?;
    }
    let unprotected = status.get("unprotected").is_some_and(Value::is_string);
    Ok(if unprotected { Exit::Bad } else { Exit::Good })
}
