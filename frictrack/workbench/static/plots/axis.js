// Values of one axis on the pixels of one side of a plot.

const MINUS = "\u2212";

export class Axis {
  constructor(low, high) {
    this.low = low;
    this.high = high;
  }

  /** An axis over a range of values with room at both ends, as a share of the range. */
  static around([low, high], room) {
    if (!(low <= high)) return new Axis(0, 1);
    const pad = room * (high - low) || Math.abs(high) * 0.05 || 1;
    return new Axis(low - pad, high + pad);
  }

  get span() { return this.high - this.low; }

  /** Place the axis between two pixels. */
  on(from, to) {
    this.from = from;
    this.k = (to - from) / this.span;
    return this;
  }

  px(value) { return this.from + (value - this.low) * this.k; }

  at(px) { return this.low + (px - this.from) / this.k; }

  zoomed(px, factor) {
    const centre = this.at(px);
    return new Axis(centre + (this.low - centre) * factor, centre + (this.high - centre) * factor);
  }

  /** Whether another range differs so much that a zoom chosen for this one is useless. */
  changedMuch(other) {
    const ratio = other.span / this.span, shift = Math.abs(other.low + other.high - this.low - this.high) / 2;
    return !(ratio > 0.5 && ratio < 1.5 && shift < 0.5 * this.span);
  }
}

/** Round numbers between two values, about `count` of them and at least two. */
export function ticks(low, high, count) {
  const rough = (high - low) / Math.max(count, 1), power = 10 ** Math.floor(Math.log10(rough));
  const step = power * ([1, 2, 5].find((k) => k * power >= rough * 0.999) || 10), values = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) values.push(k * step);
  return values.length < 2 && high > low ? ticks(low, high, 1.5 * Math.max(count, 1)) : { step, values };
}

/** A tick as text, with as many digits as its step needs. */
export function tickText(value, step) {
  if (Math.abs(value) < step * 1e-9) return "0";
  const size = Math.max(Math.abs(value), step), digits = Math.floor(Math.log10(step) + 1e-9);
  const long = size >= 1e5 || step < 1e-7;
  const text = long ? value.toExponential(Math.max(0, Math.floor(Math.log10(size)) - digits)) : value.toFixed(Math.max(0, -digits));
  return text.replaceAll("-", MINUS);
}

/** A value as text with four significant digits. */
export function valueText(value, unit = "") {
  if (!Number.isFinite(value)) return "none";
  const size = Math.abs(value);
  const text = size && (size >= 1e5 || size < 1e-4) ? value.toExponential(2) : String(Number(value.toPrecision(4)));
  return `${text.replaceAll("-", MINUS)} ${unit}`.trim();
}
