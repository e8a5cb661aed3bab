// The page of rosrescue. Names of nodes, topics and parameters come from the network: they are only ever set
// as text, never as markup.

import { abandon, draw, dress, layOut, measure, namespaces, nodesOf, select, shapeOf } from "/graph.js";
import { countIll, tiles } from "/overview.js";
import { begin as beginTimeLine, changed, fetchLog, past, query, readHistory, readPast, showMarks } from "/time.js";

const $ = (id) => document.getElementById(id);
/** Nodes in trouble that are named at once. */
const TROUBLES = 8;
/** Rows of a list; more are found by searching. */
const ROWS = 300;
/** Seconds without any event after which the connection counts as lost; there is one every 15. */
const SILENCE = 20;
/** Seconds without data after which a page without a connection shows nothing as live. */
const STALE = 5;
/** Shortest pause between two readings of the state, in milliseconds. */
const PAUSE = 2000;

const CONDITIONS = {
  protected: ["good", "Protected"],
  following: ["good", "Following the leader"],
  standing_in: ["warn", "Standing in for the master"],
  no_leader: ["warn", "No computer leads"],
  crash_loop: ["bad", "Master crash loop"],
  unprotected: ["bad", "UNPROTECTED"],
  alone: ["bad", "ALONE: cut off from the other computers"],
  wrong_addresses: ["warn", "Nodes at wrong addresses"],
  nodes_unreachable: ["warn", "Nodes do not answer"],
  nodes_dead: ["warn", "Nodes died"],
  waiting: ["warn", "Waiting for the first master"],
};
const ROLES = { joining: "joining", following: "following", catching_up: "taking over", leading: "leads", alone: "ALONE" };
const OUTCOMES = {
  begun: "a new session started",
  injected: "a new master got the whole state",
  injected_again: "the same master continues, and got the whole state again",
  adopted: "a running master was taken over",
  reconciled: "the same master continues, and got the changes it missed",
  resumed: "the same master continues",
};

/** What keeps a node from being called alive, the worst first. */
const ILL = { dead: "dead", unreachable: "unreachable", unchecked: "not checked" };

let status = null;
let now = null;
let robot = null;
/** The state that the graph and the lists show. */
const shownState = () => past ?? robot;
/** Milliseconds by which the robot's clock is ahead of this one. */
let skew = 0;

// ---- small things

