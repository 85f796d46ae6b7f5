// Draw linked plots and the film: a selection in one plot is shown in all others and in the film.
// No dependencies. The interface is that of anywidget, so that Panel and JupyterLab load the same file.
//
// In:  scene  what is drawn: {rows, columns: {key: [offset, length]}, runs: [{name, first, count, colour}], plots: [...]}
//      data   the columns, Float32 little endian, one after the other; those of `rows` values are linked
//      film   {frames, width, height, first, frame, label, tracks: [{name, x, y, w, h, colour}], shapes: {tool: [...]}} or {}
//      frame  4 bytes number of the frame (little endian), then its JPEG
//      tool   what a drag on the film draws: "", "target", "reference", "ruler"
// Out: selection {count, middle, per_run}, want {frame}, drawn {tool, shape}, moved {handle, span}; each with `seq`

const INK = "#1a1a1a", GREY = "#767676", PALE = "#d9d9d9", CHOSEN = "#d55e00", CURSOR = "#0072b2";
const SPACE = { left: 74, right: 10, top: 24, bottom: 36 };
const FONT = "12px system-ui, sans-serif";

function make(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  node.append(...children);
  return node;
}

function bytesOf(value) {
  if (!value) return new Uint8Array();
  if (value instanceof ArrayBuffer) return new Uint8Array(value);
  return new Uint8Array(value.buffer, value.byteOffset, value.byteLength);
}

function columnsOf(scene, value) {
  const bytes = bytesOf(value), all = new Float32Array(bytes.slice().buffer, 0, bytes.byteLength >> 2), found = {};
  for (const [key, [offset, length]] of Object.entries(scene.columns || {})) {
    found[key] = all.subarray(offset, offset + length);
  }
  return found;
}

// Round numbers between two values, about `count` of them.
function ticks(low, high, count) {
  const rough = (high - low) / Math.max(count, 1), power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((k) => k * power >= rough * 0.999);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(k * step);
  return { step, values: found };
}

function written(value, step) {
  if (value === 0) return "0";
  const size = Math.max(Math.abs(value), step);
  if (size >= 1e5 || step < 1e-7) return value.toExponential(Math.max(0, Math.floor(Math.log10(size)) - Math.floor(Math.log10(step)))).replace("-", "\u2212");
  return value.toFixed(Math.max(0, -Math.floor(Math.log10(step) + 1e-9))).replace("-", "\u2212");
}

function colour(hex) {
  const v = parseInt(hex.slice(1), 16);
  return [v >> 16, (v >> 8) & 255, v & 255];
}

// Values of one axis on the pixels of one side of a plot.
class Axis {
  constructor(low, high) { this.low = low; this.high = high; }
  static around(values, room) {
    let low = Infinity, high = -Infinity;
    for (const column of values) for (const v of column) { if (v < low) low = v; if (v > high) high = v; }
    if (!(low <= high)) return new Axis(0, 1);
    const pad = room * (high - low) || Math.abs(high) * 0.05 || 1;
    return new Axis(low - pad, high + pad);
  }
  on(from, to) { this.from = from; this.to = to; this.k = (to - from) / (this.high - this.low); return this; }
  px(value) { return this.from + (value - this.low) * this.k; }
  at(px) { return this.low + (px - this.from) / this.k; }
  zoomed(px, factor) {
    const c = this.at(px);
    return new Axis(c + (this.low - c) * factor, c + (this.high - c) * factor);
  }
}

class Plot {
  constructor(bench, spec) {
    Object.assign(this, { bench, spec, view: null, brush: null, grip: null });
    this.base = make("canvas");
    this.top = make("canvas", {
      tabindex: 0, role: "img",
      "aria-label": `${spec.title}. Arrow keys move along the data, with shift they select; + and \u2212 zoom, 0 shows all, escape clears.`,
    });
    this.el = make("div", { class: "ft-plot" }, this.base, this.top);
    this.listen();
  }

