// What plots, legend and film share: rows, columns, runs, selection, cursor, hidden runs and curves.
//
// A scene is {rows, columns, runs: [{name, first, count, index, frame, tracks}], plots: [...]}; a row is a frame of a run.
// `plot_data.py` describes plots and layers.

import { sameColumn } from "./packed.js";
import { valueText } from "./axis.js";

const EMPTY = new Float32Array();

export class LinkedView {
  constructor({ frame } = {}) {
    this.frame = frame; // (film, number) -> Promise<ImageBitmap>
    this.calls = new Map();
    this.hiddenRuns = new Set();
    this.hiddenLayers = new Set();
    this.mode = "select"; // what a drag does in a plot: "select" or "zoom"
    this.films = new Map();
    this.clear();
  }

  clear() {
    Object.assign(this, { scene: { rows: 0, runs: [], plots: [] }, columns: {}, rows: 0, runs: [], candidate: null });
    this.resize(0);
  }

  resize(rows) {
    this.rows = rows;
    this.mask = new Uint8Array(rows); // 1 where a row is selected
    this.before = new Uint8Array(rows); // the selection when the drag began
    this.inside = new Uint8Array(rows); // rows in the dragged box
    this.chosen = new Int32Array(rows); // numbers of the selected rows; `count` of them
    this.count = 0;
    this.cursor = this.anchor = null;
    this.pinned = false;
  }

  // --- who listens

  on(name, call) {
    if (!this.calls.has(name)) this.calls.set(name, new Set());
    this.calls.get(name).add(call);
    return () => this.calls.get(name).delete(call);
  }

  say(name, value) {
    for (const call of [...(this.calls.get(name) || [])]) call(value);
  }

  // --- data

  column(key) { return this.columns[key] || EMPTY; }

  /** Columns that did not change stay the same arrays, so that what was drawn from them need not be drawn again. */
  setScene(scene, columns) {
    const rowsOfRuns = () => JSON.stringify(this.runs.map((run) => [run.name, run.first, run.count]));
    const old = this.columns, before = rowsOfRuns();
    const kept = (key, column) => (sameColumn(old[key], column) ? old[key] : column);
    this.columns = Object.fromEntries(Object.entries(columns).map(([key, column]) => [key, kept(key, column)]));
    this.scene = { plots: [], ...scene };
    this.runs = scene.runs || [];
    this.candidate = null;
    const same = scene.rows === this.rows && rowsOfRuns() === before;
    if (!same) {
      this.resize(scene.rows || 0);
      this.hiddenRuns = new Set([...this.hiddenRuns].filter((name) => this.runs.some((run) => run.name === name)));
      if (this.runs.every((run) => this.hiddenRuns.has(run.name))) this.hiddenRuns.clear();
    }
    this.say("scene");
    if (!same) this.announce();
  }

  /** Draw a candidate over the current model: its residual "with" and its force "F_with". */
  setCandidate(columns, about = {}) {
    this.candidate = columns ? { columns, ...about } : null;
    this.say("candidate");
  }

  // --- hidden runs and curves

  shows(run) { return !this.hiddenRuns.has(run.name); }

  get visibleRuns() { return this.runs.filter((run) => this.shows(run)); }

  hide(name) {
    if (!this.hiddenRuns.delete(name)) this.hiddenRuns.add(name);
    this.applyHidden();
  }

  /** Show one run alone; a second time, or null, shows all again. */
  isolate(name) {
    const alone = name !== null && this.visibleRuns.length === 1 && this.visibleRuns[0].name === name;
    this.hiddenRuns = new Set(name === null || alone ? [] : this.runs.map((run) => run.name).filter((other) => other !== name));
    this.applyHidden();
  }

  hideLayer(name) {
    if (!this.hiddenLayers.delete(name)) this.hiddenLayers.add(name);
    this.applyHidden();
  }

  isolateLayer(name, all) {
    const others = all.filter((other) => other !== name);
    const alone = !this.hiddenLayers.has(name) && others.every((other) => this.hiddenLayers.has(other));
    this.hiddenLayers = new Set(alone ? [] : others);
    this.applyHidden();
  }

  /** What is hidden cannot be selected. */
  applyHidden() {
    for (const run of this.runs) if (!this.shows(run)) this.mask.fill(0, run.first, run.first + run.count);
    this.collect();
    this.say("hidden", { runs: [...this.hiddenRuns], layers: [...this.hiddenLayers] });
    this.announce();
  }

  // --- selection

  beginBrush() { this.before.set(this.mask); }