/** An element with attributes and children; strings become text. */
function el(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (value !== undefined && value !== false) made.setAttribute(name, value === true ? "" : value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

/** Sets text, if it is another one: a screen reader says only what is new. */
function say(id, text) {
  if ($(id).textContent !== text) $(id).textContent = text;
}

const robotTime = () => (Date.now() + skew) / 1000;

function span(seconds) {
  const s = Math.max(0, Math.round(seconds));
  if (s < 60) return `${s} s`;
  if (s < 3600) return `${Math.floor(s / 60)} min ${s % 60} s`;
  if (s < 86400) return `${Math.floor(s / 3600)} h ${Math.floor((s % 3600) / 60)} min`;
  return `${Math.floor(s / 86400)} d ${Math.floor((s % 86400) / 3600)} h`;
}

function ms(value) {
  if (value >= 10000) return span(value / 1000);
  if (value >= 1000) return `${(value / 1000).toFixed(1)} s`;
  return `${value < 10 ? value.toFixed(1) : Math.round(value)} ms`;
}

function size(bytes) {
  if (bytes === null || bytes === undefined) return "–";
  const units = ["B", "kB", "MB", "GB", "TB"];
  let unit = 0;
  while (bytes >= 1000 && unit < units.length - 1) {
    bytes /= 1000;
    unit += 1;
  }
  return `${unit > 0 && bytes < 10 ? bytes.toFixed(1) : Math.round(bytes)} ${units[unit]}`;
}

const clock = new Intl.DateTimeFormat(undefined, { hour: "2-digit", minute: "2-digit", second: "2-digit", hourCycle: "h23" });
const date = new Intl.DateTimeFormat(undefined, { year: "numeric", month: "short", day: "numeric" });

function moment(seconds) {
  const at = new Date(seconds * 1000);
  const today = date.format(new Date(robotTime() * 1000)) === date.format(at);
  return today ? clock.format(at) : `${date.format(at)}, ${clock.format(at)}`;
}

const plural = (count, one, many = `${one}s`) => `${count} ${count === 1 ? one : many}`;

/** Calls `work` when `wait` milliseconds have passed without another call. */
function debounced(work, wait) {
  let timer;
  return () => {
    clearTimeout(timer);
    timer = setTimeout(work, wait);
  };
}

// ---- the connection

let source = null;
let heard = 0;
/** The robot's time of the last data, and whether that is too long ago. */
let fresh = 0;
let stale = false;

function connect() {
  source?.close();
  heard = Date.now();
  source = new EventSource("/events");
  source.onopen = () => {
    setLink("live", "live");
    heard = Date.now();
    compareClocks();
    readState();
  };
  source.onerror = () => {
    // The browser reconnects by itself after a lost connection, but not after a refusal.
    if (source.readyState === EventSource.CLOSED) setTimeout(refused, 2000);
    else setLink("lost", "no answer from rosrescue, retrying");
  };
  source.addEventListener("status", (event) => {
    heard = Date.now();
    status = JSON.parse(event.data);
    isFresh();
    showStatus();
  });
  source.addEventListener("now", (event) => {
    heard = Date.now();
    const before = now;
    now = JSON.parse(event.data);
    isFresh();
    showNow();
    const isOther = before && before.registrations !== now.registrations;
    if (isOther || (tab === "params" && before?.version !== now.version)) readState();
  });
}

/** Too many pages are open: the status is asked for, until there is a place. */
async function refused() {
  try {
    const answer = await fetch("/status.json");
    if (answer.ok) {
      status = await answer.json();
      isFresh();
      setLink("waiting", "many pages are open: updates every 2 s");
      now = { ...status, gate: status.open ? "open" : status.elsewhere ? "elsewhere" : "standing_in" };
      showStatus();
      showNow();
      readState();
    } else {
      setLink("lost", "no answer from rosrescue, retrying");
    }
  } catch {
    setLink("lost", "no answer from rosrescue, retrying");
  }
  connect();
}

function setLink(is, text) {
  $("link").dataset.is = is;
  say("link", text);
  document.body.classList.toggle("lost", is === "lost");
}

/** Notes that there is data of this moment. */
function isFresh() {
  fresh = robotTime();
  if (!stale) return;
  stale = false;
  document.body.classList.remove("stale");
  if (status) showStatus();
}

/** Says that the data is old, where the condition stands, if there has been none for a while. Nothing else may look live. */
function showStale() {
  if (!fresh || !document.body.classList.contains("lost") || robotTime() - fresh < STALE) return;
  if (!stale) {
    stale = true;
    document.body.classList.add("stale");
    const title = "No answer from rosrescue";
    $("condition").dataset.is = "bad";
    say("condition-name", title);
    say("condition-text", `Nothing on this page is live: it shows the robot as it was at ${moment(fresh)}. Either rosrescue has ended, and then nodes have no master, or this browser cannot reach the robot.`);
    say("condition-action", "run `rosrescue status` on the robot.");
    $("condition-action").hidden = false;
    document.title = `${title} – rosrescue`;
    for (const [id, text] of [["master", "unknown"], ["sick", "unknown"], ["calls", "–"]]) say(id, text);
    $("sick").dataset.is = "";
  }
  say("condition-since", `no data since ${moment(fresh)} (${span(robotTime() - fresh)})`);
}

async function compareClocks() {
  try {
    const asked = Date.now();
    const answer = await fetch("/live");
    const there = Date.parse(answer.headers.get("date"));
    const offset = there + 500 - (asked + Date.now()) / 2;
    // The header has whole seconds.
    skew = Math.abs(offset) > 2000 ? offset : 0;
  } catch {
    // rosrescue does not answer again.
  }
}

let reading = false;
let again = false;

/** Reads the state, now or when the pause since the last time is over. */
async function readState() {
  if (reading) {
    again = true;
    return;
  }
  [reading, again] = [true, false];
  try {
    const answer = await fetch("/state.json");
    if (answer.ok) {
      const before = robot;
      robot = remember(await answer.json(), before);
      showCounts();
      showTrouble();
      readHistory();
      const isOther = before?.registrations !== robot.registrations;
      const isNew = isOther || JSON.stringify(before.params) !== JSON.stringify(robot.params);
      if (isNew) readPast();
      if (isNew && !past) showList();
      if (isOther && !past) showGraph();
    }
  } catch {
    // The next event requests it again.
  }
  setTimeout(() => {
    reading = false;
    if (again) readState();
  }, PAUSE);
}

/** A dead node that was unregistered keeps its topics here, so that it stays where it was. */
function remember(state, before) {
  const rows = new Map(before?.nodes.map((node) => [node.name, node]));
  for (const node of state.nodes) {
    const { publishes = [], subscribes = [] } = rows.get(node.name) ?? {};
    if (node.removed_at) Object.assign(node, { publishes, subscribes });
  }
  return state;
}

// ---- condition, figures, rescues

function showStatus() {
  const { condition } = status;
  const [is, title] = CONDITIONS[condition.name] ?? ["warn", condition.name];
  $("condition").dataset.is = is === "good" && condition.action ? "warn" : is;
  say("condition-name", title);
  say("condition-text", condition.text);
  say("condition-action", condition.action ?? "");
  $("condition-action").hidden = !condition.action;
  say("uri", status.uri);
  document.title = `${title} – rosrescue`;
  say("version", `${status.version} ${status.mode}, process ${status.pid}`);
  $("version").title = `guarded by ${status.guarded_by}`;
  showRescues();
  showMarks();
  showTimes();
  showCounts();
}

/** Rescues, and deaths of which the log knows nothing yet, for the time line. */
function happened() {
  const rescues = (status?.last_rescues ?? []).map((rescue) => (
    { at: rescue.detected_at, what: "rescued", text: `rescue in ${ms(rescue.phases.total_ms)}: ${rescue.cause}` }));
  const dead = (robot?.nodes ?? []).filter(({ health, removed_at: removed }) => health === "dead" && !removed);
  return [...rescues, ...dead.map(({ name, since }) => ({ at: since, what: "died", text: `${name} died` }))];
}

function showNow() {
  const away = now.gate !== "open";
  const texts = { open: "up", standing_in: "down", injecting: "coming back", elsewhere: "elsewhere", unknown: "not seen yet" };
  say("master", texts[now.gate] ?? now.gate);
  const journal = now.journal ?? {};
  say("journal", plural(journal.records ?? 0, "record"));
  say("journal-more", size((journal.bytes ?? 0) + (journal.snapshot_bytes ?? 0)));
  say("disk", size(journal.disk_free_bytes));
  if (away || document.querySelector("#rescues .now")) showRescues();
  showComputers(now.cluster);
}

/** The computers of the robot, if there are several. */
function showComputers(cluster) {
  $("computers").hidden = !cluster;
  if (!cluster) return;
  const { leader, leaderless_since: leaderless, etcd_trouble: trouble, last_takeover: last } = cluster;
  const led = leader && `${leader.name} since ${moment(leader.since)}, term ${leader.term}`;
  const isWell = cluster.role !== "alone" && leader && !leaderless;
  $("computers").dataset.is = isWell ? "" : "bad";
  const leads = !leader ? "no leader" : leaderless ? `NO LEADER since ${moment(leaderless)}; the last was ${leader.name}` : `leader: ${led}`;
  say("computers-leader", cluster.role === "alone" ? `${cluster.name} is CUT OFF since ${moment(cluster.since)}; ${leads}` : leads);
  const notes = [
    trouble && `no answer from etcd since ${moment(trouble.since)}: ${trouble.why}`,
    cluster.uncommitted > 0 && `${plural(cluster.uncommitted, "change")} of ${cluster.name} not in etcd yet`,
    last && `last takeover by ${cluster.name}: ${moment(last.at)}${last.from ? ` from ${last.from}` : ""}${last.in_order ? ", in order" : ""}, in ${ms(1000 * last.seconds)}`,
    cluster.lost_writes > 0 && `${plural(cluster.lost_writes, "change")} made while it was cut off lost against changes by others: the log names each`,
  ].filter(Boolean);
  say("computers-notes", notes.join("; "));
  const rows = cluster.computers.map((of) => {
    const isThis = of.name === cluster.name;
    const is = of.away ? "dead" : of.role === "leading" || of.role === "following" ? "alive" : "unreachable";
    const led = of.role === "leading" && (leaderless || leader?.name !== of.name);
    const role = of.away ? "AWAY" : led ? "led" : ROLES[of.role] ?? of.role;
    const behind = of.away || of.role === "leading" ? "" : of.behind ? `${plural(of.behind, "record")} behind` : "has every record";
    const heard = isThis ? "this computer" : `last contact ${moment(of.heard)}`;
    const link = /^https?:/.test(of.uri) ? el("a", { href: of.uri }, of.name) : of.name;
    return el("tr", {}, ...[link, el("span", { class: "health", "data-is": is }, role), behind, heard, of.version].map((cell) => el("td", {}, cell)));
  });
  $("computers-list").replaceChildren(...rows);
}

function showTimes() {
  if (!status || stale) return;
  const { since } = status.condition;
  say("condition-since", `since ${moment(since)} (${span(robotTime() - since)})`);
  say("uptime", span(robotTime() - status.started));
  const running = document.querySelector("#rescues .now .total");
  if (running && status.standing_in_since) running.textContent = span(robotTime() - status.standing_in_since);
}

function showCounts() {
  if (!status) return;
  const deaths = status.deaths ? `, died ${status.deaths === 1 ? "once" : `${status.deaths} times`}` : "";
  say("master-more", status.elsewhere ? "on the leading computer" : `${status.master_pid ? `process ${status.master_pid}` : ""}${deaths}`);
  const gone = robot ? robot.nodes.filter((node) => node.removed_at).length : 0;
  say("count-nodes", robot ? String(robot.totals.nodes - gone) : "–");
  const parts = Object.keys(ILL).map((name) => {
    const count = robot ? robot.nodes.filter((node) => node.health === name).length : 0;
    return count ? `${count} ${ILL[name]}` : "";
  }).filter(Boolean);
  say("sick", parts.length ? parts.join(", ") : robot ? "all alive" : "");
  $("sick").dataset.is = robot?.nodes.some((node) => node.health in ILL && node.health !== "unchecked") ? "bad" : "";
}

/** Dead and unreachable nodes, which come before everything but the condition. */
function showTrouble() {
  const ill = worstFirst(robot.nodes.filter(({ health }) => health === "dead" || health === "unreachable"));
  const rows = ill.map((node) => el("li", {}, nameButton("node", node.name), " ", health(node)));
  const rest = rows.splice(TROUBLES);
  if (rest.length) {
    const more = el("li", {}, el("button", { type: "button", onclick: () => more.replaceWith(...rest) }, `${rest.length} more`));
    rows.push(more);
  }
  $("trouble").hidden = !ill.length;
  say("trouble-title", ill.length === 1 ? "A node is in trouble" : `${ill.length} nodes are in trouble`);
  $("trouble-list").replaceChildren(...rows);
}

function showRescues() {
  const rescues = [...(status?.last_rescues ?? [])].reverse();
  const rows = [];
  if (now && (now.gate === "standing_in" || now.gate === "injecting") && status?.standing_in_since) {
    const what = now.gate === "injecting"
      ? "a new master gets the state"
      : "no master: rosrescue answers in its place";
    rows.push(el("li", { class: "now" },
      el("time", {}, moment(status.standing_in_since)),
      el("div", { class: "track" }),
      el("span", { class: "total" }, span(robotTime() - status.standing_in_since)),
      el("span", { class: "what" }, `in progress: ${what}; ${plural(now.pending_writes ?? 0, "change")} for the next master`)));
  }
  const longest = Math.max(...rescues.map((rescue) => rescue.phases.total_ms), 1);
  const row = (rescue) => rescueRow(rescue, longest);
  rows.push(...rescues.slice(0, 8).map(row));
  const rest = rescues.slice(8);
  if (rest.length) {
    const older = el("li", {}, el("button", { type: "button", onclick: () => older.replaceWith(...rest.map(row)) }, `${rest.length} older`));
    rows.push(older);
  }
  $("rescues-list").replaceChildren(...rows);
  $("rescues-none").hidden = rows.length > 0;
  say("rescues-none", "None needed so far.");
  $("rescues-key").hidden = rows.length === 0;
  const late = status?.late_answers?.times ? status.late_answers : null;
  say("rescues-count", [
    status?.rescues && `${status.rescues} since the start`,
    late && `answered in the late master's place ${plural(late.times, "time")}, ${late.seconds.toFixed(1)} s in all`,
  ].filter(Boolean).join("; "));
}

/** All bars have one scale: the longest rescue fills its track. */
function rescueRow(rescue, longest) {
  const { absence_ms: absence, inspection_ms: inspection, injection_ms: injection, total_ms: total } = rescue.phases;
  const check = rescue.health_check_ms;
  const parts = [
    ["absence", absence, "no master"],
    ["inspection", inspection, "to read it"],
    ["injection", injection, "to restore it"],
    ["rest", Math.max(0, total - absence - inspection - injection), "until calls passed"],
  ].filter(([, length]) => length > 0.05);
  const track = el("div", { class: "track", role: "img" });
  for (const [name, length, words] of parts) {
    const part = el("i", { class: name, title: `${ms(length)} ${words}` });
    part.style.width = `${(100 * length) / longest}%`;
    track.append(part);
  }
  const phases = `${ms(absence)} without a master, ${ms(inspection)} to read it, ${ms(injection)} to restore it` +
    (check === null ? "" : `, nodes checked after ${ms(check)}`);
  track.setAttribute("aria-label", phases);
  const calls = rescue.unanswered
    ? `${plural(rescue.answered, "call")} answered meanwhile, ${rescue.unanswered} timed out`
    : `${plural(rescue.answered, "call")} answered meanwhile, none lost`;
  const lists = [
    ["could not be restored", rescue.not_restored],
    ["differs", rescue.mismatches],
    ["unregistered dead nodes", rescue.removed],
    ["corrected after asking the nodes", rescue.reconciled],
    ["nodes without an answer", rescue.unreachable],
  ].filter(([, names]) => names?.length).map(([what, names]) => `${what}: ${names.join(", ")}`);
  const cause = rescue.cause + (rescue.ended ? ` (${rescue.ended})` : "");
  const outcome = rescue.outcome === "injected" && rescue.same_master ? "injected_again" : rescue.outcome;
  const words = [`${cause}: ${OUTCOMES[outcome] ?? outcome}`, calls, phases, ...lists];
  const at = new Date(rescue.detected_at * 1000);
  return el("li", {},
    el("time", { datetime: at.toISOString() }, clock.format(at), el("small", {}, date.format(at))),
    track,
    el("span", { class: "total" }, ms(total)),
    el("span", { class: "what" }, words.join("; ")));
}

// ---- calls a second

const rates = [];
let counted = null;

function countCalls() {
  const calls = now?.counters?.calls;
  if (calls === undefined) return;
  const at = performance.now();
  if (counted && calls >= counted.calls && !document.body.classList.contains("lost")) {
    rates.push((1000 * (calls - counted.calls)) / (at - counted.at));
    if (rates.length > 60) rates.shift();
    const rate = rates.at(-1);
    say("calls", rate >= 10 || rate === 0 ? String(Math.round(rate)) : rate.toFixed(1));
    const most = Math.max(1, ...rates);
    const points = rates.map((value, index) => `${(120 * (index + 60 - rates.length)) / 59},${30 - (27 * value) / most}`);
    const [area, line] = $("spark").children;
    line.setAttribute("points", points.join(" "));
    area.setAttribute("points", [`${(120 * (60 - rates.length)) / 59},32`, ...points, "120,32"].join(" "));
  }
  counted = { calls, at };
}

// ---- the graph

const picture = $("picture");
/** From this many nodes on, an overview comes first. */
const MANY = 60;
/** Whether the overview is wanted; null while the number of nodes decides. */
let overview = null;
/** The node or topic whose neighbourhood is shown, as in `["node", "/a"]`. */
let focus = null;
/** For namespaces that were folded or opened by hand: whether they are folded. */
const folds = new Map();
/** What the picture depends on besides health, as text. */
let drawn = null;
let drawing = false;
let redraw = false;

/** Shows the graph, or shows it again when the layout under way is done. */
async function showGraph() {
  const robot = shownState();
  if (!robot) return;
  const filter = $("graph-filter").value.trim();
  const everything = $("graph-everything").checked;
  const nodes = nodesOf(robot, everything);
  $("graph-overview").checked = overview ?? nodes.length > MANY;
  const isOverview = $("graph-overview").checked && !focus;
  const folded = new Map(folds);
  const graph = isOverview
    ? overviewOf(nodes, filter)
    : select(robot, changed, { filter, focus, topics: $("graph-topics").checked, everything, folds: folded });
  $("graph-back").hidden = !focus;
  $("graph-topics").disabled = isOverview;
  say("graph-note", noteOf(graph));
  // Colours need no layout.
  paint(graph);
  redraw = drawing;
  if (drawing) return;
  const width = Math.max(240, picture.parentElement.clientWidth);
  const shape = isOverview ? JSON.stringify([graph.spaces, [...folded]]) : JSON.stringify([width, measure(graph) && shapeOf(graph)]);
  if (shape === drawn) return;
  if (isOverview) {
    drawn = shape;
    keepPlace(() => picture.replaceChildren(tiles(el, graph, folded)));
    return paint(graph);
  }
  drawing = true;
  try {
    const svg = draw(graph, await layOut(graph, width));
    const isFirst = !picture.querySelector("svg");
    drawn = shape;
    keepPlace(() => picture.replaceChildren(svg));
    // Without trouble a picture begins at its left.
    const begin = focus ? boxOf(focus) : ".box:is(.dead, .unreachable)";
    if (focus || isFirst) show(picture.querySelector(begin) ?? leftmost());
  } catch (error) {
    drawn = null;
    if (!redraw) picture.replaceChildren(el("p", { class: "quiet" }, error.message));
  }
  drawing = false;
  if (redraw) showGraph();
}

function paint(graph) {
  dress(picture, graph);
  if (graph.spaces) countIll(picture, graph);
}

/** The nodes as tiles, by namespace. */
function overviewOf(nodes, filter) {
  const boxes = nodes.filter(({ name }) => name.toLowerCase().includes(filter.toLowerCase())).map(({ name, health }) => (
    { key: `node ${name}`, kind: "node", name, health, changed: changed.has(`node ${name}`) }));
  const spaces = new Map();
  for (const [name, space] of namespaces(boxes.map(({ name }) => name))) spaces.set(space, [...(spaces.get(space) ?? []), name]);
  return { boxes, lines: [], left: [], spaces: [...spaces].sort(([a], [b]) => (a < b ? -1 : 1)) };
}

function noteOf({ boxes, left }) {
  if (focus) return `${focus[1]} and its ${plural(Math.max(0, boxes.length - 1), "neighbour")}`;
  return left.length ? `Without the lines of ${left.join(", ")}, which connect nearly everything.` : "";
}

const boxOf = ([kind, name]) => `[data-${kind}="${CSS.escape(name)}"]`;

const leftmost = () => stops().reduce((best, next) => (best && best.getBoundingClientRect().left <= next.getBoundingClientRect().left ? best : next), null);

/** Scrolls the picture, but not the page, until `box` is in its middle. */
function show(box) {
  if (!box) return;
  const [a, b] = [box.getBoundingClientRect(), picture.getBoundingClientRect()];
  picture.scrollBy(a.left - b.left - (b.width - a.width) / 2, a.top - b.top - (b.height - a.height) / 2);
}

/** Draws such that what has the focus keeps it, and what is chosen stays marked. */
function keepPlace(work) {
  const { key, fold, space = fold } = picture.contains(document.activeElement) ? document.activeElement.dataset : {};
  // A namespace is another box when it has been folded or opened.
  const same = (box) => (space === undefined ? box.dataset.key === key : (box.dataset.space ?? box.dataset.fold) === space);
  const isFocused = key !== undefined || space !== undefined;
  work();
  const stop = isFocused ? stops().find(same) : null;
  rove(stop);
  if (isFocused) (stop ?? stops()[0])?.focus({ preventScroll: true });
  if (space !== undefined) show(stop);
  if (chosen) choose(chosen, false);
}

/** One of the boxes can be reached by Tab; the arrow keys go to the others. */
const stops = () => [...picture.querySelectorAll("[tabindex]")];

function rove(to) {
  const all = stops();
  const next = to ?? all[0];
  for (const stop of all) stop.tabIndex = stop === next ? 0 : -1;
}

function selectGraph() {
  abandon();
  showGraph();
}

/** Shows the neighbourhood of a node or topic, or all nodes again. */
function setFocus(next) {
  focus = next;
  choose(next);
  selectGraph();
}

let dragged = null;

picture.addEventListener("pointerdown", (event) => {
  // A finger scrolls anyway.
  dragged = event.pointerType === "mouse" && event.button === 0 ? { x: event.clientX, y: event.clientY, moved: false } : null;
});
picture.addEventListener("pointermove", (event) => {
  if (!dragged || !(event.buttons & 1)) return;
  const [dx, dy] = [event.clientX - dragged.x, event.clientY - dragged.y];
  if (!dragged.moved && Math.hypot(dx, dy) < 5) return;
  if (!dragged.moved) picture.setPointerCapture(event.pointerId);
  dragged = { x: event.clientX, y: event.clientY, moved: true };
  picture.scrollBy(-dx, -dy);
});
picture.addEventListener("click", (event) => {
  if (dragged?.moved) return;
  press(event.target.closest?.(".box, .fold"));
});
for (const [name, isNear] of [["pointerover", true], ["pointerout", false]]) {
  picture.addEventListener(name, (event) => {
    const id = event.target.closest?.(".box")?.dataset.id;
    for (const line of picture.querySelectorAll(`.line:is([data-from="${id}"], [data-to="${id}"])`)) line.classList.toggle("over", isNear);
  });
}

/** A click on a box or a namespace. */
function press(box) {
  if (!box) return choose(null);
  rove(box);
  box.focus({ preventScroll: true });
  const { node, topic, space, fold } = box.dataset;
  const name = fold ?? space;
  if (name !== undefined) {
    folds.set(name, box.getAttribute("aria-expanded") === "true");
    return selectGraph();
  }
  const next = node === undefined ? ["topic", topic] : ["node", node];
  if ($("graph-overview").checked) setFocus(next);
  else choose(next);
}

picture.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const all = stops();
  const at = all.indexOf(document.activeElement);
  const to = { ArrowLeft: at - 1, ArrowUp: at - 1, ArrowRight: at + 1, ArrowDown: at + 1, Home: 0, End: all.length - 1 }[event.key];
  if (at >= 0 && to !== undefined) {
    event.preventDefault();
    const next = all[Math.min(Math.max(to, 0), all.length - 1)];
    rove(next);
    next.focus();
  } else if (event.key === "Escape") {
    choose(null);
  } else if (at >= 0 && (event.key === "Enter" || event.key === " ")) {
    event.preventDefault();
    press(all[at]);
  }
});