  column(key) { return this.bench.columns[key] || new Float32Array(); }
  linked(layer) { return ["dots", "line"].includes(layer.kind) && this.column(layer.y).length === this.bench.scene.rows; }
  xOf(layer) { return this.column(layer.x || this.spec.x.column); }
  get main() { const linked = this.spec.layers.filter((layer) => this.linked(layer)); return linked.find((l) => l.main) || linked[0]; }

  home() {
    const shown = this.spec.layers.filter((l) => l.kind !== "span" && !l.loose);
    const { focus } = this.spec;  // of x: values outside it do not change the y axis
    const near = (l, key) => {
      const xs = this.xOf(l), values = this.column(key);
      return focus ? values.filter((v, i) => xs[i] >= focus[0] && xs[i] <= focus[1]) : values;
    };
    const ys = shown.flatMap((l) => (l.kind === "band" ? [near(l, l.low), near(l, l.high)] : [near(l, l.y)]));
    return { x: Axis.around(shown.map((l) => this.xOf(l)), 0.02), y: Axis.around(ys, 0.06) };
  }

  resize() {
    const box = this.el.getBoundingClientRect(), ratio = window.devicePixelRatio || 1;
    if (!box.width || !box.height) return;
    this.size = { width: box.width, height: box.height, ratio };
    for (const canvas of [this.base, this.top]) {
      canvas.width = Math.round(box.width * ratio);
      canvas.height = Math.round(box.height * ratio);
    }
    this.draw();
  }

  get inner() {
    const { width, height } = this.size;
    return { x: SPACE.left, y: SPACE.top, w: width - SPACE.left - SPACE.right, h: height - SPACE.top - SPACE.bottom };
  }

  pen(canvas) {
    const pen = canvas.getContext("2d", { willReadFrequently: true });
    pen.setTransform(this.size.ratio, 0, 0, this.size.ratio, 0, 0);
    pen.clearRect(0, 0, this.size.width, this.size.height);
    pen.font = FONT;
    return pen;
  }

  draw() {
    if (!this.size) return;
    if (!this.view) this.view = this.home();
    const { x, y, w, h } = this.inner, pen = this.pen(this.base);
    this.view.x.on(x, x + w);
    this.view.y.on(y + h, y);
    pen.fillStyle = "#fff";
    pen.fillRect(0, 0, this.size.width, this.size.height);
    this.axes(pen);
    pen.save();
    pen.beginPath();
    pen.rect(x, y, w, h);
    pen.clip();
    for (const kind of ["span", "band", "line"]) {
      for (const layer of this.spec.layers.filter((l) => l.kind === kind)) this[kind](pen, layer);
    }
    pen.restore();
    for (const layer of this.spec.layers.filter((l) => l.kind === "dots")) this.dots(this.base, layer, null);
    this.legend(pen);
    this.overlay();
  }

  axes(pen) {
    const { x, y, w, h } = this.inner, { view } = this;
    const across = ticks(view.x.low, view.x.high, w / 80), up = ticks(view.y.low, view.y.high, h / 36);
    pen.strokeStyle = "#ececec";
    pen.fillStyle = INK;
    pen.textAlign = "center";
    for (const v of across.values) {
      const px = Math.round(view.x.px(v)) + 0.5;
      pen.beginPath(); pen.moveTo(px, y); pen.lineTo(px, y + h); pen.stroke();
      pen.fillText(written(v, across.step), px, y + h + 14);
    }
    pen.textAlign = "right";
    for (const v of up.values) {
      const py = Math.round(view.y.px(v)) + 0.5;
      pen.beginPath(); pen.moveTo(x, py); pen.lineTo(x + w, py); pen.stroke();
      pen.fillText(written(v, up.step), x - 5, py + 4);
    }
    pen.strokeStyle = GREY;
    pen.strokeRect(x + 0.5, y + 0.5, w - 1, h - 1);
    pen.textAlign = "center";
    pen.fillText(this.spec.x.label, x + w / 2, y + h + 30);
    pen.save();
    pen.translate(13, y + h / 2);
    pen.rotate(-Math.PI / 2);
    pen.fillText(this.spec.y.label, 0, 0);
    pen.restore();
    pen.textAlign = "left";
    pen.font = `600 ${FONT}`;
    pen.fillText(this.spec.title, x, 15);
    pen.font = FONT;
  }

