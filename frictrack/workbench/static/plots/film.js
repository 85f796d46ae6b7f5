// The film: picture with drawing tools, time line and controls. It follows the cursor of the plots.

import { Colours, watchTheme } from "./colours.js";
import { Listeners, make, OncePerFrame, placeIn } from "./dom.js";
import { drawCross, drawShape, drawTracks, placement, shapeList } from "./film_drawing.js";
import { FilmFrames } from "./film_frames.js";
import { TimeLine } from "./film_timeline.js";
import { FilmTools } from "./film_tools.js";

const SPEEDS = [2, 5, 15, 30, 60]; // frames per second that are shown
const MAX_ZOOM = 16;
const STEPS = { ArrowLeft: -1, ArrowRight: 1, PageUp: -25, PageDown: 25 };
const idOf = (film) => film && (film.run ?? film.file);

export class FilmView {
  /** A film is {run or file, frames, width, height, fps, version, shapes, suspect, repairs}. */
  constructor(el, view, { adjust = false } = {}) {
    Object.assign(this, { el, view, adjust, film: null, films: new Map(), number: 0, picture: null, shapes: {}, zoom: { k: 1 }, listeners: new Listeners() });
    this.light = { brightness: 1, contrast: 1 };
    this.frames = new FilmFrames((film, n) => view.frame(film, n), (...got) => this.arrived(...got), (error) => this.failed(error));
    this.tools = new FilmTools((drawn) => this.drawn(drawn), () => this.redraw.ask());
    this.redraw = new OncePerFrame(() => this.draw());
    this.timeline = new TimeLine({
      seek: (frame) => this.show(frame),
      ranged: (range, frame) => { this.show(frame); view.say("range", { ...range, run: idOf(this.film) }); },
      settled: (range) => view.say("moved", { handle: "range", span: [range.from, range.to], run: idOf(this.film) }),
    });
    this.build();
    this.colours = new Colours(this.root);
    this.listen();
    this.refresh();
  }

  build() {
    const button = (name, label) => make("button", { type: "button", class: "fp-button", "aria-label": label, title: label }, name);
    this.canvas = make("canvas", { class: "fp-picture", tabindex: 0, role: "application" });
    this.hint = make("p", { class: "fp-hint", "aria-live": "polite" });
    this.stage = make("div", { class: "fp-stage" }, this.canvas, this.hint);
    this.label = make("output", { class: "fp-label", "aria-live": "off" });
    this.back = button("\u2039", "Previous frame");
    this.playButton = button("\u25b6", "Play");
    this.forward = button("\u203a", "Next frame");
    this.speed = make("select", { class: "fp-speed", "aria-label": "Speed" }, ...SPEEDS.map((n) => make("option", { value: n }, `${n} frames/s`)));
    this.speed.value = "15";
    this.controls = make("div", { class: "fp-controls" }, this.back, this.playButton, this.forward, this.speed, this.label);
    this.root = make("div", { class: "fp-film" }, this.stage, this.timeline.el, this.controls);
    if (this.adjust) this.controls.append(...this.adjustments(button));
    this.el.append(this.root);
  }

  /** Controls of how the picture is shown: they change no measurement. */
  adjustments(button) {
    const on = (node, call, event = "click") => (this.listeners.on(node, event, () => { call(node); this.redraw.ask(); }), node);
    const slider = (name) => make("label", { class: "fp-light" }, name, on(
      make("input", { type: "range", min: 0.3, max: 3, step: 0.1, value: 1, "aria-label": name }),
      (node) => { this.light[name.toLowerCase()] = Number(node.value); }, "input"));
    const path = on(button("Path", "Show the path of the target"), (node) => {
      this.path = !this.path;
      node.setAttribute("aria-pressed", String(this.path));
    });
    const full = on(button("\u2922", "Show the film on the whole screen (Escape ends)"), () => (document.fullscreenElement ? document.exitFullscreen() : this.root.requestFullscreen()));
    const zoom = (name, title, factor) => on(button(name, title), () => this.film && this.zoomAt(factor, [this.film.width / 2, this.film.height / 2]));
    return [path, zoom("\u2212", "Zoom out", 0.8), zoom("+", "Zoom in (Ctrl and the wheel)", 1.25), slider("Brightness"), slider("Contrast"), full];
  }

