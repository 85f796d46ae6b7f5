// Where the user looks: tab, run, model, frame, selected frames, hidden runs, order and zoom of the plots. They outlive a change
// of tab, and the address has them, so that a link opens the same view.

import { store, update, watch } from "./store.js";
import { TABS } from "./tabs.js";

const WRITE_MS = 300; // after the last change: browsers limit how often an address may be written
const KEYS = ["tab", "run", "shown", "background"]; // nothing that starts work
const LAYOUTS_KEY = "frictrack.layouts";
const place = {
  at: null, // frame of a film {run, frame}
  spans: {}, // selected frames by run: [[from, to], ...]
  hidden: [], // runs
  layouts: JSON.parse(localStorage.getItem(LAYOUTS_KEY) || "{}"), // by tab: {order, alone}, titles of plots
  zooms: {}, // by tab: {x, y}, each {name: [low, high]}, see PlotGrid.zooms; not kept for the next study
};
const AXES = ["x", "y"], DIGITS = 7; // of a zoom in the address
let timer = null, written = "";

/** The place as text after the # of the address. */
function text() {
  const query = new URLSearchParams(KEYS.filter((key) => store[key]).map((key) => [key, store[key]]));
  if (place.at) query.set("frame", `${place.at.frame}@${place.at.run}`);
  for (const [run, spans] of Object.entries(place.spans)) query.append("select", `${spans.map((ends) => ends.join("-")).join(",")}@${run}`);
  for (const run of place.hidden) query.append("hide", run);
  const { order, alone } = place.layouts[store.tab] || {};
  if (order?.length) query.set("order", order.join(","));
  if (alone) query.set("alone", alone);
  for (const [axis, ranges] of Object.entries(place.zooms[store.tab] || {})) {
    for (const [name, ends] of Object.entries(ranges)) query.append(axis, `${ends.map((end) => +end.toPrecision(DIGITS))}@${name}`);
  }
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
  place.hidden = query.getAll("hide");
  const zoomed = (axis) => query.getAll(axis).map(split).map(([ends, name]) => [name, ends.split(",").map(Number)]);
  const ranges = (axis) => [axis, Object.fromEntries(zoomed(axis).filter(([, [low, high]]) => low < high))];
  place.zooms[query.get("tab") || store.tab] = Object.fromEntries(AXES.map(ranges));
  place.layouts[query.get("tab") || store.tab] = { order: query.get("order")?.split(","), alone: query.get("alone") };
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

/** Show the frame, the selection, the hidden runs, the order and the zoom of the plots again in a view. */
export function keepPlace({ view, filmView, grid }) {
  const { zooms } = place, { tab, jumps = 0 } = store;
  grid.setLayout(place.layouts[tab] || {});
  if (grid.plots.length) {
    if (grid.jumps !== jumps && zooms[tab]) grid.zooms = zooms[tab]; // once: new data may end a zoom
    grid.jumps = jumps;
    zooms[tab] = grid.zooms;
    write(); // without the zoom that they ended
  }
  const hidden = place.hidden.filter((name) => view.runs.some((run) => run.name === name));
  if (hidden.length < view.runs.length && String(hidden) !== String([...view.hiddenRuns])) {
    view.hiddenRuns = new Set(hidden);
    view.applyHidden();
  }
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

/** Note every change of them; returns a function that ends this. */
export function notePlace(view) {
  const elsewhere = (name) => !view.runs.some((run) => run.name === name);
  const notes = {
    frame: (at) => { place.at = at; },
    selection: () => { place.spans = { ...Object.fromEntries(Object.entries(place.spans).filter(([name]) => elsewhere(name))), ...spansOf(view) }; },
    hidden: ({ runs }) => { place.hidden = [...place.hidden.filter(elsewhere), ...runs]; },
    zoom: (zooms) => { place.zooms[store.tab] = zooms; },
    layout: (layout) => {
      place.layouts[store.tab] = layout;
      localStorage.setItem(LAYOUTS_KEY, JSON.stringify(place.layouts));
    },
  };
  const ends = Object.entries(notes).map(([name, note]) => view.on(name, (value) => { note(value); write(); }));
  return () => ends.forEach((end) => end());
}
