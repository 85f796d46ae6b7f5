// Time line of a film: the frame shown, selected frames, suspect and repaired spans, and a range with ends to drag.

import { Listeners, make, placeIn } from "./dom.js";

const EDGE = 8; // px left and right of the first and the last frame
const ENDS = { from: "First frame of the range", to: "Last frame of the range" };
const KEYS = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 };

export class TimeLine {
  /** `seek(frame)` is called for clicks and keys, `ranged(range)` while an end is dragged, `settled(range)` after it. */
  constructor({ seek, ranged, settled }) {
    Object.assign(this, { seek, ranged, settled, frames: 1, number: 0, range: null, spans: [], chosen: null, listeners: new Listeners() });
    this.canvas = make("canvas", { "aria-hidden": "true" });
    this.track = make("div", { class: "fp-track", role: "slider", tabindex: 0, "aria-label": "Frame", "aria-valuemin": 0 }, this.canvas);
    const end = (label) => make("div", { class: "fp-end", role: "slider", tabindex: 0, "aria-label": label });
    this.ends = Object.fromEntries(Object.entries(ENDS).map(([name, label]) => [name, end(label)]));
    this.el = make("div", { class: "fp-timeline" }, this.track, ...Object.values(this.ends));
    const { listeners } = this;
    listeners.resized(this.el, () => this.draw());
    this.dragged(this.track, (frame) => this.seek(frame), () => {});
    listeners.on(this.track, "keydown", (e) => this.key(e, this.number, (frame) => this.seek(frame)));
    for (const [name, end] of Object.entries(this.ends)) {
      this.dragged(end, (frame) => this.moveEnd(name, frame), () => this.settled(this.range));
      listeners.on(end, "keydown", (e) => this.key(e, this.range[name], (frame) => { this.moveEnd(name, frame); this.settled(this.range); }));
    }
  }

  destroy() {
    this.listeners.destroy();
    this.el.remove();
  }

  dragged(el, move, end) {
    let held = false;
    const frameOf = (e) => this.frameAt(placeIn(this.el, e).x), { listeners } = this;
    listeners.on(el, "pointerdown", (e) => { if (!e.button) { held = true; el.setPointerCapture(e.pointerId); move(frameOf(e)); } });
    listeners.on(el, "pointermove", (e) => { if (held) move(frameOf(e)); });
    for (const type of ["pointerup", "pointercancel"]) listeners.on(el, type, () => { if (held) { held = false; end(); } });
  }

  key(e, frame, move) {
    const big = Math.max(1, Math.round(this.frames / 20)), jump = { PageUp: big, PageDown: -big, Home: -Infinity, End: Infinity }[e.key];
    const step = jump ?? (KEYS[e.key] || 0) * (e.shiftKey ? 10 : 1);
    if (!step) return;
    e.preventDefault();
    move(this.within(frame + step));
  }

  within(frame) { return Math.min(Math.max(frame, 0), this.frames - 1); }

  moveEnd(name, frame) {
    if (!this.range) return;
    const { from, to } = this.range;
    this.range = name === "from" ? { from: Math.min(frame, to), to } : { from, to: Math.max(frame, from) };
    this.ranged(this.range, frame);
    this.draw();
  }

  get width() { return Math.max(this.el.clientWidth - 2 * EDGE, 1); }

  x(frame) { return EDGE + (this.width * frame) / Math.max(this.frames - 1, 1); }

  frameAt(x) { return this.within(Math.round(((x - EDGE) / this.width) * (this.frames - 1))); }

  /** Show values: frames, number, text, range, spans [{from, to, colour, words}], chosen (mask of the frames), colours. */
  set(values) {
    Object.assign(this, values);
    this.draw();
  }

  draw() {
    const { canvas, colours, track } = this, width = this.el.clientWidth, height = this.el.clientHeight, ratio = window.devicePixelRatio || 1;
    track.setAttribute("aria-valuemax", this.frames - 1);
    track.setAttribute("aria-valuenow", this.number);
    track.setAttribute("aria-valuetext", this.text || `frame ${this.number}`);
    this.placeEnds();
    if (!width || !height || !colours) return;
    const size = { width: Math.round(width * ratio), height: Math.round(height * ratio) };
    if (canvas.width !== size.width || canvas.height !== size.height) Object.assign(canvas, size);
    const pen = canvas.getContext("2d"), middle = height / 2;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.fillStyle = colours.line;
    pen.fillRect(EDGE, middle - 3, this.width, 6);
    const bar = (from, to, colour, y, h) => {
      const left = this.x(from - 0.5);
      pen.fillStyle = colour;
      pen.fillRect(left, y, Math.max(this.x(to + 0.5) - left, 2), h);
    };
    for (const { from, to, colour } of this.spans) bar(from, to, colour, middle - 3, 6);
    if (this.range) { pen.globalAlpha = 0.35; bar(this.range.from, this.range.to, colours.repair, 2, height - 4); pen.globalAlpha = 1; }
    for (let i = 0; this.chosen && i < this.chosen.length; i++) {
      if (!this.chosen[i]) continue;
      const from = i;
      while (i + 1 < this.chosen.length && this.chosen[i + 1]) i++;
      bar(from, i, colours.select, height - 5, 3);
    }
    const px = this.x(this.number);
    pen.fillStyle = colours.cursor;
    pen.fillRect(px - 1, 2, 2, height - 4);
    pen.beginPath(); pen.arc(px, middle, 6, 0, 7); pen.fill();
  }

  placeEnds() {
    for (const [name, end] of Object.entries(this.ends)) {
      end.hidden = !this.range;
      if (!this.range) continue;
      end.style.left = `${this.x(this.range[name])}px`;
      end.setAttribute("aria-valuemin", 0);
      end.setAttribute("aria-valuemax", this.frames - 1);
      end.setAttribute("aria-valuenow", this.range[name]);
    }
  }
}
