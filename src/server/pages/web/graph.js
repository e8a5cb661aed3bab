// The graph: what is in it, and its picture. Boxes are nodes, folded namespaces and, on request, topics.

const SVG = "http://www.w3.org/2000/svg";
/** Longest label in characters: a longer name loses its middle. */
const LABEL = 28;
const MARGIN = 12;
/** A namespace with more nodes than this is shown as the namespaces in it. */
const LARGE = 20;
/** With more nodes than this, namespaces are folded until they are opened by hand. */
const FOLDED = 60;
/** Most boxes and lines that are laid out. 400 boxes take about 2 s in the worker. */
const BOXES = 400;
const LINES = 2000;
/** Longest time for a layout, in milliseconds. */
const PATIENCE = 20000;

/** Topics that connect nearly every node with nearly every other, in any namespace. */
const SHARED = ["rosout", "rosout_agg", "tf", "tf_static", "diagnostics", "clock", "statistics"];
/** A topic with more pairs of publisher and subscriber is left out like those. */
const PAIRS = 100;
const TOOLS = ["/rosout", "/rqt_", "/rviz", "/rosapi", "/rosbridge", "/record_", "/rostopic_"];
const isTool = (name) => TOOLS.some((tool) => name.startsWith(tool));

/** The worst first. */
const HEALTH = ["dead", "unreachable", "unchecked", "registered", "alive"];
const worst = (a, b) => (HEALTH.indexOf(a) <= HEALTH.indexOf(b) ? a : b);

/** The nodes to show, without tools unless `everything` is wanted. */
export const nodesOf = (robot, everything) => robot.nodes.filter((node) => everything || !isTool(node.name));

/** For each name the namespace in which it is shown; an empty one if it shares none with others. */
export function namespaces(names) {
  const found = new Map();
  const split = (list, above) => {
    const parts = new Map();
    for (const name of list) {
      const end = name.indexOf("/", above.length + 1);
      const part = end < 0 ? above : name.slice(0, end);
      parts.set(part, [...(parts.get(part) ?? []), name]);
    }
    for (const [part, inside] of parts) {
      if (part !== above && inside.length > LARGE) split(inside, part);
      else for (const name of inside) found.set(name, inside.length > 1 ? part : above);
    }
  };
  split(names, "");
  return found;
}

/** Which nodes publish and subscribe each topic. A dead node keeps what it had. */
function topicsOf(nodes) {
  const topics = new Map();
  const topic = (name) => topics.get(name) ?? topics.set(name, { from: [], to: [] }).get(name);
  for (const node of nodes) {
    for (const name of node.publishes) topic(name).from.push(node.name);
    for (const name of node.subscribes) topic(name).to.push(node.name);
  }
  return topics;
}

/**
 * The boxes and lines to draw. `changed` has what to mark. `focus`, as in `["node", "/a"]`, keeps one node or topic and its
 * neighbours, `filter` those whose names contain it and their neighbours. `topics` draws topics as boxes, `everything` adds tools
 * and what is `left` out otherwise. `folds` says for a namespace whether it is folded.
 */