  // Next to the title; without room there, inside the plot at the top right on a pale background.
  legend(pen) {
    const { x, w } = this.inner, told = this.spec.layers.filter((l) => l.label);
    if (!told.length) return;
    const width = told.reduce((sum, l) => sum + pen.measureText(l.label).width + 32, 0);
    pen.font = `600 ${FONT}`;
    const beside = pen.measureText(this.spec.title).width + width + 12 < w, y = beside ? SPACE.top - 21 : SPACE.top;
    pen.font = FONT;
    pen.fillStyle = "rgba(255,255,255,.8)";
    if (!beside) pen.fillRect(x + w - width - 4, y + 2, width + 2, 18);
    pen.textAlign = "right";
    let at = x + w - (beside ? 0 : 8);
    for (const layer of told.reverse()) {
      pen.fillStyle = INK;
      pen.fillText(layer.label, at, y + 15);
      at -= pen.measureText(layer.label).width + 5;
      pen.fillStyle = layer.colour;
      if (layer.kind === "line") pen.fillRect(at - 16, y + 10, 16, 2.5);
      else if (layer.kind === "dots") { pen.beginPath(); pen.arc(at - 8, y + 11, 2.5, 0, 7); pen.fill(); }
      else pen.fillRect(at - 16, y + 6, 16, 10);
      at -= 27;
    }
  }

  // A shaded span over the whole height, or a bar at the bottom, one line of bars per run.
  span(pen, layer) {
    const { y, h } = this.inner, from = this.view.x.px(layer.from), to = this.view.x.px(layer.to), foot = layer.foot;
    pen.fillStyle = layer.colour;
    pen.fillRect(from, foot === undefined ? y : y + h - 6 - 6 * foot, Math.max(to - from, 2), foot === undefined ? h : 4);
  }

  band(pen, layer) {
    const xs = this.xOf(layer), low = this.column(layer.low), high = this.column(layer.high), { x, y } = this.view;
    pen.fillStyle = layer.colour;
    pieces(low, (from, to) => {
      pen.beginPath();
      for (let i = from; i < to; i++) pen.lineTo(x.px(xs[i]), y.px(high[i]));
      for (let i = to - 1; i >= from; i--) pen.lineTo(x.px(xs[i]), y.px(low[i]));
      pen.fill();
    });
  }

  // Minimum and maximum of every pixel column: the same picture as all points, for any number of points.
  line(pen, layer) {
    const xs = this.xOf(layer), ys = this.column(layer.y), { x, y } = this.view;
    pen.strokeStyle = layer.colour;
    pen.lineWidth = layer.width || 1.5;
    pen.setLineDash(layer.dash || []);
    pieces(ys, (from, to) => {
      const many = to - from > 4 * this.inner.w;
      pen.beginPath();
      if (!many) for (let i = from; i < to; i++) pen.lineTo(x.px(xs[i]), y.px(ys[i]));
      for (let i = from; many && i < to;) {
        const px = Math.floor(x.px(xs[i]));
        let low = ys[i], high = ys[i];
        for (; i < to && Math.floor(x.px(xs[i])) === px; i++) { low = Math.min(low, ys[i]); high = Math.max(high, ys[i]); }
        pen.lineTo(px + 0.5, y.px(low));
        pen.lineTo(px + 0.5, y.px(high));
      }
      pen.stroke();
    });
    pen.setLineDash([]);
    pen.lineWidth = 1;
  }

