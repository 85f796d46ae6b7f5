// Mouse, touch and keyboard on one plot.

import { Axis } from "./axis.js";
import { OncePerFrame, placeIn } from "./dom.js";

const NEAR_HANDLE = 7, CLICK = 4; // px
const STEPS = { ArrowLeft: -1, ArrowRight: 1, PageUp: -25, PageDown: 25 };
const ZOOMS = { "+": 0.8, "=": 0.8, "-": 1.25 };

const ordered = (a, b) => (a < b ? [a, b] : [b, a]);

export class PlotInput {
  constructor(plot) {
    Object.assign(this, { plot, view: plot.view, grip: null, hover: null });
    this.moved = new OncePerFrame(() => this.follow());
    const { top, listeners } = plot;
    listeners.end(() => this.moved.cancel());
    listeners.on(top, "pointerdown", (e) => this.down(e));
    listeners.on(top, "pointermove", (e) => this.move(e));
    listeners.on(top, "pointerup", (e) => this.up(placeIn(top, e)));
    listeners.on(top, "pointercancel", () => this.cancel());
    listeners.on(top, "dblclick", () => this.plot.grid.showAll());
    listeners.on(top, "wheel", (e) => this.wheel(e), { passive: false });
    listeners.on(top, "keydown", (e) => this.key(e));
  }

  down(e) {
    const { plot, view } = this;
    if (e.button || !plot.size) return;
    const p = placeIn(plot.top, e), zoom = view.mode === "zoom" || plot.grid.zoomKey;
    plot.top.setPointerCapture(e.pointerId);
    this.grip = this.gripAt(p.x);
    if (this.grip) return;
    view.beginBrush();
    plot.box = { x0: p.x, y0: p.y, x1: p.x, y1: p.y, how: zoom ? "zoom" : e.altKey ? "subtract" : e.shiftKey ? "add" : "replace" };
  }

  move(e) {
    const { plot } = this;
    this.hover = placeIn(plot.top, e);
    if (!plot.size) return;
    if (plot.box) Object.assign(plot.box, { x1: this.hover.x, y1: this.hover.y });
    else plot.top.style.cursor = this.gripAt(this.hover.x) ? "ew-resize" : "crosshair";
    this.moved.ask();
  }

  /** At most once per animation frame: the handle, the box or the cursor follows the pointer. */
  follow() {
    const { plot, view, hover } = this;
    if (this.grip) this.grip.handle.span[this.grip.k] = plot.axes.x.at(hover.x);
    else if (plot.box && plot.box.how !== "zoom" && !this.isClick) this.choose(hover);
    else if (!plot.box && view.rows) view.point(plot.nearest(hover), "hover");
    plot.drawTop();
  }

  get isClick() {
    const { x0, y0, x1, y1 } = this.plot.box;
    return Math.abs(x1 - x0) < CLICK && Math.abs(y1 - y0) < CLICK;
  }

  get boxValues() {
    const { axes, box } = this.plot;
    return { x: ordered(axes.x.at(box.x0), axes.x.at(box.x1)), y: ordered(axes.y.at(box.y0), axes.y.at(box.y1)) };
  }

  brush() {
    const { plot } = this, { x, y } = this.boxValues;
    this.view.brush((mask) => plot.fillBox(mask, x, plot.spec.brush === "x" ? [-Infinity, Infinity] : y), plot.box.how);
  }

  up(p) {
    const { plot, view, grip } = this;
    this.moved.cancel();
    if (grip) {
      this.grip = null;
      this.tellHandle(grip.handle);
    } else if (plot.box) {
      Object.assign(plot.box, { x1: p.x, y1: p.y });
      if (this.isClick) {
        view.cancelBrush(); // the box may have been larger before
        view.point(plot.nearest(p));
      }
      else if (plot.box.how === "zoom") this.zoomTo(this.boxValues);
      else {
        this.choose(p);
        view.announce();
      }
      plot.box = null;
    }
    plot.drawTop();
  }

  /** Select the box; the cursor goes to the nearest selected point, so that the film shows one of these frames. */
  choose(p) {
    this.brush();
    const row = this.view.count ? this.plot.nearest(p, this.view.mask) : null;
    if (row !== null && row !== this.view.cursor) this.view.point(row, "selection");
  }

  cancel() {
    if (this.plot.box && this.plot.box.how !== "zoom") this.view.cancelBrush();
    this.plot.box = this.grip = null;
    this.plot.drawTop();
  }

  // --- zoom

  zoomTo({ x, y }) { this.plot.grid.zoom(this.plot, { x: new Axis(...x), y: this.plot.spec.brush === "x" ? this.plot.zoom.y : new Axis(...y) }); }

  /** Zoom about a place; outside the frame of the plot only the axis there. */
  zoomAt(p, factor) {
    const { axes, inner, zoom } = this.plot, alongX = p.x >= inner.x, alongY = p.y <= inner.y + inner.h;
    this.plot.grid.zoom(this.plot, { x: alongX ? axes.x.zoomed(p.x, factor) : zoom.x, y: alongY ? axes.y.zoomed(p.y, factor) : zoom.y });
  }

  wheel(e) {
    if (!e.ctrlKey && !e.metaKey) return; // the page scrolls
    e.preventDefault();
    this.zoomAt(placeIn(this.plot.top, e), e.deltaY > 0 ? 1.25 : 0.8);
  }

  // --- handles of the free section

  gripAt(px) {
    for (const handle of this.plot.spec.handles || []) {
      const k = handle.span.findIndex((value) => Math.abs(this.plot.axes.x.px(value) - px) < NEAR_HANDLE);
      if (k >= 0) return { handle, k };
    }
    return null;
  }

  tellHandle(handle) {
    handle.span.sort((a, b) => a - b);
    this.view.say("moved", { handle: handle.name, span: [...handle.span] });
  }

  /** Put the beginning (0) or the end (1) of the first handle at the cursor. */
  handleToCursor(k) {
    const { plot, view } = this, handle = plot.spec.handles?.[0];
    if (!handle || !plot.main || view.cursor === null) return;
    handle.span[k] = plot.xOf(plot.main)[view.cursor];
    this.tellHandle(handle);
    plot.drawTop();
  }

  key(e) {
    const { plot, view } = this, { key } = e;
    if (e.ctrlKey || e.metaKey || !plot.size) return;
    const { x, y, w, h } = plot.inner;
    if (STEPS[key]) view.step(STEPS[key], e.shiftKey);
    else if (ZOOMS[key]) this.zoomAt({ x: x + w / 2, y: y + h / 2 }, ZOOMS[key]);
    else if (key === "0") plot.grid.showAll();
    else if (key === "[" || key === "]") this.handleToCursor(key === "[" ? 0 : 1);
    else if (key === "Enter") view.point(view.cursor ?? 0);
    else if (key === "Escape") this.escape();
    else return;
    e.preventDefault();
  }

  escape() {
    if (this.plot.box) return this.cancel();
    this.view.release();
    this.view.select(null);
  }
}
