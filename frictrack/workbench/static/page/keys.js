// Keyboard shortcuts of the whole page. Keys that a text box, a list or a plot uses itself are left to it.

import { redo, runAll, undo } from "./actions.js";
import { selectedRun, store, update } from "./store.js";
import { TABS } from "./tabs.js";

const types = (node) => node?.matches?.('input:not([type="checkbox"]):not([type="range"]), textarea, select, [contenteditable]');

/** Select the run that is `by` places further. */
function stepRun(by) {
  const runs = store.study?.runs || [];
  const at = runs.findIndex((run) => run.name === selectedRun()?.name);
  if (runs.length) update({ run: runs[(at + by + runs.length) % runs.length].name, span: null });
}

const draw = (tool) => selectedRun() && update({ tab: "film", tool: store.tool === tool ? "" : tool });

const PLAIN = {
  "?": () => update({ dialog: { kind: "help" } }),
  "[": () => stepRun(-1),
  "]": () => stepRun(1),
  t: () => draw("target"),
  r: () => draw("ruler"),
  ...Object.fromEntries(TABS.map(({ name }, k) => [String(k + 1), () => update({ tab: name })])),
};

function onKey(event) {
  if (event.defaultPrevented || store.dialog) return;
  const command = event.ctrlKey || event.metaKey, key = event.key.toLowerCase();
  if (command && event.key === "Enter") return event.preventDefault(), document.activeElement?.blur(), runAll();
  if (types(event.target)) return undefined;
  if (command && key === "z") return event.preventDefault(), event.shiftKey ? redo() : undo();
  if (command && key === "y") return event.preventDefault(), redo();
  if (command || event.altKey) return undefined;
  if (event.key === "Escape" && store.tool) return update({ tool: "", drawn: null });
  if (PLAIN[event.key]) return event.preventDefault(), PLAIN[event.key]();
  return undefined;
}

export const listen = () => addEventListener("keydown", onKey);