  /** Select while dragging. `fill` writes the rows of the box into a mask; `how` is "replace", "add" or "subtract". */
  brush(fill, how) {
    const { mask, before, inside } = this;
    inside.fill(0);
    fill(inside);
    if (how === "add") for (let i = 0; i < mask.length; i++) mask[i] = before[i] | inside[i];
    else if (how === "subtract") for (let i = 0; i < mask.length; i++) mask[i] = before[i] & ~inside[i];
    else mask.set(inside);
    this.collect();
    this.say("marks");
  }

  cancelBrush() {
    this.mask.set(this.before);
    this.collect();
    this.say("marks");
  }

  /** Select the rows of a mask; null clears. */
  select(mask) {
    if (mask) this.mask.set(mask);
    else this.mask.fill(0);
    this.collect();
    this.say("marks");
    this.announce();
  }

  collect() {
    let n = 0;
    for (let i = 0; i < this.mask.length; i++) if (this.mask[i]) this.chosen[n++] = i;
    this.count = n;
  }

  get perRun() {
    const found = {};
    for (const run of this.runs) {
      let n = 0;
      for (let i = run.first; i < run.first + run.count; i++) n += this.mask[i];
      if (n) found[run.name] = n;
    }
    return found;
  }

  /** Tell the selection; the middle is that of the rows selected in the run under the cursor. */
  announce() {
    const at = this.cursor === null ? null : this.runAt(this.cursor), per_run = this.perRun;
    const run = at && per_run[at.name] ? at : this.runs.find((other) => per_run[other.name]) || at;
    const rows = this.chosen.subarray(0, this.count).filter((row) => run && row >= run.first && row < run.first + run.count);
    const middle = rows.length ? rows[rows.length >> 1] : null;
    this.say("selection", { count: this.count, per_run, middle, run: at ? at.name : null, frame: at ? this.frameAt(this.cursor) : null });
  }

  // --- cursor

  runAt(row) { return this.runs.find((run) => row >= run.first && row < run.first + run.count) || null; }

  frameAt(row) {
    const run = this.runAt(row);
    return run ? row - run.first + (run.frame || 0) : row;
  }

  /** Row of a frame of a run; null where the motion has not begun or has ended. */
  rowOf(name, frame) {
    const run = this.runs.find((other) => other.name === name), at = run ? frame - (run.frame || 0) : -1;
    return run && at >= 0 && at < run.count ? run.first + at : null;
  }

  /** Move the cursor. `by` says who did: "hover", "click", "key" or "film". */
  point(row, by = "click") {
    if (row === null || row === undefined || (by === "hover" && this.pinned)) return;
    if (by === "click") this.pinned = !(this.pinned && row === this.cursor);
    if (by !== "hover") this.anchor = row;
    if (row === this.cursor && by === "hover") return;
    this.cursor = row;
    const run = this.runAt(row);
    this.say("cursor", { row, run: run && run.name, frame: this.frameAt(row), words: this.describe(row), by });
  }

  release() {
    this.pinned = false;
    this.say("marks");
  }

  /** Step along the rows of the visible runs; with `extend`, select from where the steps began. */
  step(by, extend) {
    const visible = (row) => { const run = this.runAt(row); return !run || this.shows(run); };
    const from = this.cursor ?? 0, anchor = this.anchor ?? from;
    let row = Math.min(Math.max(from + by, 0), this.rows - 1);
    while (row > 0 && row < this.rows - 1 && !visible(row)) row += Math.sign(by);
    if (!this.rows || !visible(row)) return;
    this.point(row, "key");
    if (!extend) return;
    this.anchor = anchor;
    this.mask.fill(0);
    for (let i = Math.min(anchor, row); i <= Math.max(anchor, row); i++) this.mask[i] = visible(i) ? 1 : 0;
    this.collect();
    this.say("marks");
    this.announce();
  }

  /** Run, frame and values at a row, as a sentence. */
  describe(row) {
    const run = this.runAt(row), seen = new Set(), words = run ? [`${run.name}, frame ${this.frameAt(row)}`] : [];
    const add = (key, label, unit) => {
      const column = this.columns[key];
      if (seen.has(key) || !column || column.length !== this.rows) return;
      seen.add(key);
      words.push(`${label} ${valueText(column[row], unit)}`);
    };
    for (const plot of this.scene.plots) {
      add(plot.x.column, plot.x.name, plot.x.unit);
      for (const { y, label } of plot.layers.filter((layer) => layer.y)) {
        add(y, label && !label.startsWith(plot.y.name) ? `${label} ${plot.y.name}` : plot.y.name, plot.y.unit);
      }
    }
    return words.join(" \u00b7 ");
  }

  setMode(mode) {
    this.mode = mode;
    this.say("mode", mode);
  }
}
