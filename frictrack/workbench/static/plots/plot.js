// One plot: three canvases above each other, so that a selection or the cursor is drawn without drawing the data again.
//   base   axes, bands, lines, points        drawn when data, zoom, size, theme or hidden curves change
//   marks  the candidate, selected points    drawn when they change
//   top    cursor, dragged box, handles

import { Axis, tickText, ticks, valueText } from "./axis.js";
import { Listeners, make, OncePerFrame } from "./dom.js";
import { cellsOf, paint } from "./dots.js";
import { drawBand, drawLine, drawSpan } from "./layers.js";
import { PlotInput } from "./plot_input.js";

const SPACE = { left: 72, narrow: 58, right: 12, top: 24, bottom: 36 };
const NARROW_WIDTH = 290, TICK_ROOM = 28; // px; the second: the name of the axis and a gap
const FEW_ROWS = 4000, LABEL_HEIGHT = 22; // px
const HELP = "Arrow keys move the cursor along the data, with shift they select; + and \u2212 zoom, 0 shows all, escape clears.";

export class Plot {
  constructor(grid, spec) {
    Object.assign(this, { grid, view: grid.view, colours: grid.colours, zoom: {}, box: null, cells: new Map() });
    this.canvases = ["base", "marks", "top"].map((name) => make("canvas", { class: `fp-${name}`, "aria-hidden": name === "top" ? null : "true" }));
    [this.base, this.marks, this.top] = this.canvases;
    this.larger = make("button", { type: "button", class: "fp-button fp-enlarge" }, "\u2922");
    this.handle = make("button", { type: "button", class: "fp-button fp-move", title: "Drag to another place, or press the arrow keys; a double click restores the order" }, "\u283f");
    this.el = make("div", { class: "fp-plot" }, ...this.canvases, this.handle, this.larger);
    this.listeners = new Listeners();
    this.listenToHandle();
    this.listeners.on(this.larger, "click", () => grid.enlarge(this));
    this.each = {
      base: new OncePerFrame(() => this.draw()),
      marks: new OncePerFrame(() => this.drawMarks()),
      top: new OncePerFrame(() => this.drawTop()),
    };
    this.listeners.resized(this.el, () => this.resize());
    this.setSpec(spec);
    this.input = new PlotInput(this);
  }

  destroy() {
    this.listeners.destroy();
    for (const each of Object.values(this.each)) each.cancel();
    for (const canvas of this.canvases) canvas.width = canvas.height = 0; // frees the memory at once
    this.el.remove();
  }

  /** The handle moves this plot to where it is dropped, or by the arrow keys. */
  listenToHandle() {
    const { listeners, handle, grid } = this, held = (on) => this.el.classList.toggle("fp-held", on);
    const move = (to) => { grid.move(this, to); handle.focus(); }; // a plot that is put elsewhere loses the focus
    listeners.on(handle, "pointerdown", (e) => { handle.setPointerCapture(e.pointerId); held(true); });
    listeners.on(handle, "pointerup", (e) => {
      held(false);
      move(handle.getRootNode().elementFromPoint(e.clientX, e.clientY)?.closest(".fp-plot"));
    });
    listeners.on(handle, "pointercancel", () => held(false));
    listeners.on(handle, "dblclick", () => grid.change({ order: [] }));
    listeners.on(handle, "keydown", (e) => {
      const by = { ArrowLeft: -1, ArrowUp: -1, ArrowRight: 1, ArrowDown: 1 }[e.key];
      if (!by) return;
      e.preventDefault();
      move(by);
    });
  }

  // --- data

  /** Take a new description; draw again only if something in this plot is different. */
  setSpec(spec) {
    const before = this.spec, columns = this.columnsUsed(spec);
    const text = JSON.stringify(spec);
    const same = before && text === this.text && columns.every((column, i) => column === this.used[i]);
    this.spec = structuredClone(spec);
    Object.assign(this, { text, used: columns });
    this.top.setAttribute("role", "application");
    this.top.setAttribute("tabindex", "0");
    this.top.setAttribute("aria-roledescription", "plot");
    this.top.setAttribute("aria-label", `${spec.title}: ${spec.y.label} against ${spec.x.label}. ${HELP}`);
    this.handle.setAttribute("aria-label", `Move ${spec.title}`);
    this.larger.setAttribute("aria-label", `Enlarge ${spec.title}`);
    this.larger.title = "Show this plot alone, or all again";
    if (same) return this.ask("marks", "top");
    const home = this.home();
    if (before && (before.x.label !== spec.x.label || this.homeAxes?.x.changedMuch(home.x))) this.zoom.x = null;
    if (before && (before.y.label !== spec.y.label || this.homeAxes?.y.changedMuch(home.y))) this.zoom.y = null;
    this.homeAxes = home;
    this.ask("base", "marks", "top");
  }

