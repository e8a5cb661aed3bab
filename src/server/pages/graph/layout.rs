//! Places boxes and lines in layers, from left to right or from top to bottom, after Sugiyama: cycles are broken, boxes get layers,
//! long lines are led around the boxes between, crossings are reduced, and what belongs together comes to one
//! height. Without IO.

mod layers;
mod order;

use self::layers::Layers;

/// Between layers; lines cross it.
const LAYER_GAP: f64 = 56.0;
/// Between the boxes of a layer.
const BOX_GAP: f64 = 14.0;
/// Between parts of the graph that are not connected.
const PART_GAP: f64 = 36.0;
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Point {
    pub(super) x: f64,
    pub(super) y: f64,
}

/// The size of a box.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Size {
    pub(super) width: f64,
    pub(super) height: f64,
}

/// A line between two boxes, by their indexes.
pub(super) type Line = (usize, usize);

/// Where everything is.
#[derive(Debug, Default)]
pub(super) struct Placed {
    /// The boxes' centres.
    pub(super) boxes: Vec<Point>,
    /// The points of each line, of which every second stretch is straight. Empty for a line from a box to
    /// itself.
    pub(super) lines: Vec<Vec<Point>>,
    pub(super) size: Size,
    /// The layers follow from top to bottom.
    pub(super) downward: bool,
}

impl Point {
    fn turned(self) -> Self {
        Self {
            x: self.y,
            y: self.x,
        }
    }
}

impl Size {
    fn turned(self) -> Self {
        Self {
            width: self.height,
            height: self.width,
        }
    }
}

/// Places boxes of these sizes, in the direction in which they can be shown larger in `frame`. Lines must lead
/// from one of them to another one.
pub(super) fn place(sizes: &[Size], lines: &[Line], frame: Size) -> Placed {
    let scale = |placed: &Placed| {
        let Size { width, height } = placed.size;
        (frame.width / width).min(frame.height / height).min(1.0)
    };
    let [across, down] = [false, true].map(|down| arrange(sizes, lines, down, frame));
    if scale(&down) > scale(&across) {
        down
    } else {
        across
    }
}

fn arrange(sizes: &[Size], lines: &[Line], downward: bool, frame: Size) -> Placed {
    let mut placed = Placed {
        downward,
        boxes: vec![Point::default(); sizes.len()],
        lines: vec![Vec::new(); lines.len()],
        size: Size::default(),
    };
    let mut parts: Vec<(Part, Placed)> = parts(sizes.len(), lines)
        .into_iter()
        .map(|part| {
            let drawn = part.draw(sizes, lines, downward);
            (part, drawn)
        })
        .collect();
    // Large ones first; of equal ones in the order of their boxes.
    parts.sort_by(|(_, a), (_, b)| b.size.height.total_cmp(&a.size.height));
    let area = |size: Size| (size.width + PART_GAP) * (size.height + PART_GAP);
    let total: f64 = parts.iter().map(|(_, drawn)| area(drawn.size)).sum();
    let widest = parts.iter().map(|(_, drawn)| drawn.size.width);
    let limit = widest.fold((total * frame.width / frame.height).sqrt(), f64::max);
    let (mut at, mut row) = (Point::default(), 0.0_f64);
    for (part, drawn) in parts {
        if at.x > 0.0 && at.x + drawn.size.width > limit {
            at = Point {
                x: 0.0,
                y: at.y + row + PART_GAP,
            };
            row = 0.0;
        }
        let move_there = |point: Point| Point {
            x: point.x + at.x,
            y: point.y + at.y,
        };
        for (index, point) in part.boxes.iter().zip(drawn.boxes) {
            if let Some(to) = placed.boxes.get_mut(*index) {
                *to = move_there(point);
            }
        }
        for (index, points) in part.lines.iter().zip(drawn.lines) {
            if let Some(to) = placed.lines.get_mut(*index) {
                *to = points.into_iter().map(move_there).collect();
            }
        }
        row = row.max(drawn.size.height);
        placed.size.width = placed.size.width.max(at.x + drawn.size.width);
        placed.size.height = placed.size.height.max(at.y + drawn.size.height);
        at.x += drawn.size.width + PART_GAP;
    }
    placed
}

/// Boxes that are connected, and the lines between them.
#[derive(Default)]
struct Part {
    boxes: Vec<usize>,
    lines: Vec<usize>,
}

fn parts(boxes: usize, lines: &[Line]) -> Vec<Part> {
    let mut near = vec![Vec::new(); boxes];
    for (from, to) in lines {
        for (one, other) in [(from, to), (to, from)] {
            if let Some(near) = near.get_mut(*one) {
                near.push(*other);
            }
        }
    }
    let mut part_of = vec![None; boxes];
    let mut parts: Vec<Part> = Vec::new();
    for first in 0..boxes {
        let mut reached = vec![first];
        let number = parts.len();
        while let Some(index) = reached.pop() {
            if let Some(part @ None) = part_of.get_mut(index) {
                *part = Some(number);
                reached.extend(near.get(index).into_iter().flatten());
            }
        }
        if part_of.get(first) == Some(&Some(number)) {
            parts.push(Part::default());
        }
    }
    let number_of = |index: usize| part_of.get(index).copied().flatten();
    for index in 0..boxes {
        if let Some(part) = number_of(index).and_then(|number| parts.get_mut(number)) {
            part.boxes.push(index);
        }
    }
    for (index, (from, _)) in lines.iter().enumerate() {
        if let Some(part) = number_of(*from).and_then(|number| parts.get_mut(number)) {
            part.lines.push(index);
        }
    }
    parts
}

