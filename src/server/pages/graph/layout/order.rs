//! Fewer crossings: each layer is sorted by where its neighbours are, to and fro.

use super::layers::Layers;

/// Times that all layers are sorted. More hardly change anything.
const ROUNDS: usize = 20;

/// Sorts the layers such that few lines cross.
pub(super) fn reduce_crossings(layers: &mut Layers) {
    let mut places = places(layers);
    let mut best = (crossings(layers, &places), layers.layers.clone());
    for round in 0..ROUNDS {
        if best.0 == 0 {
            break;
        }
        let side = round % 2;
        let mut order: Vec<usize> = (0..layers.layers.len()).collect();
        if side == 1 {
            order.reverse();
        }
        for at in order {
            let Some(mut layer) = layers.layers.get(at).cloned() else {
                continue;
            };
            let mean = |index: &usize| {
                let near = layers.vertices.get(*index);
                let near = near.and_then(|vertex| vertex.near.get(side));
                let near = near.map_or(&[][..], Vec::as_slice);
                let sum: f64 = near.iter().filter_map(|other| places.get(*other)).sum();
                match near.len() {
                    0 => places.get(*index).copied().unwrap_or_default(),
                    count => sum / count as f64,
                }
            };
            layer.sort_by(|a, b| mean(a).total_cmp(&mean(b)));
            number(&layer, &mut places);
            if let Some(sorted) = layers.layers.get_mut(at) {
                *sorted = layer;
            }
        }
        let found = crossings(layers, &places);
        if found < best.0 {
            best = (found, layers.layers.clone());
        }
    }
    layers.layers = best.1;
}

/// Sets the places of a layer's vertices: its middle is 0.5, so that layers of different lengths compare.
fn number(layer: &[usize], places: &mut [f64]) {
    for (place, index) in layer.iter().enumerate() {
        if let Some(to) = places.get_mut(*index) {
            *to = (place as f64 + 0.5) / layer.len() as f64;
        }
    }
}

fn places(layers: &Layers) -> Vec<f64> {
    let mut places = vec![0.0; layers.vertices.len()];
    for layer in &layers.layers {
        number(layer, &mut places);
    }
    places
}

/// How many pairs of lines between neighbouring layers cross.
fn crossings(layers: &Layers, places: &[f64]) -> usize {
    let mut count = 0;
    for layer in &layers.layers {
        // Where the lines end, in the order in which they begin.
        let mut ends: Vec<f64> = Vec::new();
        for index in layer {
            let Some([_, near]) = layers.vertices.get(*index).map(|vertex| &vertex.near) else {
                continue;
            };
            let near = near.iter();
            let mut own: Vec<f64> = near.filter_map(|to| places.get(*to).copied()).collect();
            own.sort_by(f64::total_cmp);
            ends.extend(own);
        }
        count += inversions(&mut ends);
    }
    count
}

/// How many pairs are in the wrong order. Sorts them.
fn inversions(ends: &mut [f64]) -> usize {
    if ends.len() < 2 {
        return 0;
    }
    let (left, right) = ends.split_at_mut(ends.len() / 2);
    let mut count = inversions(left) + inversions(right);
    let mut bigger = left.iter().peekable();
    let mut rest = left.len();
    for end in right.iter() {
        while bigger.next_if(|of| *of <= end).is_some() {
            rest -= 1;
        }
        count += rest;
    }
    ends.sort_by(f64::total_cmp);
    count
}
