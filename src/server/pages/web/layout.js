// Places the boxes and lines of a graph. A worker: a large graph takes seconds, and the page must not wait.

import dagre, { Graph } from "/dagre.js";

/** Between the parts of the graph that no line connects, in pixels. */
const GAP = 36;
/** A graph with more boxes is laid out once, and fast. */
const LARGE = 120;

/** The parts of the graph that no line connects. A part has `rank` 0 if one of its nodes needs attention. */
function split({ boxes, lines }) {
  const root = boxes.map((_, index) => index);
  const find = (index) => {
    while (root[index] !== index) index = root[index] = root[root[index]];
    return index;
  };
  for (const { from, to } of lines) root[find(from)] = find(to);
  const parts = new Map();
  boxes.forEach((box, index) => {
    const key = find(index);
    if (!parts.has(key)) parts.set(key, { boxes: [], lines: [], rank: 1 });
    parts.get(key).boxes.push(index);
    if (box.ill) parts.get(key).rank = 0;
  });
  lines.forEach(({ from }, index) => parts.get(find(from)).lines.push(index));
  return [...parts.values()];
}

/** One part from its top left corner, in the direction `rankdir`: its size, and where its boxes and lines are. */
function place(graph, part, rankdir) {
  const drawn = new Graph();
  // A robot has loops of control: "greedy" turns few lines round, which keeps the picture small.
  drawn.setGraph({ rankdir, nodesep: 14, edgesep: 8, ranksep: 44, acyclicer: "greedy" });
  for (const index of part.boxes) {
    const { width, height } = graph.boxes[index];
    drawn.setNode(String(index), { width, height });
  }
  for (const index of part.lines) {
    const { from, to } = graph.lines[index];
    drawn.setEdge(String(from), String(to), { index });
  }
  dagre.layout(drawn, { disableOptimalOrderHeuristic: graph.boxes.length > LARGE });
  const { width, height } = drawn.graph();
  const boxes = part.boxes.map((index) => [index, drawn.node(String(index))]);
  const lines = drawn.edges().map((edge) => drawn.edge(edge)).map(({ index, points }) => [index, points]);
  return { ...part, width, height, boxes, lines };
}

/** All parts in rows: those that need attention first, then the largest. */
function pack(graph, rankdir) {
  const parts = split(graph).map((part) => place(graph, part, rankdir));
  parts.sort((a, b) => a.rank - b.rank || b.height - a.height);
  const area = parts.reduce((sum, part) => sum + (part.width + GAP) * (part.height + GAP), 0);
  const limit = Math.max(Math.sqrt(area * graph.aspect), ...parts.map((part) => part.width));
  const packed = { width: 0, height: 0, boxes: [], lines: [] };
  let [x, y, row] = [0, 0, 0];
  for (const part of parts) {
    if (x > 0 && x + part.width > limit) [x, y, row] = [0, y + row + GAP, 0];
    const move = (point) => ({ x: point.x + x, y: point.y + y });
    for (const [index, point] of part.boxes) packed.boxes[index] = move(point);
    for (const [index, points] of part.lines) packed.lines[index] = points.map(move);
    row = Math.max(row, part.height);
    packed.width = Math.max(packed.width, x + part.width);
    packed.height = Math.max(packed.height, y + part.height);
    x += part.width + GAP;
  }
  return packed;
}

/** From left to right or from top to bottom, whichever can be shown larger. */
onmessage = ({ data }) => {
  const graph = { ...data, aspect: data.width / data.height };
  const directions = graph.boxes.length > LARGE ? [graph.aspect > 1 ? "LR" : "TB"] : ["LR", "TB"];
  const scale = ({ width, height }) => Math.min(data.width / width, data.height / height);
  const drawn = directions.map((rankdir) => pack(graph, rankdir));
  postMessage(drawn.reduce((best, next) => (scale(next) > scale(best) ? next : best)));
};
