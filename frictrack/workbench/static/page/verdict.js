// What the diagnosis says: in a few words in the bar, in full beside the plots.

import { html, useState } from "./hooks.js";
import { start } from "./actions.js";
import { Button, Note } from "./controls.js";
import { digits, spaced } from "./format.js";
import { Icon, Spinner } from "./icons.js";
import { foreground, outdatedWords, shownModel, STEPS_OF_RUN } from "./selectors.js";
import { useStore } from "./store.js";
import { Words } from "./words.js";

const KIND = { complete: "good", missing: "bad", ambiguous: "warn", undetermined: "warn" };

/** Colour of a verdict. */
export const kindOf = (diagnosis) => KIND[diagnosis?.verdict] || "warn";

/** What to check first; a sentence that stands in full below a box of the bar is not repeated beside it. */
const checksInBrief = (s) => (s.study?.check_first || []).map((words) => {
  const [box] = Object.entries(s.study.fields || {}).find(([, field]) => field.warning === words) || [];
  return box ? `Check first: see ${box === "fps" ? "frame rate" : box}.` : words;
});

/** The verdict in a few words, with the error of the current model. */
function Brief() {
  const [diagnosis, checks, model, job, stale] = [
    useStore((s) => s.study?.diagnosis),
    useStore(checksInBrief),
    useStore((s) => s.study?.models?.find((one) => one.current)),
    useStore((s) => s.study?.job && s.study.job.do !== "attempt"),
    useStore((s) => outdatedWords(s, "diagnosis", "model", "motion", "track")),
  ];
  if (!model) return null;
  const { errors } = model;
  return html`
    <div class=${`ui-brief ${checks.length ? "warn" : diagnosis && !stale ? kindOf(diagnosis) : ""} ${stale ? "stale" : ""}`}>
      ${checks.slice(0, 1).map((words) => html`<p class="ui-check-first">${spaced(words)}</p>`)}
      <p class="ui-brief-title">${stale ? "Outdated: " : ""}${diagnosis?.brief || (job ? "Not diagnosed yet" : "Not diagnosed")}</p>
      <p class="ui-brief-more"><span>${model.label}</span>
        ${errors.reduced_chi2 !== undefined && html`<span><${Words} text="reduced χ²" /> <b>${digits(errors.reduced_chi2)}</b></span>`}</p>
    </div>`;
}

/** What a run does until the verdict: what is done, what is under way with its question, and what waits. */
function Steps({ job }) {
  const at = STEPS_OF_RUN.indexOf(job.step);
  if (at < 0) return html`<p class="ui-note">${spaced(job.what || job.words)}</p>`;
  return html`
    <ol class="ui-steps-of-run">
      ${STEPS_OF_RUN.map(
        (step, k) => html`<li aria-current=${k === at ? "step" : null}>
          ${k < at ? html`<${Icon} name="good" />` : k === at ? html`<${Spinner} />` : html`<span class="ui-dot"></span>`}
          <span>${step}${k === at && k ? html`<span class="ui-note">${spaced(job.what)} ...</span>` : null}</span></li>`,
      )}
    </ol>`;
}

/** The verdict in full, of the model that is shown. */
function Full() {
  const [open, setOpen] = useState(false);
  const [model, job] = [useStore(shownModel), useStore((s) => foreground(s) || (s.study?.job?.do === "attempt" ? null : s.study?.job))];
  const checks = useStore((s) => s.study?.check_first || []).map((words) => html`<${Note} kind="warn">${spaced(words)}<//>`);
  const diagnosis = model?.diagnosis, busy = job?.state === "running" || job?.at ? job : null;
  if (!diagnosis) {
    const other = model && !model.current;
    return html`
      <div class="ui-verdict" aria-live="polite">
        ${checks}
        <p class="ui-verdict-title">${busy && !other ? "Estimating" : "No verdict yet"}</p>
        ${busy && !other ? html`<${Steps} job=${busy} />` : html`<p class="ui-note">${model ? `${model.label} is not diagnosed.` : "No model is fitted yet. Press Run."}</p>`}
        ${model && !busy && !other && html`<${Button} icon="search" kind="primary" label="Find what is missing" onClick=${() => start("diagnose", {}, "Find what is missing")} />`}
      </div>`;
  }
  const [first, ...others] = diagnosis.sentences || [], [chi2, ...repeats] = diagnosis.numbers || [];
  return html`
    <div class=${`ui-verdict ${checks.length ? "warn" : kindOf(diagnosis)}`} aria-live="polite">
      ${checks}
      <p class="ui-verdict-title">${diagnosis.title}</p>
      ${chi2 && html`<p class="ui-numbers"><span><${Words} text=${chi2} /></span></p>`}
      ${(repeats.length ? repeats : [first]).filter(Boolean).map((words) => html`<p class="ui-note"><${Words} text=${words} /></p>`)}
      ${open && (repeats.length ? [first, ...others] : others).map((words) => html`<p class="ui-note"><${Words} text=${words} /></p>`)}
      ${others.length || repeats.length ? html`<button type="button" class="ui-link" aria-expanded=${String(open)} onClick=${() => setOpen(!open)}>${open ? "Less" : "More"}<${Icon} name="more" /></button>` : null}
      ${diagnosis.rests_on_repairs && html`<${Note} kind="warn">${diagnosis.rests_on_repairs}<//>`}
    </div>`;
}

export const Verdict = ({ brief }) => (brief ? html`<${Brief} />` : html`<${Full} />`);
