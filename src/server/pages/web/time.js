// The time line: the state at an earlier moment, and what differs between two moments. The answers come from
// `/state.json?at=…&with=…`. Marks show when nodes died and restarted, from `/history.json`, and when the robot was rescued.

const $ = (id) => document.getElementById(id);
/** Steps of a slider. */
const STEPS = 2000;
/** Pause before another try while rosrescue reads another state, in milliseconds. */
const PAUSE = 300;
/** Changes that are listed. */
const LISTED = 100;
const SLIDERS = ["at", "with"];
/** Marks that are closer than this part of the time line become one. */
const CLOSE = 0.012;
/** Pause between two readings of the history, in milliseconds. */
const REST = 3000;
const LANES = { died: "died", restarted: "restarted", rescued: "rescues" };
/** What is shown of a moment that the log does not have. */
const NOTHING = { nodes: [], topics: [], services: [], totals: {}, params: { members: [], more: 0 }, changes: [] };

/** The state that is shown instead of the present one, or null. */
export let past = null;
/** What differs between the two moments, as in `node /a`, `topic /b`, `line /a /b`, `service /c` and `param /d`. */
export let changed = new Set();

/** The moments of the two sliders in milliseconds since 1970; null for now. */
const chosen = { at: null, with: null };
/** The moment at the right end of the sliders. */
let end = 0;
let tools;
let reading = false;
let again = false;

/**
 * Begins with functions of the page. `tools.redraw` is called when `past` or `changed` has another value. `tools.happened` lists
 * rescues and present deaths as `{ at, what, text }`.
 */
export function begin(given) {
  tools = given;
  for (const name of SLIDERS) {
    $(`time-${name}`).max = STEPS;
    $(`time-${name}`).addEventListener("input", () => {
      const steps = STEPS - $(`time-${name}`).value;
      choose(name, steps ? end - (steps / STEPS) * span() : null);
    });
    $(`clock-${name}`).addEventListener("change", () => {
      const at = Date.parse($(`clock-${name}`).value);
      // The clock shows whole seconds; what happened in this one belongs to it.
      choose(name, at + 999 < end ? at + 999 : null);
    });
  }
  $("time-span").addEventListener("change", () => {
    end = 1000 * tools.robotTime();
    place();
    readHistory();
  });
  $("lanes").addEventListener("keydown", (event) => {
    const marks = [...$("lanes").querySelectorAll(".mark")];
    const at = marks.indexOf(document.activeElement);
    const to = { ArrowLeft: at - 1, ArrowUp: at - 1, ArrowRight: at + 1, ArrowDown: at + 1 }[event.key];
    if (at < 0 || to === undefined) return;
    event.preventDefault();
    const next = marks[Math.min(Math.max(to, 0), marks.length - 1)];
    for (const mark of marks) mark.tabIndex = mark === next ? 0 : -1;
    next.focus();
  });
  $("time-now").addEventListener("click", () => {
    [chosen.at, chosen.with] = [null, null];
    place();
    readPast();
  });
  place();
  setInterval(() => isLive() && place(), 1000);
}

/** What happened to nodes since `since`, in seconds since 1970, oldest first. */
let known = { since: Infinity, nodes: [] };
/** Until when the history was read. */
let readUntil = 0;
let resting = null;

/** Reads what has happened since the last reading, or in the whole span if it is longer now. */
export async function readHistory() {
  if (resting) {
    resting = "again";
    return;
  }
  resting = "reading";
  const begin = end / 1000 - $("time-span").value;
  const isMore = begin < known.since - 1;
  const since = isMore ? begin : readUntil - 2;
  const until = tools.robotTime();
  try {
    const answer = await fetchLog(`/history.json?since=${new Date(1000 * since).toISOString()}`);
    if (answer.ok) {
      const read = await answer.json();
      const before = isMore ? [] : known.nodes.filter((event) => event.at < read.since);
      known = { since: isMore ? begin : known.since, nodes: [...before, ...read.nodes] };
      readUntil = until;
      showMarks();
    } else if (answer.status === 503) {
      resting = "again";
    }
  } catch {
    // The next change of the robot asks again.
  }
  setTimeout(() => {
    const isWanted = resting === "again";
    resting = null;
    if (isWanted) readHistory();
  }, REST);
}

/** Shows what happened in the span of the time line, one lane for each kind. */
export function showMarks() {
  const nodes = known.nodes.map(({ at, node, what }) => ({ at, what, text: `${node} ${what}` }));
  const all = [...nodes, ...tools.happened()].sort((a, b) => a.at - b.at);
  const of = (event) => 1 - (end - 1000 * event.at) / span();
  const drawn = Object.entries(LANES).map(([kind, title]) => {
    const groups = [];
    for (const event of all) {
      const place = of(event);
      if (event.what !== kind || place < 0 || place > 1) continue;
      const last = groups.at(-1);
      if (last && place - last.to < CLOSE) {
        last.to = place;
        last.events.push(event);
      } else {
        groups.push({ from: place, to: place, events: [event] });
      }
    }
    return { kind, title, groups };
  });
  const text = JSON.stringify(drawn.map(({ groups }) => groups.map(({ from, events }) => [Math.round(1000 * from), events])));
  if (text === $("lanes").dataset.drawn) return;
  $("lanes").dataset.drawn = text;
  const hadFocus = $("lanes").contains(document.activeElement) && document.activeElement.dataset.at;
  $("lanes").replaceChildren(...drawn.map(({ kind, title, groups }) =>
    tools.el("div", { class: `lane ${kind}` }, tools.el("span", {}, title), tools.el("div", {}, ...groups.map(mark)))));
  const marks = [...$("lanes").querySelectorAll(".mark")];
  const kept = marks.find((one) => one.dataset.at === hadFocus);
  const stop = kept ?? marks.at(-1);
  if (stop) stop.tabIndex = 0;
  kept?.focus();
}