  // Draw every point, because rare points matter most.
  dots(canvas, layer, mask) {
    const { ratio } = this.size, { x: left, y: top, w, h } = this.inner, { x, y } = this.view;
    const X = Math.round(left * ratio), Y = Math.round(top * ratio), W = Math.round(w * ratio), H = Math.round(h * ratio);
    if (W < 2 || H < 2) return;
    const pen = canvas.getContext("2d"), image = pen.getImageData(X, Y, W, H), pixels = image.data;
    const xs = this.xOf(layer), ys = this.column(layer.y), size = Math.max(1, Math.round((mask ? 2.5 : 1.5) * ratio)), half = size >> 1;
    const chosen = colour(CHOSEN), own = colour(layer.colour || INK);
    const paint = (from, to, [r, g, b]) => {
      for (let i = from; i < to; i++) {
        if (mask && !mask[i]) continue;
        const cx = Math.round(x.px(xs[i]) * ratio) - X - half, cy = Math.round(y.px(ys[i]) * ratio) - Y - half;
        if (!(cx >= 0 && cy >= 0 && cx + size <= W && cy + size <= H)) continue;
        for (let v = 0; v < size; v++) {
          for (let u = 0, at = 4 * ((cy + v) * W + cx); u < size; u++, at += 4) {
            pixels[at] = r; pixels[at + 1] = g; pixels[at + 2] = b; pixels[at + 3] = 255;
          }
        }
      }
    };
    const runs = this.bench.scene.runs || [];
    if (mask) paint(0, ys.length, chosen);
    else if (layer.by_run && runs.length) for (const r of runs) paint(r.first, r.first + r.count, colour(r.colour));
    else paint(0, ys.length, own);
    pen.putImageData(image, X, Y);
  }

  overlay() {
    if (!this.size) return;
    const pen = this.pen(this.top), { x, y, w, h } = this.inner, layer = this.main, { chosen, cursor } = this.bench;
    if (layer && chosen) this.dots(this.top, layer, chosen.mask);
    pen.lineWidth = 1;
    if (layer && cursor !== null) {
      const px = this.view.x.px(this.xOf(layer)[cursor]), py = this.view.y.px(this.column(layer.y)[cursor]);
      pen.strokeStyle = CURSOR;
      if (px >= x && px <= x + w) {
        pen.beginPath(); pen.moveTo(px, y); pen.lineTo(px, y + h); pen.stroke();
        if (py >= y && py <= y + h) { pen.beginPath(); pen.arc(px, py, 5, 0, 7); pen.stroke(); }
      }
    }
    for (const handle of this.spec.handles || []) this.handle(pen, handle);
    if (this.brush) {
      const { x0, y0, x1, y1, zoom } = this.brush;
      pen.fillStyle = zoom ? "rgba(0,114,178,.12)" : "rgba(213,94,0,.12)";
      pen.strokeStyle = zoom ? CURSOR : CHOSEN;
      pen.fillRect(x0, y0, x1 - x0, y1 - y0);
      pen.strokeRect(x0, y0, x1 - x0, y1 - y0);
    }
  }

  handle(pen, handle) {
    const { y, h } = this.inner;
    for (const value of handle.span) {
      const px = this.view.x.px(value);
      pen.strokeStyle = pen.fillStyle = "#009e73";
      pen.lineWidth = 2;
      pen.beginPath(); pen.moveTo(px, y); pen.lineTo(px, y + h); pen.stroke();
      pen.fillRect(px - 5, y + h / 2 - 14, 10, 28);
    }
    pen.lineWidth = 1;
  }

  gripped(px) {
    for (const handle of this.spec.handles || []) {
      const k = handle.span.findIndex((value) => Math.abs(this.view.x.px(value) - px) < 7);
      if (k >= 0) return { handle, k };
    }
    return null;
  }