export function select(robot, changed, { filter, focus, topics: withTopics, everything, folds }) {
  const nodes = nodesOf(robot, everything);
  const spaces = namespaces(nodes.map((node) => node.name));
  const text = filter.toLowerCase();
  const matches = (kind, name) => (focus ? focus[0] === kind && focus[1] === name : name.toLowerCase().includes(text));
  const isFolded = (space) => space && (folds.get(space) ?? (nodes.length > FOLDED && !focus && !text));

  const [boxes, places, lines, left] = [[], new Map(), new Map(), []];
  const box = (key, make) => {
    if (!places.has(key)) places.set(key, boxes.push({ key, ...make() }) - 1);
    return places.get(key);
  };
  const rows = new Map(nodes.map((node) => [node.name, node]));
  const nodeBox = (name) => {
    const [space, { health }] = [spaces.get(name), rows.get(name)];
    const isChanged = changed.has(`node ${name}`);
    if (!isFolded(space)) return box(`node ${name}`, () => ({ kind: "node", name, space, health, changed: isChanged }));
    const at = box(`space ${space}`, () => ({ kind: "space", name: space, space: "", health, changed: false, nodes: new Set() }));
    boxes[at].nodes.add(name);
    boxes[at].health = worst(boxes[at].health, health);
    boxes[at].changed ||= isChanged;
    return at;
  };
  /** One line between two boxes, whatever it stands for. */
  const line = (from, to, topic, isChanged) => {
    if (from === to) return;
    const back = lines.get(`${to} ${from}`);
    const one = back ?? lines.get(`${from} ${to}`) ?? { from, to, topics: new Set(), changed: false, both: false };
    if (!back) lines.set(`${from} ${to}`, one);
    one.both ||= Boolean(back);
    one.topics.add(topic);
    one.changed ||= isChanged;
  };

  for (const { name } of nodes) if (matches("node", name)) nodeBox(name);
  for (const [topic, { from, to }] of topicsOf(nodes)) {
    const isShared = SHARED.includes(topic.split("/").at(-1)) || from.length * to.length > PAIRS;
    const isConnected = from.length && to.length;
    const isNamed = Boolean(text || focus) && matches("topic", topic);
    if (!everything && !isNamed && (isShared || isTool(topic) || !isConnected)) {
      if (isShared && isConnected) left.push(topic);
      continue;
    }
    const isMarked = (name) => changed.has(`line ${name} ${topic}`);
    if (withTopics || (focus && isNamed)) {
      const wanted = (name) => isNamed || matches("node", name);
      const place = () => box(`topic ${topic}`, () => ({ kind: "topic", name: topic, space: "", changed: changed.has(`topic ${topic}`) }));
      for (const name of from.filter(wanted)) line(nodeBox(name), place(), topic, isMarked(name));
      for (const name of to.filter(wanted)) line(place(), nodeBox(name), topic, isMarked(name));
    } else {
      for (const a of from) {
        for (const b of to) {
          const wanted = a !== b && (isNamed || matches("node", a) || matches("node", b));
          if (wanted) line(nodeBox(a), nodeBox(b), topic, isMarked(a) || isMarked(b));
        }
      }
    }
  }
  // A topic between the nodes of one namespace is in its frame.
  for (const [key, at] of places) {
    if (!key.startsWith("topic ")) continue;
    const ends = [...lines.values()].filter(({ from, to }) => from === at || to === at).map(({ from, to }) => boxes[from === at ? to : from]);
    if (ends.length && ends.every(({ space }) => space === ends[0].space)) boxes[at].space = ends[0].space;
  }
  // A namespace around a single box is only in the way.
  const counts = new Map();
  for (const { space } of boxes) if (space) counts.set(space, (counts.get(space) ?? 0) + 1);
  const drawn = [...counts.keys()].filter((space) => counts.get(space) > 1);
  for (const one of boxes) one.group = drawn.indexOf(one.space);
  return { boxes, lines: [...lines.values()], groups: drawn, left: left.sort() };
}

const ruler = document.createElement("canvas").getContext("2d");
const FONT = '12px ui-monospace, "DejaVu Sans Mono", Menlo, Consolas, monospace';

function label(name) {
  const letters = [...name];
  if (letters.length <= LABEL) return name;
  return [...letters.slice(0, LABEL / 2 - 1), "…", ...letters.slice(-LABEL / 2)].join("");
}

/** Gives each box its label and its size, which does not depend on its health. */
export function measure(graph) {
  ruler.font = FONT;
  for (const box of graph.boxes) {
    const isInside = box.group >= 0 && box.name.startsWith(`${box.space}/`);
    const name = isInside ? box.name.slice(box.space.length + 1) : box.name;
    box.label = box.kind === "space" ? `▸ ${label(name)} (${box.nodes.size})` : label(name);
    // Ill nodes have bold letters.
    [box.width, box.height] = [ruler.measureText(box.label).width * 1.06 + 18, box.kind === "topic" ? 22 : 28];
  }
  return graph;
}

