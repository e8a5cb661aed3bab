//! Formats the results as Markdown.

use crate::{
    limit::Limit,
    robot::{Kind, Recovery},
    shared::machine,
};

/// The paper's Table 1, recovery alone: number of nodes and milliseconds.
const PAPER: [(usize, u32); 6] = [(1, 5), (5, 59), (10, 112), (20, 218), (40, 436), (80, 900)];

/// The results for one number of nodes.
#[derive(Debug)]
pub(crate) struct Row {
    nodes: usize,
    samples: Vec<(Recovery, Limit)>,
}

impl Row {
    pub(crate) fn new(nodes: usize) -> Self {
        Self {
            nodes,
            samples: Vec::new(),
        }
    }

    pub(crate) fn push(&mut self, ours: Recovery, limit: Limit) {
        self.samples.push((ours, limit));
    }

    pub(crate) fn kills(&self) -> usize {
        self.samples.len()
    }

    fn spread(&self, of: impl Fn(&Recovery, &Limit) -> f64) -> Spread {
        let mut values: Vec<_> = self
            .samples
            .iter()
            .map(|(ours, limit)| of(ours, limit))
            .collect();
        values.sort_by(f64::total_cmp);
        let middle = values.len() / 2;
        let median = match values.len() % 2 {
            1 => values[middle],
            _ => (values[middle - 1] + values[middle]) / 2.0,
        };
        Spread {
            median,
            max: values[values.len() - 1],
        }
    }
}

struct Spread {
    median: f64,
    max: f64,
}

impl Spread {
    fn cell(&self) -> String {
        format!("{:.1} ({:.1})", self.median, self.max)
    }
}

/// The tables with their explanation.
pub(crate) fn markdown(tables: &[(Kind, Vec<Row>)]) -> String {
    let mut text = format!(
        "Milliseconds, median (largest), on {}.\n",
        machine::describe()
    );
    for (kind, rows) in tables {
        let kills = rows.first().map_or(0, Row::kills);
        text += &format!(
            "\nWith {kind}, {kills} kills each:\n\n\
             | nodes | detection | new port open | recovery alone | its limit | ratio | whole state | \
             its limit | ratio | answer | the paper |\n\
             |--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|\n"
        );
        for row in rows {
            text += &line(row);
        }
    }
    text + "\n\
         * *detection*: from just before the SIGKILL to the shut gate. *New port open*: from the SIGKILL \
         to rosrescue's connection to the new master.\n\
         * *recovery alone*: from the open port to the open gate; the state has been restored, read \
         back and compared. *Its limit*: from the open port of a second rosmaster, started in the same \
         way between two kills, to its reply to a single multicall with the same registrations; nothing \
         read back or compared.\n\
         * *whole state*: from the SIGKILL to the open gate. *Its limit*: from the start of the second \
         rosmaster's process to that reply.\n\
         * *answer*: from the SIGKILL to the answer to a call that a node made at the moment of the SIGKILL.\n\
         * *the paper*: recovery alone in the paper, on another computer."
}

fn line(row: &Row) -> String {
    let alone = row.spread(|ours, _| ours.gate_open - ours.port_open);
    let alone_limit = row.spread(|_, limit| limit.injection);
    let whole = row.spread(|ours, _| ours.gate_open);
    let whole_limit = row.spread(|_, limit| limit.total());
    let paper = PAPER.iter().find(|(nodes, _)| *nodes == row.nodes);
    let cells = [
        row.nodes.to_string(),
        row.spread(|ours, _| ours.detected).cell(),
        row.spread(|ours, _| ours.port_open).cell(),
        alone.cell(),
        alone_limit.cell(),
        format!("{:.2}", alone.median / alone_limit.median),
        whole.cell(),
        whole_limit.cell(),
        format!("{:.2}", whole.median / whole_limit.median),
        row.spread(|ours, _| ours.answered).cell(),
        paper.map_or_else(String::new, |(_, ms)| ms.to_string()),
    ];
    format!("| {} |\n", cells.join(" | "))
}
