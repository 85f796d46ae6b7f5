// The bar on every tab: mass, frame rate, scale and target, editable at any time; the verdict at its right.

import { html } from "./hooks.js";
import { edit, valueOf } from "./actions.js";
import { Button } from "./controls.js";
import { Field } from "./field.js";
import { Icon } from "./icons.js";
import { Verdict } from "./verdict.js";
import { selectedRun, store, update, useStore } from "./store.js";

const FIELDS = [
  { name: "mass", label: "Mass", placeholder: "0.350 kg", table: "study" },
  { name: "fps", label: "Frame rate", placeholder: "4000", table: "camera" },
  { name: "scale", label: "Scale", placeholder: "0.5 mm/px", table: "camera" },
];

/** Write a field into the study, or keep it until there is a study. */
function commit({ name, label, table }, text, run) {
  if (!store.study?.exists) {
    update({ draft: { ...store.draft, [name]: text } });
    return Promise.resolve(true);
  }
  const words = `${label}${run ? ` of ${run}` : ""}: ${text || "removed"}.`;
  return edit(run ? "run" : table, name, valueOf(text), run, words);
}

/** Draw with a tool on the film. */
const draw = (tool) => update({ tab: "film", tool: store.tool === tool ? "" : tool });

function Target() {
  const [target, n, tool] = [
    useStore((s) => selectedRun(s.study, s.run)?.shapes?.target),
    useStore((s) => s.study?.runs?.length || 0),
    useStore((s) => s.tool),
  ];
  return html`
    <div class="ui-field fixed" role="group" aria-label="Target">
      <div class="ui-field-head"><span>Target</span></div>
      <div class="ui-field-row">
        <span class="ui-value">${target ? "drawn" : "automatic"}</span>
        <${Button} small icon="target" label="Draw" kind=${tool === "target" ? "on" : ""} onClick=${() => draw("target")}
          aria-label="Draw the target" why=${n ? null : "Use a recording first."} title="Draw the target on the film (T)" />
      </div>
      <p class="ui-field-words"></p>
    </div>`;
}

/** Mass, frame rate and scale of single runs; an empty box stands for the value of the study. */
function PerRun() {
  const runs = useStore((s) => s.study?.runs || []);
  const own = (run, { name }) => run.fields?.[name]?.source === "run";
  const shown = (run, field) => (own(run, field) ? run.fields[field.name] : { ...run.fields?.[field.name], echo: null, text: "", needed: false });
  return html`
    <div class="ui-per-run" id="per-run">
      <div class="ui-per-run-head" aria-hidden="true"><span>Only this run</span>${FIELDS.map(({ label }) => html`<span>${label}</span>`)}</div>
      ${runs.map(
        (run, k) => html`
          <div class="ui-per-run-line" role="group" aria-label=${`Run ${run.name}`} key=${run.name}>
            <span class="ui-run-name"><span class="ui-dot" style=${{ background: `var(--ft-run-${k % 8})` }}></span>${run.name}</span>
            ${FIELDS.map(
              (field) => html`<${Field} ...${field} compact label=${`${field.label} of ${run.name}`} run=${run.name} field=${shown(run, field)}
                placeholder=${run.fields?.[field.name]?.echo || "as the study"} onCommit=${(text) => commit(field, text, run.name)} />`,
            )}
          </div>`,
      )}
    </div>`;
}

export function SetupBar() {
  const [fields, exists, draft] = [useStore((s) => s.study?.fields), useStore((s) => s.study?.exists), useStore((s) => s.draft)];
  const [several, tool] = [useStore((s) => (s.study?.runs?.length || 0) > 0), useStore((s) => s.tool)];
  const own = useStore((s) => (s.study?.runs || []).filter((run) => Object.values(run.fields || {}).some((f) => f.source === "run")).length);
  const open = useStore((s) => s.perRun);
  const shown = (name) => (exists === false || draft[name] ? { ...fields?.[name], text: draft[name], draft: draft[name] || null } : fields?.[name]);
  const ruler = html`<${Button} small icon="ruler" iconOnly label="Draw a ruler on the film (R)" kind=${tool === "ruler" ? "on" : ""}
    onClick=${() => draw("ruler")} why=${several ? null : "Use a recording first."} />`;
  return html`
    <section class="ui-setup" aria-label="Setup">
      <div class="ui-fields">
        ${FIELDS.map(
          (field) => html`<${Field} key=${field.name} ...${field} field=${shown(field.name)} onCommit=${(text) => commit(field, text)}
            action=${field.name === "scale" ? ruler : null} />`,
        )}
        <${Target} />
        ${several &&
        html`<button type="button" class="ui-more" aria-expanded=${String(open)} aria-controls="per-run" onClick=${() => update({ perRun: !open })}>
          <span>Per run</span>${own ? html`<span class="ui-count">${own}</span>` : null}<${Icon} name="more" />
        </button>`}
      </div>
      <${Verdict} brief />
      ${open && several && html`<${PerRun} />`}
    </section>`;
}
