// What the diagnosis says: in a few words in the bar, in full beside the plots.

import { html, useState } from "./hooks.js";
import { start } from "./actions.js";
import { Button, Note } from "./controls.js";
import { digits, spaced } from "./format.js";
import { Icon } from "./icons.js";
import { foreground, outdatedWords } from "./selectors.js";
import { useStore } from "./store.js";

const KIND = { complete: "good", missing: "bad", ambiguous: "warn", undetermined: "warn" };

/** Colour of a verdict. */
export const kindOf = (diagnosis) => KIND[diagnosis?.verdict] || "warn";

/** The verdict in a few words, with the error of the current model. */
function Brief() {
  const [diagnosis, checks, model, models, job, stale] = [
    useStore((s) => s.study?.diagnosis),
    useStore((s) => s.study?.check_first || []),
    useStore((s) => s.study?.model),
    useStore((s) => s.study?.models || []),
    useStore(foreground),
    useStore((s) => outdatedWords(s, "diagnosis", "model", "motion", "track")),
  ];
  if (!model) return null;
  const errors = models.find((one) => one.group === model.group)?.errors || {};
  return html`
    <div class=${`ui-brief ${checks.length ? "warn" : diagnosis && !stale ? kindOf(diagnosis) : ""} ${stale ? "stale" : ""}`}>
      ${checks.slice(0, 1).map((words) => html`<p class="ui-check-first" title=${checks.join("\n")}>${spaced(words)}</p>`)}
      <p class="ui-brief-title">${stale ? "Outdated: " : ""}${diagnosis?.title || (job ? "Not diagnosed yet" : "Not diagnosed")}</p>
      <p class="ui-brief-more"><span>${model.label}</span>
        ${errors.reduced_chi2 !== undefined && html`<span>reduced χ² <b>${digits(errors.reduced_chi2)}</b></span>`}</p>
    </div>`;
}

/** The verdict in full. */
function Full() {
  const [open, setOpen] = useState(false);
  const [diagnosis, model, job] = [useStore((s) => s.study?.diagnosis), useStore((s) => s.study?.model), useStore(foreground)];
  const checks = useStore((s) => s.study?.check_first || []).map((words) => html`<${Note} kind="warn">${spaced(words)}<//>`);
  if (!diagnosis) {
    const words = job ? `${job.words}: ${job.what}` : model ? "The current model is not diagnosed yet." : "No model is fitted yet. Press Run.";
    return html`
      <div class="ui-verdict" aria-live="polite">
        ${checks}
        <p class="ui-verdict-title">${job ? "Working ..." : "No verdict yet"}</p>
        <p class="ui-note">${words}</p>
        ${model && !job && html`<${Button} icon="search" kind="primary" label="Find what is missing" onClick=${() => start("diagnose", {}, "Find what is missing")} />`}
      </div>`;
  }
  const [first, ...others] = diagnosis.sentences || [], [chi2, ...repeats] = diagnosis.numbers || [];
  return html`
    <div class=${`ui-verdict ${checks.length ? "warn" : kindOf(diagnosis)}`} aria-live="polite">
      ${checks}
      <p class="ui-verdict-title">${diagnosis.title}</p>
      ${chi2 && html`<p class="ui-numbers">${spaced(chi2)}</p>`}
      ${(repeats.length ? repeats : [first]).filter(Boolean).map((words) => html`<p class="ui-note">${spaced(words)}</p>`)}
      ${open && (repeats.length ? [first, ...others] : others).map((words) => html`<p class="ui-note">${spaced(words)}</p>`)}
      ${others.length || repeats.length ? html`<button type="button" class="ui-link" aria-expanded=${String(open)} onClick=${() => setOpen(!open)}>${open ? "Less" : "More"}<${Icon} name="more" /></button>` : null}
      ${diagnosis.rests_on_repairs && html`<${Note} kind="warn">${diagnosis.rests_on_repairs}<//>`}
    </div>`;
}

export const Verdict = ({ brief }) => (brief ? html`<${Brief} />` : html`<${Full} />`);