  columnsUsed(spec) {
    const keys = spec.layers.flatMap((layer) => [layer.x || spec.x.column, layer.y, layer.low, layer.high]);
    return keys.map((key) => this.view.columns[key]);
  }

  column(key) { return this.view.column(key); }

  xOf(layer) { return this.column(layer.x || this.spec.x.column); }

  get shown() { return this.spec.layers.filter((layer) => !this.view.hiddenLayers.has(layer.name)); }

  linked(layer) { return ["dots", "line"].includes(layer.kind) && this.column(layer.y).length === this.view.rows && this.view.rows > 0; }

  /** The layer whose points are selected. */
  get main() {
    const linked = this.shown.filter((layer) => this.linked(layer));
    return linked.find((layer) => layer.main) || linked[0] || null;
  }

  /** Axes that show all visible data; values outside `focus` do not count for the y axis. */
  home() {
    const range = { x: [Infinity, -Infinity], y: [Infinity, -Infinity] }, { focus } = this.spec;
    const widen = (axis, v) => { if (v < axis[0]) axis[0] = v; if (v > axis[1]) axis[1] = v; };
    const hidden = this.view.runs.filter((run) => !this.view.shows(run));
    for (const layer of this.shown.filter((one) => one.kind !== "span" && !one.loose)) {
      const xs = this.xOf(layer);
      for (const key of layer.kind === "band" ? [layer.low, layer.high] : [layer.y]) {
        const ys = this.column(key), gaps = ys.length === this.view.rows ? hidden : [];
        for (let i = 0; i < ys.length; i++) {
          const gap = gaps.find((run) => i === run.first);
          if (gap) { i += gap.count - 1; continue; }
          if (ys[i] !== ys[i]) continue;
          widen(range.x, xs[i]);
          if (!focus || (xs[i] >= focus[0] && xs[i] <= focus[1])) widen(range.y, ys[i]);
        }
      }
    }
    return { x: Axis.around(range.x, 0.02), y: Axis.around(range.y, 0.06) };
  }

  /** Show another part; null shows all. */
  look(zoom) {
    this.zoom = zoom || {};
    this.ask("base", "marks", "top");
  }

  /** An axis over [low, high], null if no data are there. */
  part(axis, ends) { return ends?.[0] < this.homeAxes[axis].high && ends[1] > this.homeAxes[axis].low ? new Axis(...ends) : null; }

  // --- drawing

  ask(...names) { for (const name of names) this.each[name].ask(); }

  /** After the visible data have changed. */
  rescale() {
    this.homeAxes = this.home();
    this.ask("base", "marks", "top");
  }

  recolour() {
    this.colours = this.grid.colours;
    this.ask("base", "marks", "top");
  }

  resize() {
    const { width, height } = this.el.getBoundingClientRect(), ratio = window.devicePixelRatio || 1;
    if (!width || !height) return;
    this.size = { width, height, ratio };
    for (const canvas of this.canvases) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    for (const each of Object.values(this.each)) each.cancel();
    this.draw();
    this.drawMarks();
    this.drawTop();
  }

  get inner() {
    const { width, height } = this.size, left = Math.max(width < NARROW_WIDTH ? SPACE.narrow : SPACE.left, this.wide || 0);
    return { x: left, y: SPACE.top, w: Math.max(width - left - SPACE.right, 8), h: Math.max(height - SPACE.top - SPACE.bottom, 8) };
  }

  /** The inner rectangle in pixels of the screen. */
  get raster() {
    const { ratio } = this.size, { x, y, w, h } = this.inner;
    return { left: Math.round(x * ratio), top: Math.round(y * ratio), width: Math.round(w * ratio), height: Math.round(h * ratio), ratio };
  }

