// Draw lines, bands and spans on a canvas.

import { finitePieces } from "./packed.js";

const HALO = 5; // px, of the colour of the run around the line of its model
const BAR = 4, BAR_STEP = 6; // px, bars at the bottom of a plot that mark where the model fails

/** Call `each(from, to, run)` for the visible rows of a column: the rows of one run after the other. */
export function visibleParts(view, column, each) {
  if (column.length !== view.rows || !view.runs.length) return each(0, column.length, null);
  for (const run of view.visibleRuns) each(run.first, run.first + run.count, run);
}

/** Through the points; of many points only the least and the largest in every pixel column, which is the same picture. */
function trace(pen, xs, ys, { x, y }, from, to, many) {
  pen.beginPath();
  if (!many) for (let i = from; i < to; i++) pen.lineTo(x.px(xs[i]), y.px(ys[i]));
  for (let i = from; many && i < to;) {
    const px = Math.floor(x.px(xs[i]));
    let low = ys[i], high = ys[i];
    for (; i < to && Math.floor(x.px(xs[i])) === px; i++) {
      if (ys[i] < low) low = ys[i];
      if (ys[i] > high) high = ys[i];
    }
    pen.lineTo(px + 0.5, y.px(low));
    pen.lineTo(px + 0.5, y.px(high));
  }
  pen.stroke();
}

/** A line with gaps at NaN, in its own colour or in that of each run. */
export function drawLine(pen, plot, layer, xs, ys) {
  const { view, colours, axes } = plot;
  pen.lineJoin = "round";
  pen.setLineDash(layer.dash || []);
  visibleParts(view, ys, (first, last, run) => {
    finitePieces(ys, first, last, (from, to) => {
      const many = to - from > 4 * plot.inner.w;
      const stroke = (colour, width, alpha = 1) => {
        Object.assign(pen, { strokeStyle: colour, lineWidth: width, globalAlpha: alpha });
        trace(pen, xs, ys, axes, from, to, many);
      };
      if (layer.halo && run) stroke(colours.ofRun(run.index), (layer.width || 1.5) + HALO, 0.35);
      stroke(layer.by_run && run ? colours.ofRun(run.index) : colours[layer.colour], layer.width || 1.5);
    });
  });
  Object.assign(pen, { globalAlpha: 1, lineWidth: 1 });
  pen.setLineDash([]);
}

let sheet = null; // where bands are drawn opaque, so that those of several runs do not add up

/** The area between two columns, in one shade also where runs overlap. */
export function drawBand(pen, plot, layer) {
  const { canvas } = pen, { opaque, alpha } = plot.colours.split(plot.colours[layer.colour]);
  sheet ||= new OffscreenCanvas(1, 1);
  if (sheet.width < canvas.width || sheet.height < canvas.height) Object.assign(sheet, { width: canvas.width, height: canvas.height });
  const shade = sheet.getContext("2d");
  shade.setTransform(1, 0, 0, 1, 0, 0);
  shade.clearRect(0, 0, canvas.width, canvas.height);
  shade.setTransform(pen.getTransform());
  shade.fillStyle = opaque;
  fillBetween(shade, plot, layer);
  pen.globalAlpha = alpha;
  pen.drawImage(sheet, 0, 0, canvas.width, canvas.height, 0, 0, plot.size.width, plot.size.height);
  pen.globalAlpha = 1;
}

function fillBetween(pen, plot, layer) {
  const { x, y } = plot.axes, low = plot.column(layer.low), high = plot.column(layer.high), xs = plot.xOf(layer);
  visibleParts(plot.view, low, (first, last) => finitePieces(low, first, last, (from, to) => {
    const step = Math.max(1, Math.floor((to - from) / (2 * plot.inner.w))); // a band is smooth
    pen.beginPath();
    for (let i = from; i < to; i += step) pen.lineTo(x.px(xs[i]), y.px(high[i]));
    pen.lineTo(x.px(xs[to - 1]), y.px(high[to - 1]));
    for (let i = to - 1; i >= from; i -= step) pen.lineTo(x.px(xs[i]), y.px(low[i]));
    pen.lineTo(x.px(xs[from]), y.px(low[from]));
    pen.fill();
  }));
}

/** A shaded span over the whole height; with a run, a bar at the bottom in the colour and the line of that run. */
export function drawSpan(pen, plot, layer) {
  const { y, h } = plot.inner, from = plot.axes.x.px(layer.from), width = Math.max(plot.axes.x.px(layer.to) - from, 2);
  const run = layer.run ? plot.view.runs.find((other) => other.name === layer.run) : null;
  if (run && !plot.view.shows(run)) return;
  if (run) {
    pen.fillStyle = plot.colours.ofRun(run.index);
    const line = plot.view.visibleRuns.indexOf(run);
    pen.fillRect(from, y + h - BAR_STEP * (line + 1), width, BAR);
    return;
  }
  pen.fillStyle = plot.colours[layer.colour];
  pen.globalAlpha = 0.14;
  pen.fillRect(from, y, width, h);
  pen.globalAlpha = 1;
}
