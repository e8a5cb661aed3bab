// Places the boxes and lines of a graph, from left to right. A worker: the page must not wait for a large graph.

import dagre, { Graph } from "/dagre.js";

/** Between the parts of the graph that no line connects, in pixels. */
const GAP = 24;
/** Around the boxes of a namespace, and for its name above them. dagre leaves `nodesep` and twice `edgesep` between two. */
const PAD = 8;
const HEAD = 20;
/** A graph with more boxes is laid out with a faster heuristic. */
const LARGE = 120;

/** The parts of the graph that neither a line nor a namespace connects. */
function split({ boxes, lines, groups }) {
  const root = Array.from({ length: boxes.length + groups }, (_, index) => index);
  const find = (index) => {
    while (root[index] !== index) index = root[index] = root[root[index]];
    return index;
  };
  for (const { from, to } of lines) root[find(from)] = find(to);
  boxes.forEach(({ group }, index) => {
    if (group >= 0) root[find(index)] = find(boxes.length + group);
  });
  const parts = new Map();
  boxes.forEach((_, index) => {
    const key = find(index);
    if (!parts.has(key)) parts.set(key, { boxes: [], lines: [] });
    parts.get(key).boxes.push(index);
  });
  lines.forEach(({ from }, index) => parts.get(find(from)).lines.push(index));
  return [...parts.values()];
}

/** The boxes and lines of one part, from left to right, as dagre has them. */
function arrange(graph, part, groups, options) {
  const drawn = new Graph({ compound: groups.size > 0 });
  // A robot has loops of control: "greedy" turns few lines round, which keeps the picture small. "tight-tree" is up to four
  // times faster than the default, and no larger.
  drawn.setGraph({ rankdir: "LR", nodesep: 12, edgesep: 12, ranksep: 38, acyclicer: "greedy", ranker: "tight-tree" });
  for (const group of groups) drawn.setNode(`group ${group}`, {});
  for (const index of part.boxes) {
    const { width, height, group } = graph.boxes[index];
    drawn.setNode(String(index), { width, height });
    if (groups.has(group)) drawn.setParent(String(index), `group ${group}`);
  }
  for (const index of part.lines) {
    const { from, to } = graph.lines[index];
    drawn.setEdge(String(from), String(to), { index });
  }
  dagre.layout(drawn, options);
  return drawn;
}

/**
 * The order of boxes from top to bottom, for dagre's `customOrder`: that of `flat`, the picture without namespaces, but each
 * namespace in one piece. dagre's own order fails for some graphs with namespaces (3.1.3: "Not possible to find intersection").
 */
function orderLike(flat, groups) {
  const average = (numbers) => numbers.reduce((sum, number) => sum + number, 0) / numbers.length;
  return (drawn) => {
    const isGroup = (name) => groups.has(Number(name.split(" ")[1]));
    const middle = new Map([...groups].map((group) => {
      const boxes = drawn.children(`group ${group}`).filter((name) => flat.hasNode(name));
      return [`group ${group}`, average(boxes.map((name) => flat.node(name).y))];
    }));
    const ranks = new Map();
    for (const name of drawn.nodes()) {
      const node = drawn.node(name);
      // Namespaces have a range of ranks instead.
      if (node.rank === undefined || isGroup(name)) continue;
      // Of a line, each rank that it crosses has a part.
      const ends = node.edgeObj && [flat.node(node.edgeObj.v), flat.node(node.edgeObj.w)];
      const own = flat.hasNode(name) ? flat.node(name).y : ends ? average(ends.map(({ y }) => y)) : 0;
      const side = { borderLeft: -1, borderRight: 1 }[node.borderType] ?? 0;
      const parent = drawn.parent(name);
      const block = middle.has(parent) ? middle.get(parent) : own;
      if (!ranks.has(node.rank)) ranks.set(node.rank, []);
      ranks.get(node.rank).push({ node, block, parent: middle.has(parent) ? parent : "", side, own });
    }
    for (const rank of ranks.values()) {
      rank.sort((a, b) => a.block - b.block || (a.parent < b.parent ? -1 : a.parent > b.parent ? 1 : 0) || a.side - b.side || a.own - b.own);
      rank.forEach(({ node }, order) => { node.order = order; });
    }
  };
}

/** One part: its top left corner, its size, and where its boxes, lines and namespaces are. */
function place(graph, part) {
  const groups = new Set(part.boxes.map((index) => graph.boxes[index].group).filter((group) => group >= 0));
  const flat = arrange(graph, part, new Set(), { disableOptimalOrderHeuristic: graph.boxes.length > LARGE });
  const drawn = groups.size ? arrange(graph, part, groups, { customOrder: orderLike(flat, groups) }) : flat;
  const boxes = new Map(part.boxes.map((index) => [index, drawn.node(String(index))]));
  const lines = new Map(drawn.edges().map((edge) => drawn.edge(edge)).map(({ index, points }) => [index, points]));
  const frames = new Map([...groups].map((group) => [group, enclose(part.boxes.filter((index) => graph.boxes[index].group === group).map((index) => boxes.get(index)))]));
  return { boxes, lines, frames, ...bounds([...boxes.values(), ...frames.values(), ...[...lines.values()].flat()]) };
}

/** The top left corner and the size of what `items`, with their middles, cover. */
function bounds(items) {
  const half = (length = 0) => length / 2;
  const left = Math.min(...items.map(({ x, width }) => x - half(width)));
  const top = Math.min(...items.map(({ y, height }) => y - half(height)));
  const width = Math.max(...items.map((item) => item.x + half(item.width))) - left;
  return { left, top, width, height: Math.max(...items.map((item) => item.y + half(item.height))) - top };
}

/** The frame around the boxes of a namespace. */
function enclose(boxes) {
  const { left, top, width, height } = bounds(boxes);
  return { x: left + width / 2, y: top + (height + PAD - HEAD) / 2, width: width + 2 * PAD, height: height + PAD + HEAD };
}

/** All parts in rows, the largest first. */
onmessage = ({ data: graph }) => {
  const parts = split(graph).map((part) => place(graph, part));
  parts.sort((a, b) => b.height - a.height || b.width - a.width);
  const limit = Math.max(graph.width, ...parts.map((part) => part.width));
  const packed = { width: 0, height: 0, boxes: [], lines: [], frames: [] };
  let [x, y, row] = [0, 0, 0];
  for (const part of parts) {
    if (x > 0 && x + part.width > limit) [x, y, row] = [0, y + row + GAP, 0];
    const move = (item) => ({ ...item, x: item.x + x - part.left, y: item.y + y - part.top });
    for (const [index, box] of part.boxes) packed.boxes[index] = move(box);
    for (const [index, frame] of part.frames) packed.frames[index] = move(frame);
    for (const [index, points] of part.lines) packed.lines[index] = points.map(move);
    row = Math.max(row, part.height);
    packed.width = Math.max(packed.width, x + part.width);
    packed.height = Math.max(packed.height, y + part.height);
    x += part.width + GAP;
  }
  postMessage(packed);
};
