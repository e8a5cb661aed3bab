//! Boxes in layers, with a bend of every long line in each layer that it crosses.

use super::{BOX_GAP, LAYER_GAP, Line, Placed, Point, Size};

/// Most bends. Lines beyond them are straight, over whatever is in their way.
const BENDS: usize = 6000;
/// Between two bends of a layer.
const BEND_GAP: f64 = 7.0;
/// How often each layer is moved towards its neighbours.
const ROUNDS: usize = 24;
/// How much more a line's own bends are worth than a box: long lines are to be straight.
const STIFF: f64 = 8.0;

/// A box or a bend.
#[derive(Clone, Debug, Default)]
pub(super) struct Vertex {
    layer: usize,
    half_height: f64,
    is_bend: bool,
    y: f64,
    /// Neighbours in the layer before and in the one after.
    pub(super) near: [Vec<usize>; 2],
}

#[derive(Debug, Default)]
pub(super) struct Layers {
    /// The boxes, then the bends.
    pub(super) vertices: Vec<Vertex>,
    /// Their indexes, from top to bottom.
    pub(super) layers: Vec<Vec<usize>>,
    /// The vertices of each line, from left to right, and whether it leads from right to left.
    chains: Vec<(Vec<usize>, bool)>,
}

/// A sequence of the boxes along which most lines lead (Eades, Lin, Smyth). Returns each box's place.
fn sequence(boxes: usize, lines: &[Line]) -> Vec<usize> {
    let mut degree = vec![[0_usize; 2]; boxes];
    let mut near = vec![Vec::new(); boxes];
    for (from, to) in lines {
        for (one, other, way) in [(*from, *to, 1), (*to, *from, 0)] {
            if let (Some(degree), Some(near)) = (degree.get_mut(one), near.get_mut(one)) {
                // 0: lines that come, 1: lines that go.
                if let Some(count) = degree.get_mut(way) {
                    *count += 1;
                }
                near.push((other, 1 - way));
            }
        }
    }
    let (mut first, mut last) = (0, boxes);
    let mut place = vec![None; boxes];
    for _ in 0..boxes {
        let left = degree.iter().enumerate();
        let left = left.filter(|(index, _)| place.get(*index) == Some(&None));
        // Who has no line that goes is last, who has none that comes is next; else who sends most.
        let rank = |[comes, goes]: [usize; 2]| match (comes, goes) {
            (_, 0) => (2, 0),
            (0, _) => (1, 0),
            _ => (0, goes as isize - comes as isize),
        };
        let best = left.max_by_key(|(index, of)| (rank(**of), std::cmp::Reverse(*index)));
        let Some((index, &[_, goes])) = best else {
            break;
        };
        let at = if goes == 0 {
            last -= 1;
            last
        } else {
            first += 1;
            first - 1
        };
        if let Some(place) = place.get_mut(index) {
            *place = Some(at);
        }
        for (other, way) in near.get(index).into_iter().flatten() {
            let count = degree.get_mut(*other).and_then(|of| of.get_mut(*way));
            if let Some(count) = count {
                *count = count.saturating_sub(1);
            }
        }
    }
    place.into_iter().map(Option::unwrap_or_default).collect()
}

/// The layer of each box: right of all from which lines come.
fn layers_of(boxes: usize, forward: &[Line], place: &[usize]) -> Vec<usize> {
    let mut layer = vec![0_usize; boxes];
    let at = |layer: &[usize], index: usize| layer.get(index).copied().unwrap_or_default();
    let mut by_place = forward.to_vec();
    by_place.sort_by_key(|(from, _)| at(place, *from));
    for (from, to) in &by_place {
        let least = at(&layer, *from) + 1;
        if let Some(layer) = layer.get_mut(*to) {
            *layer = least.max(*layer);
        }
    }
    // Back to the right, where that makes more lines shorter than longer.
    let mut order: Vec<usize> = (0..boxes).collect();
    order.sort_by_key(|index| std::cmp::Reverse(at(place, *index)));
    for index in order {
        let goes = forward.iter().filter(|(from, _)| *from == index);
        let nearest = goes.clone().map(|(_, to)| at(&layer, *to)).min();
        let comes = forward.iter().filter(|(_, to)| *to == index).count();
        if let (Some(nearest), true) = (nearest, goes.count() > comes)
            && let Some(layer) = layer.get_mut(index)
        {
            *layer = nearest.saturating_sub(1);
        }
    }
    layer
}

