// A view that is opened again by a key has the focus where it was: a change of view removes what had it.

import { store } from "./store.js";

const WAIT_MS = 100, TRIES = 30; // plots come when their data have been read
const last = {}; // by tab: name of the control that had the focus

const nameOf = (node) => `${node.tagName} ${node.getAttribute("aria-label") || node.labels?.[0]?.textContent || node.textContent}`;

export const followFocus = () => addEventListener("focusin", ({ target }) => { if (target.closest("#view")) last[store.tab] = nameOf(target); });

export function returnFocus(tab, tries = TRIES) {
  if (document.activeElement !== document.body || store.tab !== tab || !last[tab]) return;
  const found = [...document.querySelectorAll("#view :is(button, input, select, a, [tabindex])")].find((node) => nameOf(node) === last[tab]);
  if (found) found.focus();
  else if (tries) setTimeout(returnFocus, WAIT_MS, tab, tries - 1);
}
