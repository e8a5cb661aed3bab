// The overview: a tile for each node, by namespace.

/** A namespace with more nodes has the whole width. */
const WIDE = 40;

/** Says beside the name of each namespace how many of its nodes are dead or unreachable. */
export function countIll(picture, { boxes, spaces }) {
  const health = new Map(boxes.map((box) => [box.name, box.health]));
  for (const [space, names] of spaces) {
    const texts = ["dead", "unreachable"].map((is) => [names.filter((name) => health.get(name) === is).length, is]);
    const text = texts.filter(([count]) => count).map(([count, is]) => `${count} ${is}`).join(", ");
    const note = picture.querySelector(`[data-fold="${CSS.escape(space)}"] + small`);
    if (note && note.textContent !== text) note.textContent = text;
  }
}

/** The tiles of `graph.spaces`, which are folded where `folds` says so. Their colours are those of `dress`. */
export function tiles(el, graph, folds) {
  const spaces = graph.spaces.map(([space, names]) => {
    const isFolded = folds.get(space) ?? false;
    const title = space || "other nodes";
    const head = el("button", { type: "button", class: "fold", tabindex: -1, "data-fold": space, "aria-expanded": String(!isFolded) },
      `${isFolded ? "▸" : "▾"} ${title} (${names.length})`);
    const items = names.map((name) =>
      el("button", { type: "button", class: "box", tabindex: -1, "data-key": `node ${name}`, "data-node": name }, name.slice(space ? space.length + 1 : 0)));
    return el("section", { class: names.length > WIDE ? "space wide" : "space", "aria-label": title }, el("h3", {}, head, " ", el("small", {})), el("div", { class: "tiles" }, ...(isFolded ? [] : items)));
  });
  if (!spaces.length) return el("p", { class: "quiet" }, "nothing to show");
  return el("div", { class: "overview" }, ...spaces);
}