  get axes() {
    const { x, y, w, h } = this.inner, axes = { x: this.zoom.x || this.homeAxes.x, y: this.zoom.y || this.homeAxes.y };
    axes.x.on(x, x + w);
    axes.y.on(y + h, y);
    return axes;
  }

  pen(canvas) {
    const pen = canvas.getContext("2d", { willReadFrequently: true });
    pen.setTransform(this.size.ratio, 0, 0, this.size.ratio, 0, 0);
    pen.clearRect(0, 0, this.size.width, this.size.height);
    pen.font = this.colours.small;
    return pen;
  }

  /** Ticks of the y axis; the room at the left fits the longest of them. */
  upTicks(pen) {
    const { h } = this.inner, { low, high } = this.zoom.y || this.homeAxes.y, up = ticks(low, high, h / 36);
    this.wide = TICK_ROOM + Math.max(...up.values.map((v) => pen.measureText(tickText(v, up.step)).width));
    return up;
  }

  draw() {
    if (!this.size) return;
    const pen = this.pen(this.base), up = this.upTicks(pen), { x, y, w, h } = this.inner;
    pen.fillStyle = this.colours.raised;
    pen.fillRect(0, 0, this.size.width, this.size.height);
    this.drawAxes(pen, up);
    pen.save();
    pen.beginPath();
    pen.rect(x, y, w, h);
    pen.clip();
    for (const layer of this.shown) {
      if (layer.kind === "span") drawSpan(pen, this, layer);
      else if (layer.kind === "band") drawBand(pen, this, layer);
      else if (layer.kind === "line") drawLine(pen, this, layer, this.xOf(layer), this.column(layer.y));
    }
    pen.restore();
    this.drawDots(pen);
  }

  drawAxes(pen, up) {
    const { x, y, w, h } = this.inner, { axes, colours } = this;
    const across = ticks(axes.x.low, axes.x.high, w / 80);
    Object.assign(pen, { strokeStyle: colours.grid, fillStyle: colours.muted, textAlign: "center", lineWidth: 1 });
    pen.beginPath();
    for (const v of across.values) {
      const px = Math.round(axes.x.px(v)) + 0.5;
      pen.moveTo(px, y); pen.lineTo(px, y + h);
      pen.fillText(tickText(v, across.step), px, y + h + 15);
    }
    pen.textAlign = "right";
    for (const v of up.values) {
      const py = Math.round(axes.y.px(v)) + 0.5;
      pen.moveTo(x, py); pen.lineTo(x + w, py);
      pen.fillText(tickText(v, up.step), x - 6, py + 4);
    }
    pen.stroke();
    pen.strokeStyle = colours.line;
    pen.strokeRect(x + 0.5, y + 0.5, w - 1, h - 1);
    pen.textAlign = "center";
    pen.fillText(this.spec.x.label, x + w / 2, y + h + 31);
    pen.save();
    pen.translate(13, y + h / 2);
    pen.rotate(-Math.PI / 2);
    pen.fillText(this.spec.y.label, 0, 0, h + SPACE.top);
    pen.restore();
    Object.assign(pen, { textAlign: "left", fillStyle: colours.ink, font: `600 ${colours.small}` });
    pen.fillText(this.spec.title, x, 16, w);
    pen.font = colours.small;
  }

  /** Size of a point, px: larger where there are few. */
  get dot() { return this.view.rows < FEW_ROWS ? 2.5 : 1.5; }

  /** Cells of a layer, kept until its columns, the axes or the size change. */
  cellsOf(name, xs, ys, dot) {
    const { axes, raster } = this, size = Math.max(1, Math.round(dot * raster.ratio));
    const key = [axes.x.low, axes.x.high, axes.y.low, axes.y.high, raster.width, raster.height, size].join();
    const kept = this.cells.get(name);
    if (kept && kept.xs === xs && kept.ys === ys && kept.key === key) return kept;
    const found = { xs, ys, key, size, cells: cellsOf(xs, ys, axes, raster, size, kept?.cells) };
    this.cells.set(name, found);
    return found;
  }