/** What the layout of a graph depends on, as text. */
export const shapeOf = ({ boxes, lines, groups }) =>
  JSON.stringify([boxes.map((box) => [box.key, box.label, box.group]), lines.map(({ from, to }) => [from, to]), groups]);

let worker = null;
/** Ends the layout under way with a reason. */
let fail = null;

/** Gives up the layout under way, if there is one. */
export function abandon() {
  fail?.("abandoned");
}

/**
 * Where the boxes and lines of `graph` are on a screen of this width. One layout at a time. Throws the reason if there is no such
 * picture.
 */
export function layOut({ boxes, lines, groups }, width) {
  if (!boxes.length) throw new Error("nothing to show");
  if (boxes.length > BOXES || lines.length > LINES) {
    throw new Error(`${boxes.length} boxes and ${lines.length} lines are too many to read: choose a node in the overview, or filter by a part of a name`);
  }
  return new Promise((resolve, reject) => {
    worker ??= new Worker("/layout.js", { type: "module" });
    const begun = performance.now();
    fail = (reason) => {
      clearTimeout(timer);
      worker.terminate();
      worker = fail = null;
      reject(new Error(reason));
    };
    const timer = setTimeout(fail, PATIENCE, "this graph is too large to draw: filter by a part of a name");
    worker.onmessage = ({ data }) => {
      clearTimeout(timer);
      fail = null;
      performance.measure("layout", { start: begun });
      resolve(data);
    };
    worker.onerror = () => fail?.("this browser cannot draw the graph; the lists below show the same");
    worker.postMessage({
      boxes: boxes.map(({ width, height, group }) => ({ width, height, group })),
      lines: lines.map(({ from, to }) => ({ from, to })),
      groups: groups.length,
      width: width - 2 * MARGIN,
    });
  });
}