impl Layers {
    pub(super) fn new(sizes: &[Size], lines: &[Line]) -> Self {
        let place = sequence(sizes.len(), lines);
        let is_backward = |(from, to): &Line| place.get(*from) > place.get(*to);
        let forward = lines.iter().map(|line| match is_backward(line) {
            true => (line.1, line.0),
            false => *line,
        });
        let forward: Vec<Line> = forward.collect();
        let layer = layers_of(sizes.len(), &forward, &place);
        let boxes = sizes.iter().zip(&layer).map(|(size, layer)| Vertex {
            layer: *layer,
            half_height: size.height / 2.0,
            ..Vertex::default()
        });
        let mut layers = Self {
            vertices: boxes.collect(),
            ..Self::default()
        };
        for ((from, to), line) in forward.into_iter().zip(lines) {
            let chain = layers.chain(from, to);
            layers.chains.push((chain, is_backward(line)));
        }
        let count = layers.vertices.iter().map(|vertex| vertex.layer + 1).max();
        layers.layers = vec![Vec::new(); count.unwrap_or_default()];
        for (index, vertex) in layers.vertices.iter().enumerate() {
            if let Some(layer) = layers.layers.get_mut(vertex.layer) {
                layer.push(index);
            }
        }
        layers
    }

    /// The vertices of a line, with new bends in each layer between.
    fn chain(&mut self, from: usize, to: usize) -> Vec<usize> {
        let layer_of = |index: usize| self.vertices.get(index).map(|vertex| vertex.layer);
        let between = layer_of(from).unwrap_or_default() + 1..layer_of(to).unwrap_or_default();
        let mut chain = vec![from];
        let has_room = self.vertices.len() + between.len() <= BENDS;
        for layer in between.filter(|_| has_room) {
            chain.push(self.vertices.len());
            self.vertices.push(Vertex {
                layer,
                is_bend: true,
                ..Vertex::default()
            });
        }
        chain.push(to);
        if chain.len() == 2 && !has_room {
            return chain;
        }
        for pair in chain.windows(2) {
            let [left, right] = pair else { continue };
            for (index, side, other) in [(*left, 1, *right), (*right, 0, *left)] {
                let vertex = self.vertices.get_mut(index);
                if let Some(near) = vertex.and_then(|vertex| vertex.near.get_mut(side)) {
                    near.push(other);
                }
            }
        }
        chain
    }

    /// Moves every layer up and down, so that lines become short and straight; the order stays.
    pub(super) fn set_heights(&mut self) {
        let layers = self.layers.clone();
        for round in 0..ROUNDS {
            let from_left = layers.iter().map(|layer| (layer, 0));
            let ordered: Vec<_> = match round % 2 {
                0 => from_left.collect(),
                _ => layers.iter().rev().map(|layer| (layer, 1)).collect(),
            };
            // At last both sides count.
            let both = round + 2 >= ROUNDS;
            for (layer, side) in ordered {
                let wishes = layer.iter().map(|index| self.wish(*index, side, both));
                let wishes = wishes.collect::<Vec<_>>();
                let halves: Vec<_> = layer.iter().map(|index| self.space(*index)).collect();
                for (index, y) in layer.iter().zip(nearest(&wishes, &halves)) {
                    if let Some(vertex) = self.vertices.get_mut(*index) {
                        vertex.y = y;
                    }
                }
            }
        }
    }

    /// Half of the height that a vertex takes.
    fn space(&self, index: usize) -> f64 {
        self.vertices.get(index).map_or(0.0, |vertex| match vertex {
            Vertex { is_bend: true, .. } => BEND_GAP / 2.0,
            vertex => vertex.half_height + BOX_GAP / 2.0,
        })
    }

