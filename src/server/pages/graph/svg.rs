//! A graph as SVG. Colours are attributes, which the page's style sheet overrides.

use std::{borrow::Cow, fmt::Write};

use super::{
    Graph, Shape,
    layout::{self, Placed, Point, Size},
};
use crate::health::Health;

/// Width of a character, as all fonts of one width have it at 12 px.
const CHARACTER: f64 = 7.25;
/// Longest label in characters; the middle of a longer name is left out.
const LABEL: usize = 36;
const MARGIN: f64 = 12.0;

/// A picture with a sentence in it.
pub(super) fn message(text: &str) -> String {
    let width = CHARACTER * text.chars().count() as f64 + 4.0 * MARGIN;
    format!(
        r##"<svg xmlns="http://www.w3.org/2000/svg" class="message" viewBox="0 0 {width} 80" width="{width}" height="80" font-family="monospace" font-size="12"><text x="{}" y="44" text-anchor="middle" fill="#777">{}</text></svg>
"##,
        width / 2.0,
        escape(text)
    )
}

/// The picture of `graph`.
pub(super) fn draw(graph: &Graph) -> String {
    let labels: Vec<String> = graph
        .shapes
        .iter()
        .map(|shape| label(shape.name()))
        .collect();
    let sizes = graph.shapes.iter().zip(&labels).map(|(shape, label)| {
        let text = CHARACTER * columns(label) as f64;
        match shape {
            Shape::Node { .. } => Size {
                width: text * 1.18 + 30.0,
                height: 36.0,
            },
            Shape::Topic { .. } => Size {
                width: text + 20.0,
                height: 26.0,
            },
        }
    });
    let sizes: Vec<Size> = sizes.collect();
    let lines: Vec<_> = graph
        .links
        .iter()
        .map(|link| (link.from, link.to))
        .collect();
    let placed = layout::place(&sizes, &lines, graph.frame());
    let mut picture = String::new();
    // Writing to a string does not fail.
    let _ = write(graph, &labels, &sizes, &placed, &mut picture);
    picture
}

fn write(
    graph: &Graph,
    labels: &[String],
    sizes: &[Size],
    placed: &Placed,
    to: &mut String,
) -> std::fmt::Result {
    let (width, height) = (
        placed.size.width + 2.0 * MARGIN,
        placed.size.height + 2.0 * MARGIN,
    );
    writeln!(
        to,
        r##"<svg xmlns="http://www.w3.org/2000/svg" viewBox="{:.0} {:.0} {width:.0} {height:.0}" width="{width:.0}" height="{height:.0}" font-family="'DejaVu Sans Mono', Menlo, Consolas, monospace" font-size="12">
<defs><marker id="arrow" viewBox="0 0 8 8" refX="7.5" refY="4" markerWidth="8" markerHeight="8" markerUnits="userSpaceOnUse" orient="auto-start-reverse"><path d="M0,0.8 L8,4 L0,7.2 z" fill="#8a94a6" class="head"/></marker></defs>
<g fill="none" stroke="#8a94a6" stroke-width="1.2" class="lines">"##,
        -MARGIN, -MARGIN,
    )?;
    for (link, points) in graph.links.iter().zip(&placed.lines) {
        write!(
            to,
            r#"<path data-from="{}" data-to="{}" marker-end="url(#arrow)""#,
            link.from, link.to
        )?;
        if link.both {
            write!(to, r#" marker-start="url(#arrow)""#)?;
        }
        writeln!(to, r#" d="{}"/>"#, path(points, placed.downward))?;
    }
    writeln!(to, "</g>")?;
    for (index, shape) in graph.shapes.iter().enumerate() {
        let (Some(label), Some(Size { width, height }), Some(Point { x, y })) =
            (labels.get(index), sizes.get(index), placed.boxes.get(index))
        else {
            continue;
        };
        let (kind, class, fill, stroke) = match shape {
            Shape::Topic { .. } => ("topic", "topic", "#f3f4f6", "#8a94a6"),
            Shape::Node { health, .. } => match health {
                Health::Alive => ("node", "node alive", "#dbeafe", "#2563eb"),
                Health::Unchecked => ("node", "node unchecked", "#f3f4f6", "#6b7280"),
                Health::Unreachable => ("node", "node unreachable", "#fef3c7", "#b45309"),
                Health::Dead => ("node", "node dead", "#fee2e2", "#b91c1c"),
            },
        };
        let name = escape(shape.name());
        write!(
            to,
            r#"<g class="box {class}" data-id="{index}" data-{kind}="{name}" role="button" aria-label="{kind} {name}"><title>{name}</title>"#
        )?;
        match shape {
            Shape::Node { .. } => write!(
                to,
                r#"<ellipse cx="{x:.1}" cy="{y:.1}" rx="{:.1}" ry="{:.1}" fill="{fill}" stroke="{stroke}"/>"#,
                width / 2.0,
                height / 2.0
            )?,
            Shape::Topic { .. } => write!(
                to,
                r#"<rect x="{:.1}" y="{:.1}" width="{width:.1}" height="{height:.1}" rx="3" fill="{fill}" stroke="{stroke}"/>"#,
                x - width / 2.0,
                y - height / 2.0
            )?,
        }
        writeln!(
            to,
            r##"<text x="{x:.1}" y="{:.1}" text-anchor="middle" fill="#111827">{}</text></g>"##,
            y + 4.2,
            escape(label)
        )?;
    }
    writeln!(to, "</svg>")
}

/// Curves between straight stretches: of each pair of points the way to the next pair is a curve.
fn path(points: &[Point], downward: bool) -> String {
    let mut path = String::new();
    let mut last: Option<Point> = None;
    for (index, point) in points.iter().enumerate() {
        let Point { x, y } = point;
        // Writing to a string does not fail.
        let _ = match last {
            None => write!(path, "M{x:.1},{y:.1}"),
            Some(last) if index % 2 == 1 => {
                let (middle_x, middle_y) = ((last.x + x) / 2.0, (last.y + y) / 2.0);
                let ((ax, ay), (bx, by)) = match downward {
                    true => ((last.x, middle_y), (*x, middle_y)),
                    false => ((middle_x, last.y), (middle_x, *y)),
                };
                write!(path, " C{ax:.1},{ay:.1} {bx:.1},{by:.1} {x:.1},{y:.1}")
            }
            Some(_) => write!(path, " L{x:.1},{y:.1}"),
        };
        last = Some(*point);
    }
    path
}

/// A name that is short enough.
fn label(name: &str) -> String {
    let count = name.chars().count();
    if count <= LABEL {
        return name.to_owned();
    }
    let end: String = name.chars().skip(count - LABEL * 2 / 3).collect();
    let start: String = name.chars().take(LABEL / 3 - 1).collect();
    format!("{start}…{end}")
}

/// Widths of the characters: those of East Asia take two.
fn columns(text: &str) -> usize {
    let wide = text
        .chars()
        .filter(|character| *character >= '\u{1100}')
        .count();
    text.chars().count() + wide
}

/// Text that is safe in XML, in attributes too.
fn escape(text: &str) -> String {
    let is_allowed =
        |character: char| !character.is_control() && !matches!(character, '\u{fffe}' | '\u{ffff}');
    let text: Cow<'_, str> = match text.chars().all(is_allowed) {
        true => text.into(),
        false => text
            .replace(|character| !is_allowed(character), "\u{fffd}")
            .into(),
    };
    quick_xml::escape::escape(text).into_owned()
}
