// The loop on one screen: film and linked plots, the verdict, candidates to try and add, and how the error has fallen.

import { html, useState } from "./hooks.js";
import { address } from "./api.js";
import { change, runAll } from "./actions.js";
import { useCandidateCurve } from "./candidate_curve.js";
import { Candidates, Formulas } from "./candidates.js";
import { Button, Choice, Figure, Note, Panel } from "./controls.js";
import { ErrorStrip } from "./error_strip.js";
import { spaced } from "./format.js";
import { Spinner } from "./icons.js";
import { Linked } from "./linked.js";
import { NextExperiments } from "./next_experiment.js";
import { backgroundModel, filmOf, foreground, outdatedWords, shownModel, stateOf, STEPS_OF_RUN } from "./selectors.js";
import { selectedRun, update, useStore } from "./store.js";
import { Verdict } from "./verdict.js";

/** The plot in which the model fails most: where the misfit repeats, else over time. */
const plotOfMisfit = (diagnosis) => diagnosis?.plot || "Residual against time";

/** The model that is shown, if it is not the current one. */
const otherModel = (s) => (shownModel(s)?.current === false ? shownModel(s) : null);

function Models() {
  const [models, shown, background] = [useStore((s) => s.study?.models || []), useStore((s) => shownModel(s)?.group || ""), useStore(backgroundModel)];
  if (models.length < 2) return null;
  const options = models.map((one) => [one.group, one.label]);
  return html`
    <div class="ui-models-choice">
      <${Choice} label="Model" value=${shown} options=${options} onChange=${(group) => update({ shown: models.find((one) => one.current)?.group === group ? "" : group, tried: "" })} />
      <${Choice} label="Behind it" value=${background} options=${[["", "none"], ...options.filter(([group]) => group !== shown)]}
        onChange=${(group) => update({ background: group })} />
    </div>`;
}

const STEPS = { new: "waits", tracked: "tracked", measured: "measured" };

/** What the work has reached so far: each run, and the step that is under way. */
function Progress({ job }) {
  const runs = useStore((s) => (s.study?.runs || []).map((run) => [run.name, stateOf(s, run)]));
  return html`
    <div class="ui-nothing" role="status">
      <h2><${Spinner} /> ${job.step || job.words}</h2>
      ${job.step === STEPS_OF_RUN[0] && html`<p>${spaced(job.what)}</p>`}
      <ul class="ui-reached">
        ${runs.map(([name, state], k) => html`<li class=${state}><span class="ui-dot" style=${{ background: `var(--ft-run-${k % 8})` }}></span>${name}<span class="ui-note">${STEPS[state]}</span></li>`)}
      </ul>
    </div>`;
}

function Nothing() {
  const [job, ready] = [useStore(foreground), useStore((s) => s.study?.ready)];
  if (job) return html`<${Progress} job=${job} />`;
  return html`
    <div class="ui-nothing">
      <h2>No model is fitted yet</h2>
      <p>Run tracks every film, computes the force, fits the model and says which effect is missing.</p>
      <${Button} kind="primary" icon="run" label="Run" onClick=${runAll} />
      ${ready && !ready.can_run && html`<${Note} kind="warn">${ready.words}<//>`}
    </div>`;
}

/** Friction force and coefficient over the speed, of the model that is shown. */
function Law() {
  const [model, version] = [useStore(shownModel), useStore((s) => s.study?.version)];
  return model?.has_law ? html`
    <${Panel} title="Friction law"><${Figure} title=${`Friction law of ${model.label}`}
      alt="Friction force and coefficient over the speed, with its band, over the measured force"
      src=${address("/api/figure", { name: `law:${model.group}`, v: version })} /><//>` : null;
}

export function CompareTab() {
  const [parts, setParts] = useState(null);
  const film = useStore((s) => filmOf(selectedRun(s.study, s.run))), films = useStore((s) => (s.study?.runs || []).map(filmOf).filter(Boolean));
  const [fitted, large, shown, background] = [
    useStore((s) => Boolean(s.study?.model)),
    useStore((s) => plotOfMisfit(shownModel(s)?.diagnosis)),
    useStore((s) => otherModel(s)?.group || ""),
    useStore(backgroundModel),
  ];
  const stale = useStore((s) => outdatedWords(s, "model", "motion", "track"));
  const candidate = useCandidateCurve(parts, large), other = useStore(otherModel), current = useStore((s) => s.study?.model?.label);
  const path = fitted ? address("/api/plots", { view: "compare", model: shown, background }) : null;
  return html`
    <div class=${`ui-compare ${fitted ? "" : "unfitted"}`}>
      <div class=${`ui-work ${stale ? "stale" : ""}`}>
        <${Linked} path=${path} film=${film} films=${films} large=${large} ready=${setParts} empty=${fitted ? null : html`<${Nothing} />`} />
      </div>
      <aside class="ui-side" aria-label="Verdict and candidates">
        <${Models} />
        <${Verdict} />
        <${Law} />
        <${ErrorStrip} />
        ${other
          ? html`<${Note}>${`Candidates are tried with the current model, ${current}.`}<//>
              <${Button} label=${`Use ${other.label}`} onClick=${() => change("use", { model: other.group }, `${other.label} is the current model.`)} />`
          : html`<${Candidates} curve=${candidate} /><${Formulas} /><${NextExperiments} />`}
      </aside>
    </div>`;
}