  listen() {
    const { listeners, canvas, view } = this;
    listeners.on(this.back, "click", () => this.show(this.number - 1));
    listeners.on(this.forward, "click", () => this.show(this.number + 1));
    listeners.on(this.playButton, "click", () => this.play());
    listeners.on(this.speed, "change", () => { if (this.timer) { this.pause(); this.play(); } });
    listeners.on(canvas, "pointerdown", (e) => {
      if (e.button || !this.film || !this.tools.down(this.placeOf(e), this.place.k)) return;
      canvas.setPointerCapture(e.pointerId);
      this.pause();
    });
    listeners.on(canvas, "pointermove", (e) => { if (this.film) this.tools.move(this.placeOf(e)); });
    listeners.on(canvas, "pointerup", (e) => { if (this.film) this.tools.up(this.placeOf(e)); });
    listeners.on(canvas, "pointercancel", () => this.tools.reset());
    listeners.on(canvas, "dblclick", () => (this.tools.corners.length ? this.tools.close() : this.setZoom({ k: 1 })));
    listeners.on(canvas, "wheel", (e) => this.wheel(e), { passive: false });
    listeners.on(canvas, "keydown", (e) => this.key(e));
    listeners.resized(this.stage, () => { this.size = null; this.draw(); });
    const recolour = () => { this.colours = new Colours(this.root); this.refresh(); };
    watchTheme(listeners, recolour);
    listeners.end(view.on("theme", recolour));
    listeners.end(view.on("cursor", (cursor) => this.follow(cursor)));
    for (const name of ["marks", "selection", "scene", "hidden"]) listeners.end(view.on(name, () => { this.mark(); this.redraw.ask(); }));
  }

  destroy() {
    this.pause();
    this.redraw.cancel();
    this.listeners.destroy();
    this.timeline.destroy();
    this.frames.destroy();
    this.root.remove();
  }

  // --- what is shown

  /** Films of all runs, so that the film can follow the cursor from run to run. */
  setFilms(films) {
    this.films = new Map(films.map((film) => [idOf(film), film]));
    const now = this.films.get(idOf(this.film));
    if (now) this.setFilm(now);
  }

  /** Show a film at a frame; null for none. The same film in a new version keeps its frame. */
  setFilm(film, number = 0) {
    const same = film && idOf(film) === idOf(this.film), changed = !same || film.version !== this.film.version;
    this.film = film;
    if (film) this.films.set(idOf(film), film);
    if (film?.shapes) this.shapes = film.shapes;
    else if (!same) this.shapes = {};
    if (!same) {
      Object.assign(this, { number, zoom: { k: 1 } });
      this.tools.reset();
      this.pause();
    }
    this.refresh();
    if (!same) this.view.say("film", film && { run: film.run, file: film.file, frame: this.number });
    if (film && changed) this.show(Math.min(this.number, film.frames - 1), "setFilm");
  }

  /** Shapes of the study file: {target, reference, ruler, exclude: [...], obstacles: [...]}. */
  setShapes(shapes) {
    this.shapes = shapes || {};
    if (this.film) this.film.shapes = this.shapes;
    this.redraw.ask();
  }

  setTool(tool) {
    this.tools.set(tool);
    this.hint.textContent = this.tools.help;
    this.canvas.classList.toggle("fp-drawing", Boolean(this.tools.tool));
  }

  get range() { return this.timeline.range; }

  set range(range) { this.timeline.set({ range }); }

  follow({ run, frame, by }) {
    if (by === "film") return;
    const film = this.films.get(run);
    if (!film) return;
    if (film !== this.film) this.setFilm(film, frame); // one request, not one for its first frame too
    if (frame !== this.number) this.show(frame, "cursor");
  }

  /** Show a frame; the cursor of the plots goes there too, unless they have asked for it. */
  show(number, by = "film") {
    if (!this.film) return;
    this.number = Math.min(Math.max(number, 0), this.film.frames - 1);
    this.timeline.set({ number: this.number, text: this.words(this.number) });
    this.frames.ask(this.film, this.number, this.timer ? 1 : 0);
    const row = by === "film" ? this.view.rowOf(idOf(this.film), this.number) : null;
    if (row !== null) this.view.point(row, "film");
    this.view.say("frame", { run: idOf(this.film), frame: this.number });
  }

  words(number) {
    const { film } = this, time = film.fps ? ` \u00b7 ${((1e3 * number) / film.fps).toFixed(2)} ms` : "";
    return `${idOf(film)} \u00b7 frame ${number} of ${film.frames}${time}`;
  }

  arrived(picture, film, number) {
    if (idOf(film) !== idOf(this.film)) return;
    Object.assign(this, { picture, pictureNumber: number });
    this.label.textContent = this.words(number);
    this.draw();
  }

  failed(error) {
    this.pause();
    this.picture = null;
    this.label.textContent = error?.message || "The frame cannot be read; check that the film still exists.";
    this.redraw.ask();
  }

  play() {
    if (this.timer) return this.pause();
    if (!this.film) return undefined;
    this.timer = setInterval(() => {
      if (!this.frames.wanted) this.show((this.number + 1) % this.film.frames);
    }, 1000 / Number(this.speed.value));
    this.showPlaying();
    return undefined;
  }

  pause() {
    clearInterval(this.timer);
    this.timer = null;
    this.showPlaying();
  }

  showPlaying() {
    const label = this.timer ? "Pause" : "Play";
    this.playButton.textContent = this.timer ? "\u275a\u275a" : "\u25b6";
    this.playButton.setAttribute("aria-label", label);
    this.playButton.title = label;
  }