  drawDots(pen) {
    const layers = this.shown.filter((layer) => layer.kind === "dots"), { left, top, width, height } = this.raster;
    if (!layers.length) return;
    const image = pen.getImageData(left, top, width, height), pixels = new Uint32Array(image.data.buffer);
    for (const layer of layers) {
      const ys = this.column(layer.y), { cells, size } = this.cellsOf(layer.y, this.xOf(layer), ys, this.dot);
      const draw = (from, to, run) => {
        const css = layer.by_run && run ? this.colours.ofRun(run.index) : this.colours[layer.colour];
        paint(pixels, width, cells, { from, to, size, colour: this.colours.packedOf(css) });
      };
      if (ys.length !== this.view.rows || !this.view.runs.length) draw(0, ys.length, null);
      else for (const run of this.view.visibleRuns) draw(run.first, run.first + run.count, run);
    }
    pen.putImageData(image, left, top);
  }

  drawMarks() {
    if (!this.size) return;
    const pen = this.pen(this.marks), { main, view, colours } = this, over = this.candidateCurve();
    const { left, top, width, height } = this.raster;
    if ((main && view.count) || over) {
      const image = pen.createImageData(width, height), pixels = new Uint32Array(image.data.buffer);
      if (over?.kind === "dots") this.paintCandidate(pixels, over);
      if (main && view.count) {
        const { cells, size } = this.cellsOf("chosen", this.xOf(main), this.column(main.y), this.dot + 1);
        paint(pixels, width, cells, { to: view.count, rows: view.chosen, size, colour: colours.packedOf(colours.select) });
      }
      pen.putImageData(image, left, top);
    }
    if (over) this.drawCandidate(pen, over);
  }

  /** The candidate's curve in this plot, beside the layer of the current model. */
  candidateCurve() {
    const { candidate, hiddenLayers, rows } = this.view;
    if (!candidate || hiddenLayers.has("candidate")) return null;
    const layer = this.spec.layers.find((one) => candidate.columns[one.candidate]?.length === rows);
    return layer ? { kind: layer.kind, xs: this.xOf(layer), ys: candidate.columns[layer.candidate], candidate } : null;
  }

  paintCandidate(pixels, { xs, ys }) {
    const { cells, size } = this.cellsOf("candidate", xs, ys, this.dot), colour = this.colours.packedOf(this.colours.candidate);
    for (const run of this.view.visibleRuns) paint(pixels, this.raster.width, cells, { from: run.first, to: run.first + run.count, size, colour });
  }

  drawCandidate(pen, { kind, xs, ys, candidate }) {
    const { x, y, w, h } = this.inner, { colours } = this;
    pen.save();
    pen.beginPath();
    pen.rect(x, y, w, h);
    pen.clip();
    if (kind === "line") drawLine(pen, this, { colour: "candidate", width: 2 }, xs, ys);
    pen.restore();
    if (!candidate.label || (candidate.plot && candidate.plot !== this.spec.title)) return;
    pen.font = `600 ${colours.small}`;
    const width = Math.min(pen.measureText(candidate.label).width + 16, w - 8);
    Object.assign(pen, { fillStyle: colours.raised, strokeStyle: colours.candidate, lineWidth: 1.5 });
    const at = this.emptiest(width, LABEL_HEIGHT);
    pen.beginPath();
    pen.roundRect(at.x, at.y, width, LABEL_HEIGHT, 4);
    pen.fill();
    pen.stroke();
    Object.assign(pen, { fillStyle: colours.ink, textAlign: "left", lineWidth: 1 });
    pen.fillText(candidate.label, at.x + 8, at.y + 15, width - 16);
  }

  /** The corner of the plot where a label of this size hides the fewest points. */
  emptiest(width, height) {
    const { x, y, w, h } = this.inner, { axes, main } = this, xs = this.xOf(main), ys = this.column(main.y);
    const corners = [y + 6, y + h - height - 6].flatMap((v) => [x + 6, x + w - width - 6].map((u) => ({ x: u, y: v, points: 0 })));
    for (let i = 0; i < ys.length; i++) {
      const px = axes.x.px(xs[i]), py = axes.y.px(ys[i]);
      for (const corner of corners) if (px >= corner.x && px <= corner.x + width && py >= corner.y && py <= corner.y + height) corner.points++;
    }
    return corners.reduce((best, corner) => (corner.points < best.points ? corner : best));
  }

