// Legend: a button for every run and every curve. A click hides, a double click (or shift and click) shows it alone.

import { Listeners, make } from "./dom.js";

const HELP = "Click hides or shows; double click, or shift and Enter, shows it alone.";

const CANDIDATE = { name: "candidate", label: "candidate", kind: "dots", colour: "candidate", about: "The model with the candidate that is tried" };

/** Runs and named curves of a scene, each once: {key, name, label, kind, colour}. */
function entriesOf(view) {
  const layers = new Map();
  for (const layer of view.scene.plots.flatMap((plot) => plot.layers)) {
    if (layer.name && layer.label && !layers.has(layer.name)) layers.set(layer.name, layer);
  }
  const takesCandidate = view.scene.plots.some((plot) => plot.layers.some((layer) => layer.candidate));
  if (takesCandidate) layers.set("candidate", CANDIDATE); // always there, so that nothing moves when one is tried
  const runs = view.runs.length > 1 ? view.runs.map((run) => ({ key: `run ${run.name}`, name: run.name, label: run.name, run })) : [];
  const curves = [...layers.values()].map((layer) => ({ key: `curve ${layer.name}`, name: layer.name, label: layer.label, layer }));
  return { runs, curves };
}

function colourOf({ run, layer }) {
  if (run) return `var(--ft-run-${(run.index || 0) % 8})`;
  return layer.by_run ? "linear-gradient(90deg, var(--ft-run-0), var(--ft-run-1), var(--ft-run-2))" : `var(--ft-${layer.colour})`;
}

export class Legend {
  constructor(el, view) {
    Object.assign(this, { el, view, listeners: new Listeners(), buttons: new Map() });
    this.root = make("div", { class: "fp-legend", role: "group", "aria-label": "Legend" });
    el.append(this.root);
    this.listeners.end(view.on("scene", () => this.build()));
    for (const name of ["hidden", "candidate"]) this.listeners.end(view.on(name, () => this.mark()));
    this.listeners.on(this.root, "click", (e) => this.click(e));
    this.listeners.on(this.root, "dblclick", (e) => this.isolate(this.entryOf(e)));
    this.listeners.on(this.root, "keydown", (e) => { if (e.key === "Enter" && e.shiftKey) { e.preventDefault(); this.isolate(this.entryOf(e)); } });
    this.build();
  }

  destroy() {
    this.listeners.destroy();
    this.root.remove();
  }

  /** Buttons of entries that stay are kept, and so is the focus. */
  build() {
    const { runs, curves } = entriesOf(this.view), old = this.buttons;
    this.buttons = new Map();
    const row = (name, entries) => {
      const buttons = entries.map((entry) => {
        const button = old.get(entry.key)?.button || make("button", { type: "button", class: "fp-entry" });
        const sample = make("span", { class: `fp-sample fp-${entry.layer?.kind || "run"}`, "aria-hidden": "true" });
        sample.style.setProperty("--fp-colour", colourOf(entry));
        button.replaceChildren(sample, entry.label);
        button.title = [entry.layer?.about, HELP].filter(Boolean).join(". ");
        this.buttons.set(entry.key, { ...entry, button });
        return button;
      });
      return make("div", { class: "fp-entries", role: "group", "aria-label": name }, ...buttons);
    };
    this.root.hidden = runs.length + curves.length < 2;
    const focused = document.activeElement;
    const rows = [["Runs", runs], ["Curves", curves]].filter(([, entries]) => entries.length);
    this.root.replaceChildren(...rows.map(([name, entries]) => row(name, entries)));
    if (focused !== document.activeElement && this.root.contains(focused)) focused.focus();
    this.mark();
  }

  mark() {
    for (const { button, run, name } of this.buttons.values()) {
      const hidden = run ? this.view.hiddenRuns.has(name) : this.view.hiddenLayers.has(name);
      button.setAttribute("aria-pressed", String(!hidden));
      if (name === CANDIDATE.name && !run) button.setAttribute("aria-label", this.candidateWords);
    }
  }

  /** The visible label does not change, so that nothing moves. */
  get candidateWords() {
    const { candidate } = this.view;
    return candidate?.name ? `${CANDIDATE.label}, with ${candidate.name}` : CANDIDATE.label;
  }

  entryOf(e) {
    const button = e.target.closest("button");
    return [...this.buttons.values()].find((entry) => entry.button === button) || null;
  }

  click(e) {
    const entry = this.entryOf(e);
    if (!entry) return;
    if (e.shiftKey) this.isolate(entry);
    else if (entry.run) this.view.hide(entry.name);
    else this.view.hideLayer(entry.name);
  }

  /** The two clicks before a double click have hidden and shown the entry: nothing is left of them. */
  isolate(entry) {
    if (!entry) return;
    if (entry.run) return this.view.isolate(entry.name);
    this.view.isolateLayer(entry.name, [...this.buttons.values()].filter((one) => one.layer).map((one) => one.name));
  }
}
