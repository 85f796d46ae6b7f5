// Where the user looks: tab, run, model, frame and selected frames. They outlive a change of tab, and the address has them, so
// that a link opens the same view.

import { store, update, watch } from "./store.js";
import { TABS } from "./tabs.js";

const WRITE_MS = 300; // after the last change: browsers limit how often an address may be written
const KEYS = ["tab", "run", "shown", "background"]; // nothing that starts work
const place = { at: null, spans: {} }; // frame of a film {run, frame}; selected frames by run: [[from, to], ...]
let timer = null, written = "";

/** The place as text after the # of the address. */
function text() {
  const query = new URLSearchParams(KEYS.filter((key) => store[key]).map((key) => [key, store[key]]));
  if (place.at) query.set("frame", `${place.at.frame}@${place.at.run}`);
  for (const [run, spans] of Object.entries(place.spans)) query.append("select", `${spans.map((ends) => ends.join("-")).join(",")}@${run}`);
  return `#${query}`;
}

function write() {
  clearTimeout(timer);
  timer = setTimeout(() => {
    written = text();
    if (written !== location.hash) history.replaceState(null, "", `${location.pathname}${location.search}${written}`);
  }, WRITE_MS);
}

/** Split "10-40,50-60@fast" at its first @. */
const split = (one) => [one.slice(0, one.indexOf("@")), one.slice(one.indexOf("@") + 1)];

function read() {
  if (location.hash.length < 2 || location.hash === written) return;
  const query = new URLSearchParams(location.hash.slice(1)), frame = query.get("frame");
  const [number, run] = frame ? split(frame) : [];
  place.at = /^\d+$/.test(number) ? { run, frame: Number(number) } : null;
  place.spans = {};
  for (const [spans, name] of query.getAll("select").map(split)) {
    const ends = spans.split(",").map((one) => one.split("-").map(Number)).filter(([from, to]) => to >= from);
    if (ends.length) place.spans[name] = ends;
  }
  if (!TABS.some(({ name }) => name === query.get("tab"))) query.delete("tab");
  update({ ...Object.fromEntries(KEYS.filter((key) => query.get(key)).map((key) => [key, query.get(key)])), jumps: (store.jumps || 0) + 1 });
}

/** Follow the address, and write it when the user goes elsewhere. */
export function followAddress() {
  read();
  addEventListener("hashchange", read);
  watch(write);
}

/** Selected frames by run, as spans. */
function spansOf(view) {
  const found = {};
  for (const row of view.chosen.subarray(0, view.count)) {
    const run = view.runAt(row), frame = view.frameAt(row), spans = (found[run?.name] ||= []), last = spans.at(-1);
    if (last?.[1] === frame - 1) last[1] = frame;
    else spans.push([frame, frame]);
  }
  return found;
}

/** Show the frame and the selection again in a view, then note every change of them. */
export function keepPlace({ view, filmView }) {
  const film = filmView.films.get(place.at?.run), mask = new Uint8Array(view.rows), runs = view.runs;
  if (film) filmView.setFilm(film, place.at.frame), filmView.show(place.at.frame);
  for (const run of runs) {
    for (const [from, to] of place.spans[run.name] || []) {
      const first = run.first + from - (run.frame || 0), last = run.first + to - (run.frame || 0);
      if (last >= run.first) mask.fill(1, Math.max(first, run.first), Math.min(last + 1, run.first + run.count));
    }
  }
  if (mask.includes(1)) view.select(mask);
}

/** Note the frame and the selection of a view; returns a function that ends this. */
export function notePlace(view) {
  const select = () => {
    const others = Object.entries(place.spans).filter(([name]) => !view.runs.some((run) => run.name === name));
    place.spans = { ...Object.fromEntries(others), ...spansOf(view) };
    write();
  };
  const ends = [view.on("frame", (at) => ((place.at = at), write())), view.on("selection", select)];
  return () => ends.forEach((end) => end());
}
