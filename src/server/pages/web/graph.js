// The graph of nodes and topics, as rqt_graph shows it: what is in it, and its picture.

const SVG = "http://www.w3.org/2000/svg";
/** Longest label in characters: a longer name loses its middle. */
const LABEL = 36;
const MARGIN = 12;
/** Most boxes and lines that are laid out. 260 boxes with 520 lines at random take 1.3 s. */
const BOXES = 600;
const LINES = 2000;
/** Longest time for a layout, in milliseconds. */
const PATIENCE = 20000;

/** What every robot has, and tools. rqt_graph hides the same. */
const HIDDEN = ["/rosout", "/rosout_agg", "/statistics", "/clock"];
const TOOLS = ["/rqt_", "/rviz", "/rosapi", "/rosbridge", "/record_", "/rostopic_"];
const isDebug = (name) => HIDDEN.includes(name) || TOOLS.some((tool) => name.startsWith(tool));

/**
 * The boxes and lines to draw. `changed` has what to mark. `filter` keeps the names that contain it and their neighbours,
 * `leaves` adds topics without a publisher or without a subscriber, `debug` adds rosout and tools.
 */
export function select(robot, changed, { filter, leaves, debug }) {
  const shown = (name) => debug || !isDebug(name);
  const matches = (name) => name.toLowerCase().includes(filter.toLowerCase());
  const [boxes, lines, placeOf] = [[], [], new Map()];
  const box = (kind, name, health) => {
    const key = `${kind} ${name}`;
    if (!placeOf.has(key)) placeOf.set(key, boxes.push({ kind, name, health, changed: changed.has(key) }) - 1);
    return placeOf.get(key);
  };
  const healthOf = new Map(robot.nodes.map((node) => [node.name, node.health]));
  for (const node of robot.nodes) {
    if (shown(node.name) && matches(node.name)) box("node", node.name, node.health);
  }
  for (const topic of robot.topics) {
    const isLeaf = !topic.publishers.length || !topic.subscribers.length;
    if (!shown(topic.name) || (isLeaf && !leaves)) continue;
    for (const name of new Set([...topic.publishers, ...topic.subscribers])) {
      if (!shown(name) || !(matches(name) || matches(topic.name))) continue;
      const [node, other] = [box("node", name, healthOf.get(name) ?? "unchecked"), box("topic", topic.name)];
      const publishes = topic.publishers.includes(name);
      const [from, to] = publishes ? [node, other] : [other, node];
      lines.push({ from, to, changed: changed.has(`line ${name} ${topic.name}`), both: publishes && topic.subscribers.includes(name) });
    }
  }
  return { boxes, lines };
}

const ruler = document.createElement("canvas").getContext("2d");
const FONT = '12px ui-monospace, "DejaVu Sans Mono", Menlo, Consolas, monospace';

function label(name) {
  const letters = [...name];
  if (letters.length <= LABEL) return name;
  return [...letters.slice(0, LABEL / 2 - 1), "…", ...letters.slice(-LABEL / 2)].join("");
}

/** Gives each box its label and its size. */
export function measure(graph) {
  ruler.font = FONT;
  for (const box of graph.boxes) {
    box.label = label(box.name);
    const { width } = ruler.measureText(box.label);
    [box.width, box.height] = box.kind === "node" ? [width * 1.18 + 30, 36] : [width + 20, 26];
    box.ill = box.health === "dead" || box.health === "unreachable";
  }
  return graph;
}

let worker = null;
/** Ends the layout under way with a reason. */
let fail = null;

/** Gives up the layout under way, if there is one. */
export function abandon() {
  fail?.("abandoned");
}

/**
 * Where the boxes and lines of `graph` are on a screen of this size. One layout at a time. Throws the reason if there is no such
 * picture.
 */
export function layOut({ boxes, lines }, width, height) {
  if (!boxes.length) throw new Error("nothing to show");
  if (boxes.length > BOXES || lines.length > LINES) {
    throw new Error(`${boxes.length} boxes and ${lines.length} lines are too many to read: filter by a part of a name`);
  }
  return new Promise((resolve, reject) => {
    worker ??= new Worker("/layout.js", { type: "module" });
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
      resolve(data);
    };
    worker.onerror = () => fail?.("this browser cannot draw the graph; the lists below show the same");
    const sizes = boxes.map((box) => ({ width: box.width, height: box.height, ill: box.ill }));
    worker.postMessage({ boxes: sizes, lines, width, height });
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
  const [across, down] = [Math.abs(dx) / (box.width / 2), Math.abs(dy) / (box.height / 2)];
  const far = box.kind === "node" ? Math.hypot(across, down) : Math.max(across, down);
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
  const lines = graph.lines.map(({ from, to, both, changed }, index) => {
    const points = [...placed.lines[index]];
    points[0] = edge(graph.boxes[from], placed.boxes[from], points[1]);
    points[points.length - 1] = edge(graph.boxes[to], placed.boxes[to], points.at(-2));
    const arrows = { "marker-end": "url(#arrow)", ...(both && { "marker-start": "url(#arrow)" }) };
    return shape("path", { class: changed ? "changed" : "", "data-from": from, "data-to": to, d: curve(points), ...arrows });
  });
  const boxes = graph.boxes.map(({ kind, name, health, changed, label, width, height }, index) => {
    const { x, y } = placed.boxes[index];
    const outline = kind === "node"
      ? shape("ellipse", { cx: x, cy: y, rx: width / 2, ry: height / 2 })
      : shape("rect", { x: x - width / 2, y: y - height / 2, width, height, rx: 3 });
    const state = health && !["alive", "registered"].includes(health) && health;
    const words = [`${kind} ${name}`, state, changed && "changed"].filter(Boolean).join(", ");
    return shape("g", { class: `box ${kind} ${health ?? ""} ${changed ? "changed" : ""}`, "data-id": index, [`data-${kind}`]: name, role: "button", "aria-label": words },
      shape("title", {}, words), outline, shape("text", { x, y: y + 4, "text-anchor": "middle" }, label));
  });
  const arrow = shape("marker", { id: "arrow", viewBox: "0 0 8 8", refX: 7.5, refY: 4, markerWidth: 8, markerHeight: 8, markerUnits: "userSpaceOnUse", orient: "auto-start-reverse" },
    shape("path", { d: "M0,0.8 L8,4 L0,7.2 z", class: "head" }));
  const size = { x: -MARGIN, y: -MARGIN, width: placed.width + 2 * MARGIN, height: placed.height + 2 * MARGIN };
  const svg = shape("svg", { viewBox: `${size.x} ${size.y} ${size.width} ${size.height}` },
    shape("defs", {}, arrow), shape("g", { class: "lines" }, ...lines), ...boxes);
  // What to show first: a node that needs attention, or else the top box of a tall graph or the leftmost of a wide one.
  // The corner may be empty.
  const ill = graph.boxes.findIndex((box) => box.ill);
  const side = size.height > size.width ? "y" : "x";
  const begin = placed.boxes.reduce((best, next) => (best && best[side] <= next[side] ? best : next), undefined);
  return { svg, size, first: placed.boxes[ill] ?? begin };
}
