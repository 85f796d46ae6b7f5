// What the page knows: `study` is the state of the files as the server tells it; all else is the view of this tab.

import { useEffect, useState } from "../vendor/preact-htm.js";

const TAB_KEY = "frictrack.tab";

export const store = {
  study: null, // State of the server; null until it has answered once
  tab: sessionStorage.getItem(TAB_KEY) || "film",
  run: "", // selected run
  online: null, // null: not connected yet
  refused: "", // why the server does not let this page in
  notice: null, // last message {words, kind: "done" | "warn" | "bad"}
  busy: new Set(), // keys of requests under way
  starting: null, // job that is asked for but not yet confirmed {do, words}
  draft: { mass: "", fps: "", scale: "" }, // typed before there is a study
  tried: "", // candidate whose curve is drawn
  background: "", // group of the model that is drawn in the background
  shown: "", // group of the model that is compared; "" is the current one
  tool: "", // drawing tool on the film
  drawn: null, // ruler that waits for its length
  span: null, // frames chosen for repair {from, to}
  perRun: false, // values of single runs are open
  dialog: null, // open dialog {kind, ...}
};

const listeners = new Set();

/** Change some parts of the store and draw again what depends on them. */
export function update(parts) {
  Object.assign(store, parts);
  if (parts.tab) sessionStorage.setItem(TAB_KEY, parts.tab);
  for (const call of [...listeners]) call();
}

/** Draw this component again whenever what `select` returns has changed. */
export function useStore(select) {
  const [value, setValue] = useState(() => select(store));
  useEffect(() => {
    const look = () => setValue(() => select(store));
    listeners.add(look);
    look();
    return () => listeners.delete(look);
  }, []);
  return value;
}

/** Call `look` after every change; the answer removes it again. */
export function watch(look) {
  listeners.add(look);
  return () => listeners.delete(look);
}

export const study = () => store.study;

/** The selected run of the study, else its first one. */
export function selectedRun(state = store.study, name = store.run) {
  const runs = state?.runs || [];
  return runs.find((run) => run.name === name) || runs[0] || null;
}

/** Say something in the status bar. */
export function say(words, kind = "done") {
  update({ notice: words ? { words, kind, at: Date.now() } : null });
}

/** Mark a request as under way, or as ended. */
export function mark(key, on) {
  const busy = new Set(store.busy);
  if (on) busy.add(key);
  else busy.delete(key);
  update({ busy });
}
