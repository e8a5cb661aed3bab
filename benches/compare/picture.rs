//! Draws the picture: bars to the right are better than the bare rosmaster, bars to the left are worse.

use std::fmt::Write;

use crate::{
    calls::{Cell, Seen},
    party::Kind,
};

/// The parties in the order of their bars, and their colours.
const BARS: [(Kind, &str); 4] = [
    (Kind::Core, "#c2410c"),
    (Kind::Proxy, "#fb923c"),
    (Kind::Haproxy, "#475569"),
    (Kind::Nginx, "#94a3b8"),
];
const BAR: f64 = 9.0;
const GROUP: f64 = BAR * BARS.len() as f64 + 14.0;
const LABEL: f64 = 190.0;
/// Width of a panel, and of a factor of two in it, in pixels.
const PANEL: f64 = 400.0;
const DOUBLING: f64 = 40.0;
const TOP: f64 = 78.0;

/// A panel: its title, and how to compute how many times better than the bare rosmaster a party is.
struct Panel {
    title: &'static str,
    connections: usize,
    better: fn(&Seen, &Seen) -> f64,
}

const PANELS: [Panel; 2] = [
    Panel {
        title: "one caller: how many times sooner answered (median)",
        connections: 1,
        better: |seen, bare| bare.median_ms / seen.median_ms,
    },
    Panel {
        title: "64 callers: how many times the calls a second",
        connections: 64,
        better: |seen, bare| seen.calls_per_second / bare.calls_per_second,
    },
];

/// Draws two panels of bars, for one caller and for 64.
pub(crate) fn svg(cells: &[Cell]) -> String {
    let groups = |panel: &Panel| {
        let wanted = panel.connections;
        cells.iter().filter(move |cell| cell.connections == wanted)
    };
    let most = PANELS.iter().map(|panel| groups(panel).count()).max();
    let bottom = TOP + most.unwrap_or_default() as f64 * GROUP;
    let (width, height) = (2.0 * (LABEL + PANEL) + 20.0, bottom + 30.0);
    let mut text = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" \
         font-family=\"sans-serif\" font-size=\"12\">\n<rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>\n"
    );
    for (place, (kind, colour)) in BARS.iter().enumerate() {
        let x = LABEL + place as f64 * 150.0;
        let _ = writeln!(
            text,
            "<rect x=\"{x}\" y=\"14\" width=\"12\" height=\"12\" fill=\"{colour}\"/>\
             <text x=\"{}\" y=\"24\">{kind}</text>",
            x + 18.0
        );
    }
    let _ = writeln!(
        text,
        "<text x=\"{LABEL}\" y=\"{}\" fill=\"#555\">1: bare rosmaster; to the right is better</text>",
        bottom + 18.0
    );
    for (place, panel) in PANELS.iter().enumerate() {
        let left = LABEL + place as f64 * (LABEL + PANEL);
        draw(&mut text, panel, left, bottom);
        for (row, cell) in groups(panel).enumerate() {
            group(&mut text, panel, cell, left, TOP + row as f64 * GROUP);
        }
    }
    text + "</svg>\n"
}

/// The position of a ratio on the logarithmic axis, where the bare rosmaster is at a third of the width.
fn place(left: f64, ratio: f64) -> f64 {
    let zero = left + PANEL / 3.0;
    (zero + ratio.log2() * DOUBLING).clamp(left, left + PANEL)
}

fn draw(text: &mut String, panel: &Panel, left: f64, bottom: f64) {
    let _ = writeln!(
        text,
        "<text x=\"{left}\" y=\"50\" font-weight=\"bold\">{}</text>",
        panel.title
    );
    for power in -3..=6 {
        let ratio = 2_f64.powi(power);
        let x = place(left, ratio);
        let colour = if power == 0 { "#000" } else { "#ddd" };
        let label = match power {
            ..0 => format!("1/{}", 1.0 / ratio),
            _ => format!("{ratio}"),
        };
        let _ = writeln!(
            text,
            "<line x1=\"{x}\" x2=\"{x}\" y1=\"{}\" y2=\"{bottom}\" stroke=\"{colour}\"/>\
             <text x=\"{x}\" y=\"66\" text-anchor=\"middle\" fill=\"#555\">{label}</text>",
            TOP - 6.0
        );
    }
}

fn group(text: &mut String, panel: &Panel, cell: &Cell, left: f64, top: f64) {
    let _ = writeln!(
        text,
        "<text x=\"{}\" y=\"{}\" text-anchor=\"end\">{}</text>",
        left - 8.0,
        top + GROUP / 2.0 - 3.0,
        cell.call
    );
    for (row, (kind, colour)) in BARS.iter().enumerate() {
        let ratio = (panel.better)(cell.of(*kind), cell.of(Kind::Bare));
        let (from, to) = (place(left, 1.0), place(left, ratio));
        let _ = writeln!(
            text,
            "<rect x=\"{:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{}\" fill=\"{colour}\">\
             <title>{kind}: {ratio:.2}</title></rect>",
            from.min(to),
            top + row as f64 * BAR,
            (to - from).abs(),
            BAR - 1.0
        );
    }
}
