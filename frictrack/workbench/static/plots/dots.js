// Draw points as pixels: every one of them, because rare points matter most. 100 000 points take about a millisecond.

const OUTSIDE = -1;
let seen = new Uint8Array(0); // pixels that were painted already in this pass, shared by all plots

/** Pixel of every point: the corner of its square in an image of `width` x `height`, or -1 outside the image. */
export function cellsOf(xs, ys, axes, { left, top, width, height, ratio }, size, out = null) {
  const cells = out && out.length === xs.length ? out : new Int32Array(xs.length), half = size >> 1;
  const kx = axes.x.k * ratio, ky = axes.y.k * ratio;
  const x0 = (axes.x.from - axes.x.low * axes.x.k) * ratio - left - half + 0.5;
  const y0 = (axes.y.from - axes.y.low * axes.y.k) * ratio - top - half + 0.5;
  const right = width - size, bottom = height - size;
  for (let i = 0; i < cells.length; i++) {
    const u = Math.floor(xs[i] * kx + x0), v = Math.floor(ys[i] * ky + y0);
    cells[i] = u >= 0 && v >= 0 && u <= right && v <= bottom ? v * width + u : OUTSIDE; // NaN is outside
  }
  return cells;
}

/** Paint squares at cells of the rows [from, to); with `rows`, at those numbers of rows. A pixel is painted once. */
export function paint(pixels, width, cells, { from = 0, to = cells.length, rows = null, size, colour }) {
  if (seen.length < pixels.length) seen = new Uint8Array(pixels.length);
  seen.fill(0, 0, pixels.length);
  for (let k = from; k < to; k++) {
    const cell = cells[rows ? rows[k] : k];
    if (cell < 0 || seen[cell]) continue;
    seen[cell] = 1;
    for (let v = 0, at = cell; v < size; v++, at += width) for (let u = 0; u < size; u++) pixels[at + u] = colour;
  }
}