function shape(tag, attributes, ...children) {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

/** The point at the edge of `box`, which is centred at `at`, on the way to `point`. */
function edge(box, at, point) {
  const [dx, dy] = [point.x - at.x, point.y - at.y];
  const far = Math.max(Math.abs(dx) / (box.width / 2), Math.abs(dy) / (box.height / 2));
  return far > 1 ? { x: at.x + dx / far, y: at.y + dy / far } : at;
}

/** A smooth line through the middles between `points`. */
function curve(points) {
  const text = ({ x, y }) => `${x.toFixed(1)},${y.toFixed(1)}`;
  const middle = (a, b) => ({ x: (a.x + b.x) / 2, y: (a.y + b.y) / 2 });
  const bends = points.slice(1, -1).map((point, index) => {
    const isLast = index === points.length - 3;
    return `Q${text(point)} ${text(isLast ? points.at(-1) : middle(point, points[index + 2]))}`;
  });
  return `M${text(points[0])} ${bends.length ? bends.join(" ") : `L${text(points.at(-1))}`}`;
}

/** The picture of a graph, with its boxes and lines where `placed` has them. */
export function draw(graph, placed) {
  const lines = graph.lines.map(({ from, to, both }, index) => {
    const points = [...placed.lines[index]];
    points[0] = edge(graph.boxes[from], placed.boxes[from], points[1]);
    points[points.length - 1] = edge(graph.boxes[to], placed.boxes[to], points.at(-2));
    const arrows = { "marker-end": "url(#arrow)", ...(both && { "marker-start": "url(#arrow)" }) };
    const way = curve(points);
    // The second path is wide enough for a pointer.
    return shape("g", { class: "line", "data-from": from, "data-to": to },
      shape("path", { d: way, ...arrows }), shape("path", { d: way, class: "reach" }), shape("title", {}));
  });
  const boxes = graph.boxes.map(({ key, kind, name, label, width, height }, index) => {
    const { x, y } = placed.boxes[index];
    return shape("g", { class: "box", "data-key": key, "data-id": index, [`data-${kind}`]: name, role: "button", tabindex: -1 },
      shape("title", {}),
      shape("rect", { x: x - width / 2, y: y - height / 2, width, height, rx: kind === "topic" ? 0 : 8 }),
      shape("text", { x, y: y + 4, "text-anchor": "middle" }, label));
  });
  const groups = placed.frames.map(({ x: middle, y: centre, width, height }, index) => {
    const [name, x, y] = [graph.groups[index], middle - width / 2, centre - height / 2];
    return shape("g", { class: "group" },
      shape("rect", { x, y, width, height, rx: 8 }),
      shape("g", { class: "fold", "data-fold": name, role: "button", tabindex: -1, "aria-expanded": true, "aria-label": `namespace ${name}` },
        shape("title", {}, `fold ${name}`), shape("text", { x: x + 8, y: y + 14 }, `▾ ${label(name)}`)));
  });
  const arrow = shape("marker", { id: "arrow", viewBox: "0 0 8 8", refX: 7.5, refY: 4, markerWidth: 8, markerHeight: 8, markerUnits: "userSpaceOnUse", orient: "auto-start-reverse" },
    shape("path", { d: "M0,0.8 L8,4 L0,7.2 z", class: "head" }));
  const [width, height] = [placed.width + 2 * MARGIN, placed.height + 2 * MARGIN].map(Math.ceil);
  const svg = shape("svg", { viewBox: `${-MARGIN} ${-MARGIN} ${width} ${height}`, width, height },
    shape("defs", {}, arrow), ...groups, shape("g", { class: "lines" }, ...lines), ...boxes);
  dress(svg, graph);
  return svg;
}

/** Gives the boxes and lines that a picture has the colours and words of `graph`, which may have others. */
export function dress(picture, graph) {
  const boxes = new Map(graph.boxes.map((box) => [box.key, box]));
  for (const drawn of picture.querySelectorAll(".box")) {
    const box = boxes.get(drawn.dataset.key);
    if (!box) continue;
    const is = { node: box.kind === "node", space: box.kind === "space", topic: box.kind === "topic", changed: box.changed };
    for (const health of HEALTH) is[health] = box.health === health;
    for (const [name, has] of Object.entries(is)) drawn.classList.toggle(name, Boolean(has));
    const words = wordsOf(box);
    drawn.setAttribute("aria-label", words);
    if (box.kind === "space") drawn.setAttribute("aria-expanded", "false");
    const title = drawn.querySelector("title");
    if (title) title.textContent = words;
    else drawn.title = words;
  }
  const keys = new Map([...picture.querySelectorAll("[data-id]")].map(({ dataset }) => [dataset.id, dataset.key]));
  const ends = ({ from, to }) => `${graph.boxes[from].key} ${graph.boxes[to].key}`;
  const lines = new Map(graph.lines.map((line) => [ends(line), line]));
  for (const drawn of picture.querySelectorAll(".line")) {
    const line = lines.get(`${keys.get(drawn.dataset.from)} ${keys.get(drawn.dataset.to)}`);
    if (!line) continue;
    drawn.classList.toggle("changed", line.changed);
    const [a, b] = [graph.boxes[line.from].name, graph.boxes[line.to].name];
    drawn.querySelector("title").textContent = `${a} ${line.both ? "↔" : "→"} ${b}\n${[...line.topics].sort().join("\n")}`;
  }
}

function wordsOf({ kind, name, health, changed, nodes }) {
  const what = kind === "space" ? `namespace ${name}, ${nodes.size} nodes` : `${kind} ${name}`;
  const state = health && health !== "registered" && health;
  return [what, state, changed && "changed"].filter(Boolean).join(", ");
}
