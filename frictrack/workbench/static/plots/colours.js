// Colours and fonts of the design tokens (tokens.css), read again when the theme changes.

const NAMES = [
  ...["raised", "ink", "muted", "line", "grid", "accent", "focus", "warn", "select", "cursor", "model", "background-model"],
  ...["candidate", "measured", "band", "free", "target", "reference", "ruler", "repair"],
];
const RUN_COLOURS = 8;
const UNKNOWN = "#808080"; // without a style sheet

let pen = null;

/** A CSS colour as one 32-bit number in the byte order of ImageData. */
export function packedColour(css) {
  pen ||= new OffscreenCanvas(1, 1).getContext("2d", { willReadFrequently: true });
  pen.clearRect(0, 0, 1, 1);
  pen.fillStyle = css;
  pen.fillRect(0, 0, 1, 1);
  return new Uint32Array(pen.getImageData(0, 0, 1, 1).data.buffer)[0];
}

/** The tokens as they hold for an element. */
export class Colours {
  constructor(el) {
    const style = getComputedStyle(el), read = (name) => style.getPropertyValue(`--ft-${name}`).trim();
    for (const name of NAMES) this[name] = read(name) || UNKNOWN;
    this.runs = Array.from({ length: RUN_COLOURS }, (_, k) => read(`run-${k}`) || UNKNOWN);
    this.small = `${read("small") || "12px"} ${read("font") || "system-ui, sans-serif"}`;
    this.packed = new Map();
  }

  ofRun(index) { return this.runs[(index || 0) % RUN_COLOURS]; }

  /** A colour without its transparency, and its opacity. */
  split(css) {
    const [r, g, b, a] = new Uint8Array(Uint32Array.of(this.packedOf(css)).buffer);
    return { opaque: `rgb(${r} ${g} ${b})`, alpha: a / 255 };
  }

  packedOf(css) {
    if (!this.packed.has(css)) this.packed.set(css, packedColour(css));
    return this.packed.get(css);
  }
}

/** Call a function when the theme changes, by the attribute of the page or by the system. */
export function watchTheme(listeners, call, root = document.documentElement) {
  const observer = new MutationObserver(call);
  observer.observe(root, { attributes: true, attributeFilter: ["data-theme"] });
  listeners.end(() => observer.disconnect());
  listeners.on(matchMedia("(prefers-color-scheme: dark)"), "change", call);
}
