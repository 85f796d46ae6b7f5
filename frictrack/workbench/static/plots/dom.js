// Elements, and listeners, observers and timers that are removed together.

/** Make an element; a value of null leaves the attribute out. */
export function make(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) if (value !== null) node.setAttribute(key, value);
  node.append(...children);
  return node;
}

/** Everything that one part of the page listens to. */
export class Listeners {
  constructor() {
    this.abort = new AbortController();
    this.ends = [];
  }

  on(target, type, call, options = {}) {
    target.addEventListener(type, call, { ...options, signal: this.abort.signal });
  }

  /** Call a function when the size of an element changes. */
  resized(el, call) {
    const observer = new ResizeObserver(call);
    observer.observe(el);
    this.ends.push(() => observer.disconnect());
  }

  /** Call a function at the end. */
  end(call) {
    this.ends.push(call);
  }

  destroy() {
    this.abort.abort();
    for (const call of this.ends.splice(0)) call();
  }
}

/** Call a function once in the next animation frame, however often it is asked for. */
export class OncePerFrame {
  constructor(call) {
    this.call = call;
    this.pending = 0;
  }

  ask() {
    if (this.pending) return;
    this.pending = requestAnimationFrame(() => {
      this.pending = 0;
      this.call();
    });
  }

  cancel() {
    cancelAnimationFrame(this.pending);
    this.pending = 0;
  }
}

/** Place of a pointer in an element, CSS pixels. */
export function placeIn(el, event) {
  const box = el.getBoundingClientRect();
  return { x: event.clientX - box.left, y: event.clientY - box.top };
}
