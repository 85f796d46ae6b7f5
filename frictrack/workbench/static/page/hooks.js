// Preact with the few hooks that the page adds to it.

import { html, useState } from "../vendor/preact-htm.js";

export * from "../vendor/preact-htm.js";
export { html };

let made = 0;

/** An id that is unique on the page. */
export function useId(prefix) {
  const [id] = useState(() => `${prefix}-${(made += 1)}`);
  return id;
}