    /// Where a vertex is to be because of its neighbours, and how much that matters.
    fn wish(&self, index: usize, side: usize, both: bool) -> (f64, f64) {
        let Some(vertex) = self.vertices.get(index) else {
            return (0.0, 1.0);
        };
        let (mut sum, mut weights) = (0.0, 0.0);
        let sides = vertex.near.iter().enumerate();
        for (_, near) in sides.filter(|(of, _)| both || *of == side) {
            for other in near.iter().filter_map(|other| self.vertices.get(*other)) {
                let stiff = vertex.is_bend && other.is_bend;
                let weight = if stiff { STIFF } else { 1.0 };
                sum += weight * other.y;
                weights += weight;
            }
        }
        match weights > 0.0 {
            true => (sum / weights, weights),
            false => (vertex.y, 0.1),
        }
    }

    /// The result, moved so that it begins at the origin.
    pub(super) fn placed(&self, sizes: &[Size]) -> Placed {
        let size_of = |index: usize| sizes.get(index).copied().unwrap_or_default();
        let top = self
            .vertices
            .iter()
            .map(|vertex| vertex.y - vertex.half_height);
        let top = top.fold(f64::INFINITY, f64::min);
        let bottom = self
            .vertices
            .iter()
            .map(|vertex| vertex.y + vertex.half_height);
        let bottom = bottom.fold(f64::NEG_INFINITY, f64::max);
        let mut x = 0.0;
        let columns = self.layers.iter().map(|layer| {
            let width = layer.iter().map(|index| size_of(*index).width);
            let width = width.fold(0.0, f64::max);
            let left = x;
            x += width + LAYER_GAP;
            (left, left + width)
        });
        let columns: Vec<(f64, f64)> = columns.collect();
        let at = |index: usize| {
            let vertex = self.vertices.get(index);
            let layer = vertex.map_or(0, |vertex| vertex.layer);
            let column = columns.get(layer).copied().unwrap_or_default();
            (column, vertex.map_or(0.0, |vertex| vertex.y - top))
        };
        let boxes = (0..sizes.len()).map(|index| {
            let ((left, right), y) = at(index);
            let x = (left + right) / 2.0;
            Point { x, y }
        });
        let points = |(chain, is_backward): &(Vec<usize>, bool)| {
            let mut points = Vec::new();
            for (place, index) in chain.iter().enumerate() {
                let ((left, right), y) = at(*index);
                let (middle, half) = ((left + right) / 2.0, size_of(*index).width / 2.0);
                if place > 0 {
                    let x = if *index < sizes.len() {
                        middle - half
                    } else {
                        left
                    };
                    points.push(Point { x, y });
                }
                if place + 1 < chain.len() {
                    let x = if *index < sizes.len() {
                        middle + half
                    } else {
                        right
                    };
                    points.push(Point { x, y });
                }
            }
            if *is_backward {
                points.reverse();
            }
            points
        };
        Placed {
            boxes: boxes.collect(),
            lines: self.chains.iter().map(points).collect(),
            size: Size {
                width: (x - LAYER_GAP).max(0.0),
                height: (bottom - top).max(0.0),
            },
            downward: false,
        }
    }
}

/// The heights that are nearest to the wishes, by least squares, such that neighbours keep their order and
/// their distance: an isotonic regression of what is left without the distances.
fn nearest(wishes: &[(f64, f64)], halves: &[f64]) -> Vec<f64> {
    let mut offset = 0.0;
    let mut before = None;
    let offsets = halves.iter().map(|half| {
        offset += before
            .replace(*half)
            .map_or(0.0, |before: f64| before + half);
        offset
    });
    let offsets: Vec<f64> = offsets.collect();
    // Sum and weight of those that move together, and how many they are.
    let mut groups: Vec<(f64, f64, usize)> = Vec::new();
    for ((wish, weight), offset) in wishes.iter().zip(&offsets) {
        let mut group = ((wish - offset) * weight, *weight, 1);
        while let Some(above) = groups.pop_if(|above| above.0 / above.1 >= group.0 / group.1) {
            group = (group.0 + above.0, group.1 + above.1, group.2 + above.2);
        }
        groups.push(group);
    }
    let means = groups.into_iter();
    let means = means.flat_map(|(sum, weight, count)| std::iter::repeat_n(sum / weight, count));
    means
        .zip(offsets)
        .map(|(mean, offset)| mean + offset)
        .collect()
}