  // --- drawing

  refresh() {
    const { film, colours } = this;
    this.root.classList.toggle("fp-empty", !film);
    this.canvas.setAttribute("aria-label", film ? `Film ${idOf(film)}. Arrow keys step, space plays; with a tool they draw.` : "No film");
    if (!film) this.label.textContent = "";
    this.timeline.set({ frames: film?.frames || 1, number: this.number, colours, text: film ? this.words(this.number) : "" });
    this.mark();
    this.redraw.ask();
  }

  /** Spans and selected frames on the time line. */
  mark() {
    const { film, view, colours } = this, run = film && view.runs.find((one) => one.name === idOf(film));
    const span = (colour) => ({ from, to }) => ({ from, to, colour });
    const spans = [...(film?.suspect || []).map(span(colours.warn)), ...(film?.repairs || []).map(span(colours.repair))];
    let chosen = null;
    if (run && view.count) {
      chosen = new Uint8Array(film.frames);
      chosen.set(view.mask.subarray(run.first, run.first + Math.min(run.count, film.frames - (run.frame || 0))), run.frame || 0);
    }
    this.timeline.set({ spans, chosen });
  }

  measure() {
    if (this.size) return;
    const { width, height } = this.stage.getBoundingClientRect(), ratio = window.devicePixelRatio || 1;
    this.size = { width: Math.max(width, 1), height: Math.max(height, 1), ratio };
    this.canvas.width = Math.round(this.size.width * ratio);
    this.canvas.height = Math.round(this.size.height * ratio);
  }

  get place() {
    this.measure();
    return placement(this.film, this.size, this.zoom);
  }

  /** Place of the pointer, px of the film; the centre of a pixel is an integer. */
  placeOf(e) {
    const p = placeIn(this.canvas, e), { k, left, top } = this.place;
    return [(p.x - left) / k - 0.5, (p.y - top) / k - 0.5];
  }

  draw() {
    this.measure();
    const pen = this.canvas.getContext("2d"), { film, picture, size, colours } = this;
    pen.setTransform(size.ratio, 0, 0, size.ratio, 0, 0);
    pen.clearRect(0, 0, size.width, size.height);
    if (!film) return;
    const { k, left, top } = this.place;
    pen.imageSmoothingEnabled = k * size.ratio < 2;
    const { brightness, contrast } = this.light;
    if (brightness !== 1 || contrast !== 1) pen.filter = `brightness(${brightness}) contrast(${contrast})`;
    if (picture?.width) pen.drawImage(picture, left, top, film.width * k, film.height * k);
    pen.filter = "none";
    pen.setTransform(k * size.ratio, 0, 0, k * size.ratio, (left + k / 2) * size.ratio, (top + k / 2) * size.ratio);
    const run = this.view.runs.find((one) => one.name === idOf(film)), { draft, cross } = this.tools;
    for (const [tool, shape] of shapeList(this.shapes)) drawShape(pen, colours, k, tool, shape, { dashed: true });
    if (run && picture?.width) drawTracks(pen, this.view, run, this.pictureNumber, colours, k, this.path);
    if (draft) drawShape(pen, colours, k, draft.tool, draft.shape, draft);
    if (cross) drawCross(pen, cross, colours, k);
  }

  drawn({ tool, shape }) {
    this.view.say("drawn", { tool, shape, frame: this.number, run: this.film.run ?? null, file: this.film.file ?? null });
    this.redraw.ask();
  }

  // --- zoom and keys

  wheel(e) {
    if ((!e.ctrlKey && !e.metaKey) || !this.film) return;
    e.preventDefault();
    this.zoomAt(e.deltaY > 0 ? 0.8 : 1.25, this.placeOf(e));
  }

  /** Zoom by a factor; the place [x, y] of the film stays where it is. */
  zoomAt(factor, [x, y]) {
    const before = this.zoom.k, k = Math.min(Math.max(before * factor, 1), MAX_ZOOM);
    const { width, height } = this.film, centre = before > 1 ? this.zoom : { x: width / 2, y: height / 2 }, share = before / k;
    this.setZoom({ k, x: x + (centre.x - x) * share, y: y + (centre.y - y) * share });
  }

  setZoom(zoom) {
    this.zoom = zoom;
    this.redraw.ask();
  }

  key(e) {
    if (!this.film || e.ctrlKey || e.metaKey) return;
    if (this.tools.key(e, this.film)) e.preventDefault();
    else if (STEPS[e.key]) { e.preventDefault(); this.show(this.number + STEPS[e.key]); }
    else if (e.key === "Home" || e.key === "End") { e.preventDefault(); this.show(e.key === "Home" ? 0 : this.film.frames - 1); }
    else if (e.key === " ") { e.preventDefault(); this.play(); }
  }
}