// ---- details of a node or a topic

/** What is chosen: its kind and its name. */
let chosen = null;

function choose(next, isNew = true) {
  chosen = next;
  for (const marked of picture.querySelectorAll(".chosen, .near")) marked.classList.remove("chosen", "near");
  const box = next && picture.querySelector(boxOf(next));
  picture.classList.toggle("choice", Boolean(box?.dataset.id));
  if (box) {
    box.classList.add("chosen");
    const { id } = box.dataset;
    for (const line of id ? picture.querySelectorAll(".line") : []) {
      const { from, to } = line.dataset;
      if (from !== id && to !== id) continue;
      line.classList.add("near");
      picture.querySelector(`[data-id="${from === id ? to : from}"]`)?.classList.add("near");
    }
  }
  if (isNew || next) showDetails();
}

/** Shows a node or topic that was chosen outside of the graph. */
function goTo(next) {
  if (focus || !picture.querySelector(boxOf(next)) || $("graph-overview").checked) setFocus(next);
  else choose(next);
  $("graph").scrollIntoView({ block: "start" });
  show(picture.querySelector(boxOf(next)));
}

function nameButton(kind, name) {
  return el("button", { type: "button", class: "name", onclick: () => goTo([kind, name]) }, name);
}

function nameList(title, kind, names) {
  if (!names.length) return [];
  const items = names.map((name) => el("li", {}, kind ? nameButton(kind, name) : name));
  return [el("h4", {}, title), el("ul", {}, ...items)];
}

