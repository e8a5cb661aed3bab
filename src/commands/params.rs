//! `rosrescue params`: prints the parameters of a checkpoint, for `rosparam load`.

use std::{
    fmt,
    io::{self, Write},
};

use rescue_core::{
    checkpoint::{format::for_rosparam, putback::OF_THE_SESSION},
    hide::{Hide, Masked},
};
use ros1_master::xmlrpc::{Struct, Value};
use serde::Serialize;

use super::{CommandFailure, Exit, files, note, print};
use crate::{
    cli::ParamsArgs,
    printable::{Lines, Page, display_lines},
};

pub(super) async fn run(args: &ParamsArgs) -> Result<Exit, CommandFailure> {
    let opened = files::read_either(args.state.file.as_deref(), args.state.at, &args.read).await?;
    let mut tree = opened.state.params().clone();
    let mut left_out = Vec::new();
    if let Some(hide) = &args.hide_values {
        tree = without(&tree, "", hide, &mut left_out);
    }
    if args.output.json {
        // What is hidden was left out: a masked value would be taken for the real one.
        print(&Tree(Hide::nothing().mask_tree(&tree)), &args.output)?;
    } else {
        for name in OF_THE_SESSION {
            if tree.shift_remove(name.trim_start_matches('/')).is_some() {
                left_out.push(format!("left out {name}: it belongs to that session only"));
            }
        }
        let (yaml, not_carried) =
            for_rosparam(&tree).map_err(|error| CommandFailure::Failed(error.to_string()))?;
        left_out.extend(not_carried);
        match io::stdout().write_all(&yaml) {
            Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
                return Err(CommandFailure::Failed(format!("cannot print: {error}")));
            }
            _ => {}
        }
    }
    for sentence in left_out {
        note(&sentence);
    }
    Ok(Exit::Good)
}

/// The tree without hidden parameters, because `rosparam load` would load a masked value as the real one.
fn without(tree: &Struct, path: &str, hide: &Hide, left_out: &mut Vec<String>) -> Struct {
    let mut kept = Struct::new();
    for (key, value) in tree {
        let name = format!("{path}/{key}");
        match value {
            Value::Struct(members) if !members.is_empty() && !hide.hides(&name) => {
                let members = without(members, &name, hide, left_out);
                if !members.is_empty() {
                    kept.insert(key.clone(), Value::Struct(members));
                }
            }
            value if hide.mask(&name, value).value() == value => {
                drop(kept.insert(key.clone(), value.clone()))
            }
            _ => left_out.push(format!("left out {name}: it is hidden")),
        }
    }
    kept
}

#[derive(Serialize)]
#[serde(transparent)]
struct Tree(Masked<'static>);

impl Lines for Tree {
    fn lines(&self, f: &mut Page) -> fmt::Result {
        let count = self.0.members().into_iter().flatten().count();
        write!(f, "{count} parameters")
    }
}

display_lines!(Tree);
