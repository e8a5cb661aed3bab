//! `rosrescue diff`: shows how two checkpoints differ, or a checkpoint and the running master.

use std::fmt;

use rescue_core::checkpoint::compare::{Described, compare};
use serde::Serialize;

use super::{CommandFailure, Exit, files, live::Live, print, running::Running};
use crate::{
    cli::DiffArgs,
    printable::{Lines, Page, display_lines, line},
};

pub(super) async fn run(args: &DiffArgs) -> Result<Exit, CommandFailure> {
    let a = files::read_either(args.a.as_deref(), args.from, &args.read).await?;
    let (b, state, names) = match (&args.b, args.from) {
        (Some(b), _) => {
            let b = files::read(b, &args.read).await?;
            (b.path.display().to_string(), b.state, ["A", "B"])
        }
        (None, Some(_)) => {
            let b = files::read_at(args.to, &args.read).await?;
            (b.moment(), b.state, ["A", "B"])
        }
        (None, None) => {
            let mut live = Live::connect(&Running::find(&args.target)?).await?;
            let state = live.state(&a.state).await?;
            (live.uri, state, ["the file", "the running master"])
        }
    };
    let differences = compare(&a.state, &state, &args.hide.hide_values);
    let differences = differences.into_iter();
    let differences = differences.map(|difference| difference.described(names));
    let diff = Diff {
        names,
        a: match args.from {
            Some(_) => a.moment(),
            None => a.path.display().to_string(),
        },
        b,
        differences: differences.collect(),
    };
    print(&diff, &args.output)?;
    Ok(if diff.differences.is_empty() {
        Exit::Good
    } else {
        Exit::Bad
    })
}

#[derive(Serialize)]
struct Diff {
    #[serde(skip)]
    names: [&'static str; 2],
    a: String,
    b: String,
    differences: Vec<Described>,
}

impl Lines for Diff {
    fn lines(&self, f: &mut Page) -> fmt::Result {
        if self.differences.is_empty() {
            return line!(f, "{} and {} do not differ", self.a, self.b);
        }
        let [a, b] = self.names;
        line!(f, "{a} is {}", self.a)?;
        line!(f, "{b} is {}", self.b)?;
        self.differences
            .iter()
            .try_for_each(|line| line!(f, "{}", line.text))
    }
}

display_lines!(Diff);
