// The time line: the state at an earlier moment, and what differs between two moments. The answers come from
// `/state.json?at=…&with=…`.

const $ = (id) => document.getElementById(id);
/** Steps of a slider. */
const STEPS = 2000;
/** Pause before another try while rosrescue reads another state, in milliseconds. */
const PAUSE = 300;
/** Changes that are listed. */
const LISTED = 100;
const SLIDERS = ["at", "with"];
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

/** Begins with functions of the page. `tools.redraw` is called when `past` or `changed` has another value. */
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
  });
  $("time-now").addEventListener("click", () => {
    [chosen.at, chosen.with] = [null, null];
    place();
    readPast();
  });
  place();
  setInterval(() => isLive() && place(), 1000);
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
    const answer = await fetch(`/state.json?${new URLSearchParams({ at: asked, with: text(chosen.with) })}`);
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