/** Topics of a node, each with the nodes at the other end. */
function topicList(title, names, others) {
  const items = names.map((name) => {
    const topic = shownState().topics.find((of) => of.name === name);
    const [word, nodes] = topic ? others(topic) : ["", []];
    return el("li", {}, nameButton("topic", name), nodes.length ? el("small", {}, ` ${word} ${nodes.slice(0, 5).join(", ")}${nodes.length > 5 ? ` and ${nodes.length - 5} more` : ""}`) : null);
  });
  return items.length ? [el("h4", {}, title), el("ul", {}, ...items)] : [];
}

function showDetails() {
  const panel = $("details");
  panel.hidden = !chosen;
  const robot = shownState();
  if (!chosen || !robot) return;
  const [kind, name] = chosen;
  const found = (kind === "node" ? robot.nodes : robot.topics).find((of) => of.name === name);
  const parts = [el("h3", {}, name)];
  const isFocus = focus?.[0] === kind && focus[1] === name;
  if (!isFocus) parts.push(el("button", { type: "button", onclick: () => setFocus(chosen) }, "only its neighbours"));
  if (!found) {
    parts.push(el("p", {}, past ? "It was not registered then." : "It is no longer registered."));
  } else if (kind === "node") {
    parts.push(
      el("p", {}, health(found), found.api ? ` ${found.api}` : "", found.pid ? `, process ${found.pid}` : ""),
      ...topicList("publishes", found.publishes, (topic) => ["to", topic.subscribers]),
      ...topicList("subscribes", found.subscribes, (topic) => ["from", topic.publishers]),
      ...nameList("serves", null, found.serves));
  } else {
    parts.push(
      el("p", {}, typeOf(found)),
      ...nameList("published by", "node", found.publishers),
      ...nameList("subscribed by", "node", found.subscribers));
  }
  panel.lastElementChild.replaceChildren(...parts);
}