  listen() {
    const at = (e) => { const box = this.top.getBoundingClientRect(); return { x: e.clientX - box.left, y: e.clientY - box.top }; };
    this.top.addEventListener("pointerdown", (e) => {
      if (e.button) return;
      const p = at(e);
      this.top.setPointerCapture(e.pointerId);
      this.grip = this.gripped(p.x);
      if (!this.grip) this.brush = { x0: p.x, y0: p.y, x1: p.x, y1: p.y, zoom: e.shiftKey };
    });
    this.top.addEventListener("pointermove", (e) => {
      const p = at(e);
      if (this.grip) { this.grip.handle.span[this.grip.k] = this.view.x.at(p.x); this.overlay(); }
      else if (this.brush) { this.brush.x1 = p.x; this.brush.y1 = p.y; this.overlay(); }
      else this.top.style.cursor = this.size && this.gripped(p.x) ? "ew-resize" : "crosshair";
    });
    this.top.addEventListener("pointerup", (e) => this.release(at(e)));
    this.top.addEventListener("pointercancel", () => { this.brush = this.grip = null; this.overlay(); });
    this.top.addEventListener("dblclick", () => this.look(this.home()));
    this.top.addEventListener("wheel", (e) => {
      if (!e.ctrlKey && !e.shiftKey && document.activeElement !== this.top) return;  // do not catch the wheel when the page is scrolled
      e.preventDefault();
      const p = at(e), factor = e.deltaY + e.deltaX > 0 ? 1.25 : 0.8;
      this.look({ x: this.view.x.zoomed(p.x, factor), y: this.view.y.zoomed(p.y, factor) });
    }, { passive: false });
    this.top.addEventListener("keydown", (e) => this.key(e));
  }

  look(view) { this.view = view; this.draw(); }

  release(p) {
    const { brush, grip } = this;
    this.brush = this.grip = null;
    if (grip) {
      grip.handle.span.sort((a, b) => a - b);
      this.bench.say("moved", { handle: grip.handle.name, span: [...grip.handle.span] });
      return this.overlay();
    }
    if (!brush) return;
    const small = Math.abs(p.x - brush.x0) < 4 && Math.abs(p.y - brush.y0) < 4;
    const xs = [this.view.x.at(brush.x0), this.view.x.at(p.x)].sort((a, b) => a - b);
    const ys = [this.view.y.at(brush.y0), this.view.y.at(p.y)].sort((a, b) => a - b);
    if (small) this.bench.point(this.nearest(p));
    else if (brush.zoom) return this.look({ x: new Axis(...xs), y: new Axis(...ys) });
    else this.bench.choose(this.inside(xs, this.spec.brush === "x" ? [-Infinity, Infinity] : ys));
    this.overlay();
  }

  inside([x0, x1], [y0, y1]) {
    const layer = this.main;
    if (!layer) return null;
    const xs = this.xOf(layer), ys = this.column(layer.y), mask = new Uint8Array(ys.length);
    for (let i = 0; i < ys.length; i++) mask[i] = xs[i] >= x0 && xs[i] <= x1 && ys[i] >= y0 && ys[i] <= y1;
    return mask;
  }

  nearest(p) {
    const layer = this.main;
    if (!layer) return null;
    const xs = this.xOf(layer), ys = this.column(layer.y), reach = this.spec.brush === "x" ? 0 : 1;
    let best = null, least = Infinity;
    for (let i = 0; i < ys.length; i++) {
      const d = (this.view.x.px(xs[i]) - p.x) ** 2 + reach * (this.view.y.px(ys[i]) - p.y) ** 2;
      if (d < least) { least = d; best = i; }
    }
    return best;
  }

  key(e) {
    const { x, y, w, h } = this.inner, step = { ArrowLeft: -1, ArrowRight: 1, PageUp: -25, PageDown: 25 }[e.key];
    const zoom = { "+": 0.8, "=": 0.8, "-": 1.25 }[e.key];
    if (step) this.bench.step(step, e.shiftKey);
    else if (zoom) this.look({ x: this.view.x.zoomed(x + w / 2, zoom), y: this.view.y.zoomed(y + h / 2, zoom) });
    else if (e.key === "0") this.look(this.home());
    else if (e.key === "Escape") this.bench.choose(null);
    else return;
    e.preventDefault();
  }
}

// Call `each(from, to)` for every span of finite values.
function pieces(values, each) {
  for (let i = 0; i < values.length;) {
    while (i < values.length && Number.isNaN(values[i])) i++;
    const from = i;
    while (i < values.length && !Number.isNaN(values[i])) i++;
    if (i > from) each(from, i);
  }
}