function mark({ from, to, events }) {
  const words = events.slice(-8).map(({ at, text }) => `${tools.moment(at)} ${text}`);
  if (events.length > words.length) words.unshift(`${events.length - words.length} more`);
  const { at } = events.at(-1);
  const made = tools.el("button", { type: "button", class: "mark", tabindex: -1, title: words.join("\n"), "aria-label": words.join(", "), "data-at": at,
    onclick: () => {
      // The state after it, and what it changed.
      [chosen.at, chosen.with] = [1000 * at + 1000, 1000 * events[0].at - 1000];
      place();
      readPast();
    } });
  made.style.left = `${100 * from}%`;
  made.style.width = `max(8px, ${100 * (to - from)}% + 8px)`;
  return made;
}

let turn = Promise.resolve();

/** Requests what comes from the log, one thing at a time: rosrescue refuses a second reader. */
export function fetchLog(url) {
  const answer = turn.then(() => fetch(url));
  turn = answer.catch(() => {});
  return answer;
}

/** Whether both moments are now. */
const isLive = () => chosen.at === null && chosen.with === null;

function choose(name, at) {
  chosen[name] = at;
  place(name);
  readPast();
}

/** What the sliders span, in milliseconds. */
const span = () => 1000 * $("time-span").value;

/** Puts the sliders where the chosen moments are. The one that is being dragged is there already. */
function place(dragged) {
  if (isLive()) end = 1000 * tools.robotTime();
  for (const name of SLIDERS) {
    const at = chosen[name] ?? end;
    if (dragged !== name) $(`time-${name}`).value = Math.max(0, STEPS - (STEPS * (end - at)) / span());
    $(`time-${name}`).setAttribute("aria-valuetext", chosen[name] === null ? "now" : tools.moment(at / 1000));
    if (document.activeElement !== $(`clock-${name}`)) $(`clock-${name}`).value = local(at);
  }
  showMarks();
}

/** The text of a moment in a field of the type datetime-local. */
function local(at) {
  const offset = 60000 * new Date(at).getTimezoneOffset();
  return new Date(at - offset).toISOString().slice(0, 19);
}

const text = (at) => (at === null ? "now" : new Date(at).toISOString());

/** The query for a part of the state that is shown. */
export const query = () => (past ? { at: past.asked } : {});

/** Reads the chosen moments; also when the present state has changed, because one of them may be now. */
export async function readPast() {
  if (reading) {
    again = true;
    return;
  }
  if (isLive()) return show(null);
  [reading, again] = [true, false];
  const asked = text(chosen.at);
  try {
    const answer = await fetchLog(`/state.json?${new URLSearchParams({ at: asked, with: text(chosen.with) })}`);
    if (answer.ok) show({ ...(await answer.json()), asked });
    else if (answer.status === 503) again = true;
    else {
      show({ ...NOTHING, asked });
      tools.say("time-note", (await answer.text()).trim());
    }
  } catch {
    // The page shows that rosrescue does not answer. The next change asks again.
  }
  setTimeout(() => {
    reading = false;
    if (again) readPast();
  }, again ? PAUSE : 0);
}

function show(state) {
  const wasLive = !past && !changed.size;
  past = state && state.asked !== "now" ? state : null;
  // The log does not say whether a node lived.
  for (const node of past?.nodes ?? []) node.health = "registered";
  changed = new Set((state?.changes ?? []).flatMap(keys));
  document.body.classList.toggle("past", Boolean(past));
  const last = past?.at ? `, last changed ${tools.moment(past.at)}` : "";
  const shown = past ? `NOT LIVE: the state of ${tools.moment(Date.parse(past.asked) / 1000)}${last}` : "live";
  const missing = state && !state.exact ? "; some changes are missing from the log" : "";
  const begun = state?.oldest ? `; the log begins ${tools.moment(state.oldest)}` : "";
  tools.say("time-note", shown + missing + (past ? begun : ""));
  const list = state?.changes ?? [];
  const left = Math.max(0, list.length - LISTED) + (state?.more_changes ?? 0);
  const items = list.slice(0, LISTED).map((change) => tools.el("li", {}, change.text));
  if (left > 0) items.push(tools.el("li", { class: "quiet" }, `${left} more: rosrescue diff shows all`));
  if (state && !items.length) items.push(tools.el("li", { class: "quiet" }, "no difference between the two moments"));
  $("time-changes").replaceChildren(...items);
  if (!wasLive || past || changed.size) tools.redraw();
}

/** What a difference marks. */
function keys({ what, name, node, registrations }) {
  if (what === "node") {
    const kinds = { publishes: "topic", subscribes: "topic", provides: "service" };
    const of = registrations.map((registration) => registration.split(" "));
    return [`node ${name}`, ...of.filter(([verb]) => kinds[verb]).map(([verb, of]) => `${kinds[verb]} ${of}`), ...of.map(([, of]) => `line ${name} ${of}`)];
  }
  if (what === "publisher" || what === "subscriber") return [`topic ${name}`, `node ${node}`, `line ${node} ${name}`];
  if (what === "param_subscriber") return [`node ${node}`];
  if (what === "topic_type") return [`topic ${name}`];
  if (what === "service") return [`service ${name}`];
  const parts = name.split("/");
  return parts.slice(1).map((_, index) => `param ${parts.slice(0, index + 2).join("/")}`);
}