function health(node) {
  if (past) return "";
  const texts = {
    alive: "alive",
    unchecked: node.checked_at ? `not checked since ${moment(node.checked_at)}` : "not checked yet",
    unreachable: `unreachable since ${moment(node.since)}: still registered, retrying`,
    dead: node.removed_at ? `dead, unregistered ${moment(node.removed_at)}` : `dead since ${moment(node.since)}; still registered`,
  };
  return el("span", { class: "health", "data-is": node.health }, texts[node.health] ?? node.health);
}

const typeOf = (topic) => (topic.type === "*" ? "unknown type" : topic.type);

// ---- lists

let tab = "nodes";
const tabs = ["nodes", "topics", "services", "params"];

function selectTab(next, focus) {
  tab = next;
  for (const name of tabs) {
    const button = $(`tab-${name}`);
    button.setAttribute("aria-selected", String(name === tab));
    button.tabIndex = name === tab ? 0 : -1;
  }
  if (focus) $(`tab-${tab}`).focus();
  $("list").setAttribute("aria-labelledby", `tab-${tab}`);
  $("list").scrollTop = 0;
  if (tab === "params") readState();
  showList();
}

function showList() {
  const robot = shownState();
  if (!robot) return;
  const text = $("list-filter").value.trim().toLowerCase();
  if (tab === "params") return showParams(text);
  const has = (...words) => !text || words.flat().some((word) => word.toLowerCase().includes(text));
  const rows = {
    nodes: () => worstFirst(robot.nodes.filter((of) => has(of.name, of.publishes, of.subscribes, of.serves))).map((of) => [
      nameButton("node", of.name), health(of), where(of), names(of.publishes), names(of.subscribes), names(of.serves)]),
    topics: () => robot.topics.filter((of) => has(of.name, of.type)).map((of) => [
      nameButton("topic", of.name), typeOf(of), names(of.publishers), names(of.subscribers)]),
    services: () => robot.services.filter((of) => has(of.name, of.node)).map((of) => [of.name, nameButton("node", of.node), of.api]),
  }[tab]();
  const heads = {
    nodes: ["node", "", "address", "publishes", "subscribes", "serves"],
    topics: ["topic", "type", "published by", "subscribed by"],
    services: ["service", "node", "address"],
  }[tab];
  const left = rows.length - ROWS + Math.max(0, robot.totals[tab] - robot[tab].length);
  const isChanged = ([cell]) => changed.has(`${tab.slice(0, -1)} ${cell.textContent ?? cell}`);
  const body = rows.slice(0, ROWS).map((row) => el("tr", { class: isChanged(row) && "changed" }, ...row.map((cell, index) => {
    const label = index > 0 && heads[index] ? heads[index] : undefined;
    const kind = !Array.isArray(cell) ? undefined : label === "address" ? "names where" : "names";
    return el("td", { class: kind, "data-label": label }, ...[cell].flat());
  })));
  const table = el("table", {}, el("thead", {}, el("tr", {}, ...heads.map((head) => el("th", { scope: "col" }, head)))), el("tbody", {}, ...body));
  const note = rows.length === 0 ? `no ${tab} ${text ? "match" : "are registered"}` : left > 0 ? `${left} more: search for a name` : null;
  const shown = rows.length ? [table] : [];
  $("list").replaceChildren(...shown, ...(note ? [el("p", { class: "quiet" }, note)] : []));
}

