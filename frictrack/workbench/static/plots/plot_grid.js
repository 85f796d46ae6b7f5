// All plots of a scene, the largest one first.

import { Axis } from "./axis.js";
import { Colours, watchTheme } from "./colours.js";
import { Listeners, make, OncePerFrame } from "./dom.js";
import { Plot } from "./plot.js";

const MIN_WIDTH = 290, MIN_NARROW_WIDTH = 220, MIN_HEIGHT = 150, MIN_LARGE_HEIGHT = 220, GAP = 8; // px, of plots
const MODES = { select: ["Select", "Drag selects. Shift adds, Alt subtracts."], zoom: ["Zoom", "Drag zooms. Ctrl + wheel zooms always."] };
const QUIET = 200; // ms until a screen reader is told where the keys have moved the cursor

export class PlotGrid {
  constructor(el, view, { large = null } = {}) {
    Object.assign(this, { el, view, large, plots: [], order: [], alone: null, zoomKey: false, listeners: new Listeners() });
    this.words = make("output", { class: "fp-words", "aria-live": "off" });
    this.live = make("p", { class: "fp-live", role: "status" });
    const button = (name, title, mode = null) => make("button", { type: "button", class: "fp-button", title, "data-mode": mode }, name);
    this.modes = Object.entries(MODES).map(([mode, [name, title]]) => button(name, title, mode));
    const all = button("Show all", "Show all data (double click, or key 0)");
    this.bar = make("div", { class: "fp-bar", role: "toolbar", "aria-label": "Plots" }, ...this.modes, all, this.words);
    this.grid = make("div", { class: "fp-grid" });
    this.root = make("div", { class: "fp-plots" }, this.bar, this.grid, this.live);
    el.append(this.root);
    this.colours = new Colours(this.root);
    this.layout = new OncePerFrame(() => this.arrange());
    this.listen(all);
    this.showMode();
    this.setScene();
  }

  listen(all) {
    const { listeners, view } = this;
    for (const button of this.modes) listeners.on(button, "click", () => view.setMode(button.dataset.mode));
    listeners.on(all, "click", () => this.showAll());
    listeners.resized(this.el, () => this.layout.ask());
    watchTheme(listeners, () => this.recolour());
    listeners.end(view.on("theme", () => this.recolour()));
    listeners.on(window, "keydown", (e) => { if (e.key === "z" && !e.ctrlKey && !e.metaKey) this.zoomKey = true; });
    listeners.on(window, "keyup", (e) => { if (e.key === "z") this.zoomKey = false; });
    listeners.on(window, "blur", () => { this.zoomKey = false; });
    const each = (...names) => () => { for (const plot of this.plots) plot.ask(...names); };
    const calls = {
      scene: () => this.setScene(), candidate: each("marks"), marks: each("marks", "top"), mode: () => this.showMode(),
      hidden: () => { for (const plot of this.plots) plot.rescale(); this.showWords(); },
      cursor: (cursor) => { each("top")(); this.showCursor(cursor); }, selection: (chosen) => this.showSelection(chosen),
    };
    for (const [name, call] of Object.entries(calls)) listeners.end(view.on(name, call));
    listeners.end(() => { this.layout.cancel(); clearTimeout(this.timer); });
  }

  destroy() {
    this.listeners.destroy();
    for (const plot of this.plots) plot.destroy();
    this.root.remove();
  }

  // --- plots

  /** Plots that are described again keep their canvases and their zoom. */
  setScene() {
    const old = new Map(this.plots.map((plot) => [plot.spec.id, plot]));
    this.plots = this.view.scene.plots.map((spec) => {
      const plot = old.get(spec.id) || new Plot(this, spec);
      if (old.delete(spec.id)) plot.setSpec(spec);
      return plot;
    });
    for (const plot of old.values()) plot.destroy();
    this.place();
  }

  /** Make one plot the largest, by its title; in an order of the user the first plot is. */
  setLarge(title) {
    if (title === this.large) return;
    this.large = title;
    this.place();
  }

  /** Titles of the plots in the order of the user, none for the usual one, and of the plot that is shown alone. */
  setLayout({ order = [], alone = null }) {
    Object.assign(this, { order, alone });
    this.place();
  }

  change(layout) {
    this.setLayout({ order: this.order, alone: this.alone, ...layout });
    this.view.say("layout", { order: this.order, alone: this.alone });
  }

  /** Show one plot alone; a second time, show all again. */
  enlarge(plot) { this.change({ alone: this.alone === plot.spec.title ? null : plot.spec.title }); }