class Film {
  constructor(bench) {
    this.bench = bench;
    this.number = 0;
    this.canvas = make("canvas", { class: "ft-frame", "aria-label": "film" });
    this.slider = make("input", { type: "range", min: 0, value: 0, "aria-label": "frame of the film" });
    this.label = make("output", { class: "ft-label" });
    this.button = make("button", { type: "button", "aria-label": "play or pause" }, "\u25b6");
    this.el = make("div", { class: "ft-film" }, this.canvas, make("div", { class: "ft-bar" }, this.button, this.slider), this.label);
    this.slider.addEventListener("input", () => this.ask(Number(this.slider.value)));
    this.button.addEventListener("click", () => this.play());
    this.listen();
  }

  get film() { return this.bench.model.get("film") || {}; }

  show() {
    const { film } = this;
    this.el.hidden = !film.frames;
    this.slider.max = Math.max((film.frames || 1) - 1, 0);
    this.canvas.style.aspectRatio = `${film.width || 4} / ${film.height || 3}`;
    this.draw();
  }

  // Request one frame at a time; of several requests only the last is sent.
  ask(number) {
    this.next = number;
    this.slider.value = number;
    if (!this.waiting && this.film.frames) {
      this.waiting = setTimeout(() => { this.waiting = null; }, 2000);
      this.bench.say("want", { frame: number });
      this.next = null;
    }
  }

  async received(value) {
    const bytes = bytesOf(value);
    if (bytes.length < 5) return;
    const number = new DataView(bytes.buffer, bytes.byteOffset).getUint32(0, true);
    const picture = await createImageBitmap(new Blob([bytes.slice(4)], { type: "image/jpeg" }));
    Object.assign(this, { number, picture });
    clearTimeout(this.waiting);
    this.waiting = null;
    if (this.next == null || this.next === number) this.slider.value = number;
    this.draw();
    if (this.next != null && this.next !== number) this.ask(this.next);
  }

  play() {
    if (this.playing) { clearInterval(this.playing); this.playing = null; }
    else this.playing = setInterval(() => this.ask((this.number + 1) % this.film.frames), 60);
    this.button.textContent = this.playing ? "\u275a\u275a" : "\u25b6";
  }

  draw() {
    const { canvas, film, picture } = this;
    if (!picture || !film.width) return;
    canvas.width = Math.max(picture.width, 480);
    canvas.height = Math.round((canvas.width * film.height) / film.width);
    const pen = canvas.getContext("2d"), k = canvas.width / film.width;
    pen.imageSmoothingEnabled = k < 2;
    pen.drawImage(picture, 0, 0, canvas.width, canvas.height);
    pen.setTransform(k, 0, 0, k, k / 2, k / 2);  // pixel centres are integers
    pen.lineWidth = 1.5 / k;
    for (const track of film.tracks || []) this.track(pen, track, k);
    for (const [tool, shape] of Object.entries({ ...film.shapes, ...(this.drag ? { [this.drag.tool]: this.shape() } : {}) })) this.outline(pen, tool, shape, k);
    pen.setTransform(1, 0, 0, 1, 0, 0);
    this.label.textContent = `${film.label || ""} \u00b7 frame ${this.number} of ${film.frames}` + (film.fps ? ` \u00b7 ${(1e3 * this.number / film.fps).toFixed(2)} ms` : "");
  }

  track(pen, track, k) {
    const xs = this.bench.columns[track.x], ys = this.bench.columns[track.y], { mask } = this.bench.chosen || {};
    if (!xs) return;
    pen.fillStyle = CHOSEN;
    const { first, frame } = this.film;
    for (let i = frame; mask && i < xs.length; i++) if (mask[first + i - frame]) pen.fillRect(xs[i] - 1 / k, ys[i] - 1 / k, 2 / k, 2 / k);
    const x = xs[this.number], y = ys[this.number];
    if (Number.isNaN(x)) return;
    pen.strokeStyle = track.colour;
    pen.strokeRect(x - track.w / 2, y - track.h / 2, track.w, track.h);
    pen.beginPath(); pen.moveTo(x - 4, y); pen.lineTo(x + 4, y); pen.moveTo(x, y - 4); pen.lineTo(x, y + 4); pen.stroke();
  }