impl Part {
    fn draw(&self, sizes: &[Size], lines: &[Line], downward: bool) -> Placed {
        let size_of = |index: &usize| {
            let size = sizes.get(*index).copied().unwrap_or_default();
            if downward { size.turned() } else { size }
        };
        let sizes: Vec<_> = self.boxes.iter().map(size_of).collect();
        let own = |index: usize| self.boxes.binary_search(&index).unwrap_or_default();
        let lines = self.lines.iter().filter_map(|line| lines.get(*line));
        let lines: Vec<_> = lines.map(|(from, to)| (own(*from), own(*to))).collect();
        let mut layers = Layers::new(&sizes, &lines);
        order::reduce_crossings(&mut layers);
        layers.set_heights();
        let mut placed = layers.placed(&sizes);
        if downward {
            let lines = placed.lines.iter_mut().flatten();
            for point in placed.boxes.iter_mut().chain(lines) {
                *point = point.turned();
            }
            placed.size = placed.size.turned();
        }
        placed
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;

    const SIZE: Size = Size {
        width: 100.0,
        height: 30.0,
    };
    const WIDE: Size = Size {
        width: 1e6,
        height: 1e3,
    };

    /// Repeatable numbers.
    fn dice() -> impl FnMut(usize) -> usize {
        let mut state: u64 = 1;
        move |below| {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as usize % below
        }
    }

    fn assert_readable(boxes: usize, placed: &Placed) {
        for a in 0..boxes {
            let Point { x, y } = placed.boxes[a];
            let inside = |at: f64, length: f64, whole: f64| {
                at - length / 2.0 > -0.01 && at + length / 2.0 < whole + 0.01
            };
            assert!(inside(x, SIZE.width, placed.size.width));
            assert!(inside(y, SIZE.height, placed.size.height));
            for b in 0..a {
                let other = placed.boxes[b];
                let apart = (x - other.x).abs() >= SIZE.width || (y - other.y).abs() >= SIZE.height;
                assert!(apart, "{a} and {b} overlap");
            }
        }
    }

    #[test]
    fn a_chain_is_a_straight_line_from_left_to_right() {
        let placed = place(&[SIZE; 4], &[(2, 0), (0, 3), (3, 1)], WIDE);
        let x = |index: usize| placed.boxes[index].x;
        assert!(x(2) < x(0) && x(0) < x(3) && x(3) < x(1));
        assert!(
            placed
                .boxes
                .iter()
                .all(|point| point.y == SIZE.height / 2.0)
        );
        assert_eq!(placed.lines[0].len(), 2);
    }

    #[test]
    fn boxes_do_not_overlap_and_every_line_has_its_two_ends() {
        let mut roll = dice();
        for boxes in 1..60 {
            let ends = (0..boxes * 2).map(|_| (roll(boxes), roll(boxes)));
            let lines: Vec<Line> = ends.filter(|(from, to)| from != to).collect();
            let placed = arrange(&vec![SIZE; boxes], &lines, false, WIDE);
            assert_readable(boxes, &placed);
            for ((from, to), points) in lines.iter().zip(&placed.lines) {
                for (end, index) in [(points[0], from), (points[points.len() - 1], to)] {
                    let of = placed.boxes[*index];
                    assert_eq!(((end.x - of.x).abs(), end.y), (SIZE.width / 2.0, of.y));
                }
            }
        }
    }

    #[test]
    fn lines_without_need_do_not_cross() {
        // Two stars whose boxes are given in turns.
        let lines: Vec<Line> = (2..22).map(|index| (index % 2, index)).collect();
        let lines = [lines, vec![(0, 22), (1, 22)]].concat();
        let placed = arrange(&[SIZE; 23], &lines, false, WIDE);
        let y = |index: usize| placed.boxes[index].y;
        let above = y(0) < y(1);
        for (a, b) in (2..22)
            .step_by(2)
            .flat_map(|a| (3..22).step_by(2).map(move |b| (a, b)))
        {
            assert_eq!(y(a) < y(b), above, "{a} {b}");
        }
    }

    #[test]
    fn a_ring_of_all_the_boxes_that_are_drawn_takes_no_time() {
        let start = Instant::now();
        let ring = |count: usize| (0..count).map(move |index| (index, (index + 1) % count));
        let mut roll = dice();
        let lines: Vec<Line> = ring(400)
            .chain((0..1200).map(|_| (roll(400), roll(400))))
            .filter(|(from, to)| from != to)
            .collect();
        let placed = place(&[SIZE; 400], &lines, WIDE);
        assert_readable(400, &placed);
        // Seconds are for a loaded computer and a build that is not optimized: otherwise it is 0.05 s.
        assert!(start.elapsed().as_secs() < 10, "{:?}", start.elapsed());
    }

    #[test]
    fn a_chain_in_a_narrow_frame_leads_downward() {
        let narrow = Size {
            width: 200.0,
            height: 600.0,
        };
        let placed = place(&[SIZE; 4], &[(2, 0), (0, 3), (3, 1)], narrow);
        assert!(placed.downward && placed.size.height > placed.size.width);
        assert_readable(4, &placed);
        let ends = [placed.lines[0][0], placed.lines[0][1]];
        assert!(ends[0].x == ends[1].x && ends[0].y < ends[1].y);
    }
}