  drawTop() {
    if (!this.size) return;
    const pen = this.pen(this.top), { main, colours } = this, { cursor } = this.view;
    if (main && cursor !== null) this.drawCursor(pen, main, cursor);
    for (const handle of this.spec.handles || []) this.drawHandle(pen, handle);
    if (!this.box) return;
    const { x0, y0, x1, y1, how } = this.box;
    pen.strokeStyle = pen.fillStyle = how === "zoom" ? colours.accent : colours.select;
    pen.globalAlpha = 0.14;
    pen.fillRect(x0, y0, x1 - x0, y1 - y0);
    pen.globalAlpha = 1;
    pen.setLineDash(how === "subtract" ? [4, 3] : []);
    pen.strokeRect(x0, y0, x1 - x0, y1 - y0);
    pen.setLineDash([]);
  }

  /** The cursor, and its values beside the title. */
  drawCursor(pen, main, row) {
    const { x, y, w, h } = this.inner, { axes, colours, spec, view } = this, run = view.runAt(row);
    const vx = this.xOf(main)[row], vy = this.column(main.y)[row], px = axes.x.px(vx), py = axes.y.px(vy);
    const text = [run && view.runs.length > 1 ? run.name : "", valueText(vx, spec.x.unit), valueText(vy, spec.y.unit)];
    pen.font = `600 ${colours.small}`;
    const free = w - pen.measureText(spec.title).width - 12;
    pen.font = colours.small;
    Object.assign(pen, { textAlign: "right", fillStyle: colours.ink });
    if (free > 90) pen.fillText(text.filter(Boolean).join(" \u00b7 "), x + w - 14, 16, free - 14);
    if (!(px >= x && px <= x + w)) return;
    Object.assign(pen, { strokeStyle: colours.cursor, lineWidth: view.pinned ? 1.5 : 1 });
    pen.beginPath(); pen.moveTo(px, y); pen.lineTo(px, y + h); pen.stroke();
    if (view.pinned) {
      pen.fillStyle = colours.cursor;
      pen.beginPath(); pen.moveTo(px - 5, y); pen.lineTo(px + 5, y); pen.lineTo(px, y + 7); pen.fill();
    }
    pen.lineWidth = 1;
    if (!(py >= y && py <= y + h)) return;
    pen.fillStyle = run ? colours.ofRun(run.index) : colours.measured;
    pen.beginPath(); pen.arc(px, py, 5, 0, 7); pen.fill(); pen.stroke();
  }

  drawHandle(pen, handle) {
    const { y, h } = this.inner;
    pen.strokeStyle = pen.fillStyle = this.colours.free;
    pen.lineWidth = 2;
    for (const value of handle.span) {
      const px = this.axes.x.px(value);
      pen.beginPath(); pen.moveTo(px, y); pen.lineTo(px, y + h); pen.stroke();
      pen.fillRect(px - 5, y + h / 2 - 14, 10, 28);
    }
    pen.lineWidth = 1;
  }

  // --- which rows

  /** Write the rows within a box of values into a mask. */
  fillBox(mask, [x0, x1], [y0, y1]) {
    const { main } = this;
    if (!main) return;
    const xs = this.xOf(main), ys = this.column(main.y);
    for (const run of this.view.runs.length ? this.view.visibleRuns : [{ first: 0, count: this.view.rows }]) {
      for (let i = run.first; i < run.first + run.count; i++) mask[i] = xs[i] >= x0 && xs[i] <= x1 && ys[i] >= y0 && ys[i] <= y1 ? 1 : 0;
    }
  }

  /** Row of the visible point that is nearest to a place; only x counts where time is selected. */
  nearest(p, among = null) {
    const { main, axes } = this;
    if (!main) return null;
    const xs = this.xOf(main), ys = this.column(main.y), reach = this.spec.brush === "x" ? 0.02 : 1;
    const { x, y } = axes;
    let best = null, least = Infinity;
    for (const run of this.view.runs.length ? this.view.visibleRuns : [{ first: 0, count: this.view.rows }]) {
      for (let i = run.first; i < run.first + run.count; i++) {
        if (among && !among[i]) continue;
        const dx = x.from + (xs[i] - x.low) * x.k - p.x, dy = y.from + (ys[i] - y.low) * y.k - p.y, d = dx * dx + reach * dy * dy;
        if (d < least) { least = d; best = i; }
      }
    }
    return best;
  }
}