  outline(pen, tool, shape, k) {
    if (!shape) return;
    pen.strokeStyle = { target: "#e69f00", reference: "#56b4e9", ruler: "#f0e442" }[tool] || "#fff";
    pen.beginPath();
    if (tool === "ruler") { pen.moveTo(...shape[0]); pen.lineTo(...shape[1]); for (const p of shape) pen.rect(p[0] - 3 / k, p[1] - 3 / k, 6 / k, 6 / k); }
    else if (shape.length === 4) pen.rect(...shape);
    else { pen.moveTo(shape[0] - 6 / k, shape[1]); pen.lineTo(shape[0] + 6 / k, shape[1]); pen.moveTo(shape[0], shape[1] - 6 / k); pen.lineTo(shape[0], shape[1] + 6 / k); }
    pen.stroke();
  }

  shape() {
    const { tool, from, to } = this.drag, round = (v) => Math.round(10 * v) / 10;
    if (tool === "ruler") return [from.map(round), to.map(round)];
    if (Math.hypot(to[0] - from[0], to[1] - from[1]) < 3) return from.map(round);
    return [Math.min(from[0], to[0]), Math.min(from[1], to[1]), Math.abs(to[0] - from[0]), Math.abs(to[1] - from[1])].map(round);
  }

  listen() {
    const at = (e) => {
      const box = this.canvas.getBoundingClientRect();
      return [((e.clientX - box.left) / box.width) * this.film.width - 0.5, ((e.clientY - box.top) / box.height) * this.film.height - 0.5];
    };
    this.canvas.addEventListener("pointerdown", (e) => {
      const tool = this.bench.model.get("tool");
      if (!tool) return;
      this.canvas.setPointerCapture(e.pointerId);
      this.drag = { tool, from: at(e), to: at(e) };
    });
    this.canvas.addEventListener("pointermove", (e) => {
      this.canvas.style.cursor = this.bench.model.get("tool") ? "crosshair" : "default";
      if (this.drag) { this.drag.to = at(e); this.draw(); }
    });
    this.canvas.addEventListener("pointerup", () => {
      if (!this.drag) return;
      const drawn = { tool: this.drag.tool, shape: this.shape() };
      this.drag = null;
      this.bench.say("drawn", drawn);
    });
  }
}

class Bench {
  constructor(model, el) {
    Object.assign(this, { model, el, seq: 0, chosen: null, cursor: null, anchor: null, columns: {}, plots: [] });
    this.film = new Film(this);
    this.grid = make("div", { class: "ft-grid" });
    this.status = make("p", { class: "ft-status", "aria-live": "polite" });
    el.replaceChildren(make("style", {}, STYLE), make("div", { class: "ft-bench" }, this.film.el, this.grid), this.status);
    this.watch = new ResizeObserver(() => this.plots.forEach((plot) => plot.resize()));
    this.watch.observe(el);
    this.rebuild();
    this.film.show();
    this.film.received(model.get("frame"));
  }

  say(what, value) {
    this.model.set(what, { ...value, seq: ++this.seq });
    this.model.save_changes();
  }

  // The scene and its columns arrive one after the other.
  changed() {
    if (!this.pending) this.pending = requestAnimationFrame(() => { this.pending = null; this.rebuild(); });
  }

  rebuild() {
    const views = new Map(this.plots.map((plot) => [plot.spec.id, plot.view])), same = this.scene && this.scene.rows === this.model.get("scene").rows;
    this.scene = this.model.get("scene") || {};
    this.columns = columnsOf(this.scene, this.model.get("data"));
    if (!same) this.chosen = this.cursor = null;
    this.plots = (this.scene.plots || []).map((spec) => new Plot(this, structuredClone(spec)));
    for (const plot of this.plots) if (same && this.scene.keep) plot.view = views.get(plot.spec.id) || null;
    this.grid.replaceChildren(...this.plots.map((plot) => plot.el));
    this.plots.forEach((plot) => plot.resize());
    this.film.draw();
  }

  runOf(row) { return (this.scene.runs || []).find((run) => row >= run.first && row < run.first + run.count); }