  /** Move a plot to the place of another one, or by a number of places. */
  move(plot, to) {
    const order = this.placed.map((one) => one.spec.title), from = this.placed.indexOf(plot);
    const at = typeof to === "number" ? from + to : this.placed.findIndex((one) => one.el === to);
    if (at < 0 || at >= order.length || at === from) return;
    order.splice(at, 0, ...order.splice(from, 1));
    this.change({ order });
  }

  place() {
    const usual = [...this.plots].sort((a, b) => (b.spec.title === this.large) - (a.spec.title === this.large));
    const rank = (plot) => (this.order.indexOf(plot.spec.title) + 1 || this.plots.length + 1);
    this.placed = usual.sort((a, b) => rank(a) - rank(b));
    this.first = this.plots.some((plot) => plot.spec.title === this.large) ? this.placed[0] : null;
    this.placed.forEach(({ el }, i) => { if (this.grid.children[i] !== el) this.grid.insertBefore(el, this.grid.children[i] || null); });
    for (const plot of this.plots) {
      plot.el.classList.toggle("fp-large", plot === this.first);
      plot.el.classList.toggle("fp-full", plot.spec.title === this.alone);
    }
    this.grid.classList.toggle("fp-alone", this.plots.some((plot) => plot.spec.title === this.alone));
    this.arrange();
  }

  /** As many columns as fit, without a row that is nearly empty; narrow ones if otherwise not all plots are seen at once. */
  arrange() {
    const { width, height } = this.grid.getBoundingClientRect(), large = Boolean(this.first);
    const small = this.plots.length - (large ? 1 : 0);
    const columnsOf = (least) => {
      const most = Math.max(1, Math.min(Math.floor((width + GAP) / (least + GAP)), small));
      for (let n = most; n > 2; n--) if (small % n === 0 || small % n >= n - 1) return n;
      return Math.min(most, 2);
    };
    const needed = (n) => Math.ceil(small / n) * (MIN_HEIGHT + GAP) + (large ? MIN_LARGE_HEIGHT : 0), wide = columnsOf(MIN_WIDTH);
    const columns = needed(wide) > height ? columnsOf(MIN_NARROW_WIDTH) : wide, rows = Math.ceil(small / columns);
    this.grid.style.gridTemplateColumns = `repeat(${columns}, minmax(0, 1fr))`;
    const first = large ? [`minmax(${MIN_LARGE_HEIGHT}px, 1.6fr)`] : [];
    this.grid.style.gridTemplateRows = [...first, ...Array(rows).fill(`minmax(${MIN_HEIGHT}px, 1fr)`)].join(" ");
  }

  recolour() {
    this.colours = new Colours(this.root);
    for (const plot of this.plots) plot.recolour();
  }

  // --- zoom

  /** Plots over the same quantity share the range of x. */
  zoom(plot, axes) {
    plot.look(axes);
    for (const other of this.plots) {
      if (other === plot || !axes.x || other.spec.x.column !== plot.spec.x.column) continue;
      other.look({ ...other.zoom, x: new Axis(axes.x.low, axes.x.high) });
    }
    this.view.say("zoom", this.zooms);
  }

  showAll() {
    for (const plot of this.plots) plot.look(null);
    this.view.say("zoom", this.zooms);
  }

  /** Ranges that are zoomed: of x by its column, of y by the title of its plot. */
  get zooms() {
    const found = { x: {}, y: {} };
    for (const { zoom: { x, y }, spec } of this.plots) {
      if (x) found.x[spec.x.column] = [x.low, x.high];
      if (y) found.y[spec.title] = [y.low, y.high];
    }
    return found;
  }

  set zooms({ x, y }) {
    for (const plot of this.plots) plot.look({ x: plot.part("x", x[plot.spec.x.column]), y: plot.part("y", y[plot.spec.title]) });
  }

  // --- words

  showMode() {
    for (const button of this.modes) button.setAttribute("aria-pressed", String(button.dataset.mode === this.view.mode));
  }

  showCursor({ words, by }) {
    this.cursorWords = words;
    this.showWords();
    if (by === "key") this.announce(words);
  }

  showSelection({ count, per_run }) {
    const runs = Object.entries(per_run).map(([name, n]) => `${n} in ${name}`).join(", ");
    this.selectionWords = count ? `${count} frames selected: ${runs}` : "";
    this.showWords();
    this.announce(this.selectionWords);
  }

  showWords() {
    this.words.textContent = [this.selectionWords, this.cursorWords].filter(Boolean).join(" \u00b7 ");
    this.words.title = this.words.textContent;
  }

  /** For screen readers, when the keys rest. */
  announce(words) {
    clearTimeout(this.timer);
    this.timer = setTimeout(() => { this.live.textContent = words; }, QUIET);
  }
}