/** Nodes with problems come first; the others stay sorted by name. */
function worstFirst(nodes) {
  const ranks = Object.keys(ILL);
  const rank = (node) => (node.health in ILL ? ranks.indexOf(node.health) : ranks.length);
  return [...nodes].sort((a, b) => rank(a) - rank(b));
}

function where(node) {
  const api = node.api.replace(/^http:\/\//, "").replace(/\/$/, "");
  return [el("span", {}, api), ...(node.pid ? [el("span", {}, `process ${node.pid}`)] : [])];
}

/** A few of many names; all of them are in the details. */
function names(list) {
  const shown = list.slice(0, 5).map((name) => el("span", {}, name));
  return list.length > 5 ? [...shown, el("span", {}, `and ${list.length - 5} more`)] : shown;
}

// ---- parameters

const opened = new Set();
let asked = 0;

async function showParams(text) {
  const number = ++asked;
  if (!text) {
    const { members, more } = shownState().params;
    return $("list").replaceChildren(members.length ? paramList(members, more, "") : el("p", { class: "quiet" }, "no parameters"));
  }
  const found = await ask({ search: text });
  if (number !== asked || !found) return;
  const list = found.members.length ? paramList(found.members, found.more, null) : el("p", { class: "quiet" }, "no parameter matches");
  $("list").replaceChildren(list);
}

async function ask(part) {
  try {
    const url = `/state.json?${new URLSearchParams({ ...query(), ...part })}`;
    const answer = await (past ? fetchLog(url) : fetch(url));
    if (answer.status === 503) {
      await new Promise((resolve) => setTimeout(resolve, 300));
      return await ask(part);
    }
    return answer.ok ? await answer.json() : null;
  } catch {
    return null;
  }
}

/** The entries of the namespace `above`, or of a search: they have whole names. */
function paramList(entries, more, above) {
  const items = entries.map((entry) => {
    const name = above === null ? entry.name : `${above}/${entry.name}`;
    if (entry.type === "namespace") return el("li", { class: changed.has(`param ${name}`) && "changed" }, namespace(entry, name));
    const value = entry.hidden
      ? el("i", {}, "(hidden)")
      : el("span", {}, entry.value + (entry.cut ? " …" : ""));
    return el("li", { class: changed.has(`param ${name}`) ? "param changed" : "param", title: `${name}, ${entry.type}` }, el("b", {}, entry.name), ": ", value);
  });
  if (more) items.push(el("li", { class: "quiet" }, `${more} more: search for a name`));
  return el("ul", {}, ...items);
}

function namespace(entry, name) {
  const made = el("details", {}, el("summary", {}, `${entry.name}/ `, el("small", {}, String(entry.count))));
  const fill = async () => {
    if (made.childElementCount > 1) return;
    const part = entry.members ? entry : await ask({ params: name });
    if (part && made.childElementCount === 1) made.append(paramList(part.members, part.more, name));
  };
  made.addEventListener("toggle", () => {
    if (made.open) {
      opened.add(name);
      fill();
    } else {
      opened.delete(name);
    }
  });
  if (opened.has(name)) {
    made.open = true;
    fill();
  }
  return made;
}

// ---- input

for (const name of tabs) {
  $(`tab-${name}`).addEventListener("click", () => selectTab(name));
  $(`tab-${name}`).addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (step) selectTab(tabs[(tabs.indexOf(tab) + step + tabs.length) % tabs.length], true);
  });
}
$("list-filter").addEventListener("input", debounced(showList, 150));
$("graph-filter").addEventListener("input", debounced(selectGraph, 200));
$("graph-topics").addEventListener("change", selectGraph);
$("graph-everything").addEventListener("change", selectGraph);
$("graph-overview").addEventListener("change", () => {
  overview = $("graph-overview").checked;
  setFocus(null);
});
$("graph-back").addEventListener("click", () => setFocus(null));
$("details-close").addEventListener("click", () => choose(null));
new ResizeObserver(debounced(showGraph, 200)).observe(picture.parentElement);

setInterval(() => {
  if (!stale) countCalls();
  showStale();
  showTimes();
  if (Date.now() - heard > SILENCE * 1000) {
    setLink("lost", "no answer from rosrescue, retrying");
    connect();
  }
}, 1000);
beginTimeLine({
  el, say, moment, robotTime, happened,
  redraw: () => {
    showGraph();
    showList();
  },
});
connect();