  choose(mask) {
    const rows = [];
    for (let i = 0; mask && i < mask.length; i++) if (mask[i]) rows.push(i);
    this.chosen = rows.length ? { mask, rows } : null;
    const per_run = {};
    for (const run of this.scene.runs || []) {
      const count = rows.reduce((n, i) => n + (i >= run.first && i < run.first + run.count), 0);
      if (count) per_run[run.name] = count;
    }
    this.cursor = rows.length ? rows[rows.length >> 1] : null;
    this.plots.forEach((plot) => plot.overlay());
    this.film.draw();
    const counts = Object.entries(per_run).map(([name, count]) => `${count} in ${name}`).join(", ");
    this.status.textContent = rows.length ? `${rows.length} frames selected: ${counts}` : "";
    this.say("selection", { count: rows.length, middle: this.cursor, per_run });
  }

  point(row) {
    if (row === null) return;
    this.cursor = this.anchor = row;
    this.plots.forEach((plot) => plot.overlay());
    this.tell();
    this.say("selection", { count: this.chosen ? this.chosen.rows.length : 0, middle: row, per_run: {} });
  }

  step(by, extend) {
    const from = this.cursor ?? 0, row = Math.min(Math.max(from + by, 0), this.scene.rows - 1);
    if (!extend) return this.point(row);
    const mask = new Uint8Array(this.scene.rows), anchor = this.anchor ?? from;
    mask.fill(1, Math.min(anchor, row), Math.max(anchor, row) + 1);
    this.choose(mask);
    this.cursor = row;
    this.anchor = anchor;
  }

  tell() {
    const run = this.runOf(this.cursor), seen = new Set(), words = [];
    for (const { spec } of this.plots) {
      for (const [label, key] of [[spec.x.label, spec.x.column], ...spec.layers.filter((l) => l.label && l.y).map((l) => [`${l.label}, ${spec.y.label}`, l.y])]) {
        const column = this.columns[key];
        if (seen.has(key) || !column || column.length !== this.scene.rows) continue;
        seen.add(key);
        words.push(`${label}: ${Number(column[this.cursor]).toPrecision(4)}`);
      }
    }
    this.status.textContent = `${run ? `${run.name}, frame ${this.cursor - run.first + run.frame} \u00b7 ` : ""}${words.join(" \u00b7 ")}`;
  }
}

const STYLE = `
.ft-bench { display: flex; flex-wrap: wrap; gap: 10px; align-items: flex-start; }
.ft-film { flex: 1 1 340px; max-width: 640px; }
.ft-film:only-child, .ft-film:has(+ .ft-grid:empty) { max-width: 960px; }
.ft-film[hidden] { display: none; }
.ft-frame { width: 100%; background: #222; display: block; touch-action: none; }
.ft-bar { display: flex; gap: 6px; align-items: center; margin-top: 4px; }
.ft-bar input { flex: 1; }
.ft-bar button { width: 34px; height: 28px; font: 13px system-ui, sans-serif; }
.ft-label, .ft-status { font: 13px system-ui, sans-serif; color: ${INK}; margin: 4px 0; display: block; min-height: 1.3em; }
.ft-grid { flex: 3 1 520px; display: grid; grid-template-columns: repeat(auto-fit, minmax(340px, 1fr)); gap: 8px; }
.ft-plot { position: relative; height: 230px; border: 1px solid ${PALE}; }
.ft-plot canvas { position: absolute; inset: 0; width: 100%; height: 100%; touch-action: none; }
.ft-plot canvas:focus-visible, .ft-bar *:focus-visible { outline: 3px solid ${CURSOR}; outline-offset: -2px; }
`;

export default {
  render({ model, el }) {
    const bench = new Bench(model, el);
    const on = { scene: () => bench.changed(), data: () => bench.changed(), film: () => bench.film.show(), frame: () => bench.film.received(model.get("frame")) };
    for (const [name, call] of Object.entries(on)) model.on(`change:${name}`, call);
    return () => bench.watch.disconnect();
  },
};
