// Draw target, reference, ruler and other shapes on the film, with the mouse or with the keyboard. The tool that holds is that
// of the moment at which the drag begins.

import { HINTS } from "./film_hints.js";

const CLICK = 3; // px of the film
const CLOSE = 8; // px of the screen around the first corner that close a polygon
const KEYS_HELP = " By keyboard: arrow keys move the cross (shift: ten pixels), Enter sets a corner, Escape ends.";
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

const round = (v) => Math.round(10 * v) / 10;
const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);

export class FilmTools {
  /** `drawn({tool, shape})` is called with a finished shape, `changed()` when something must be drawn again. */
  constructor(drawn, changed) {
    Object.assign(this, { drawn, changed, tool: "", from: null, to: null, corners: [], cross: null });
  }

  /** A shape that is being dragged keeps the tool with which it was begun. */
  set(tool) {
    const next = HINTS[tool] ? tool : "";
    if (next === this.tool) return;
    this.tool = next;
    if (!this.held) this.reset();
  }

  reset() {
    Object.assign(this, { from: null, to: null, active: null, held: false, corners: [], cross: null });
    this.changed();
  }

  get help() { return this.tool ? HINTS[this.tool] + KEYS_HELP : ""; }

  /** What is being drawn: {tool, shape}, or null. */
  get draft() {
    if (this.corners.length) return { tool: this.active, shape: [...this.corners, this.to || this.cross].filter(Boolean), open: true };
    return this.from && this.to ? { tool: this.active, shape: this.shape() } : null;
  }

  shape() {
    const { from, to } = this;
    if (this.active === "ruler") return [from.map(round), to.map(round)];
    if (distance(from, to) < CLICK) return from.map(round);
    return [Math.min(from[0], to[0]), Math.min(from[1], to[1]), Math.abs(to[0] - from[0]), Math.abs(to[1] - from[1])].map(round);
  }

  // --- mouse; `scale` is screen px per px of the film

  down(place, scale) {
    if (!this.tool) return false;
    this.active = this.tool;
    if (this.tool !== "polygon") Object.assign(this, { from: place, to: place, held: true });
    else if (this.corners.length > 2 && distance(place, this.corners[0]) * scale < CLOSE) this.close();
    else this.corners.push(place.map(round));
    this.changed();
    return true;
  }

  move(place) {
    if (!this.from && !this.corners.length) return;
    this.to = place;
    this.changed();
  }

  up(place) {
    if (!this.held) return;
    this.to = place;
    this.finish();
  }

  /** What tells a place may be a single click; other shapes need a length. */
  finish() {
    const shape = this.shape(), tool = this.active, isPoint = shape.length === 2 && !Array.isArray(shape[0]);
    const short = tool === "ruler" ? distance(...shape) < CLICK : isPoint && !["target", "reference", "repair"].includes(tool);
    this.reset();
    if (!short) this.drawn({ tool, shape });
  }

  /** Close the polygon; a double click has set its last corner twice. */
  close() {
    const corners = this.corners.filter((corner, i) => i === 0 || distance(corner, this.corners[i - 1]) >= 1);
    this.reset();
    if (corners.length > 2) this.drawn({ tool: "polygon", shape: corners });
  }

  // --- keyboard

  /** Whether the key was used. */
  key(e, film) {
    if (!this.tool) return false;
    const step = e.shiftKey ? 10 : 1, arrow = ARROWS[e.key];
    if (arrow) {
      const [x, y] = this.cross || [film.width / 2, film.height / 2], within = (v, size) => Math.min(Math.max(v, 0), size - 1);
      this.cross = [within(x + step * arrow[0], film.width), within(y + step * arrow[1], film.height)];
      if (this.from || this.corners.length) this.to = this.cross;
    } else if (e.key === "Enter") this.enter(film);
    else if (e.key === "Escape") this.reset();
    else if (e.key === "Backspace" && this.corners.length) this.corners.pop();
    else return false;
    this.changed();
    return true;
  }

  enter(film) {
    const cross = this.cross || [film.width / 2, film.height / 2];
    this.active = this.tool;
    if (this.tool === "polygon") {
      const last = this.corners.at(-1);
      if (this.corners.length > 2 && (!this.cross || distance(last, cross) < 1)) return this.close();
      this.corners.push(cross.map(round));
    } else if (this.from) this.finish();
    else Object.assign(this, { from: cross, to: cross });
    this.cross = cross;
  }
}
