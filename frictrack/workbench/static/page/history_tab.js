// All models that were fitted, all changes of the study, and files to download.

import { html, useState } from "./hooks.js";
import { change, download, start } from "./actions.js";
import { Button, Note, Panel, Segments } from "./controls.js";
import { ErrorStrip } from "./error_strip.js";
import { digits, moment, quantity, spaced } from "./format.js";
import { Icon } from "./icons.js";
import { foreground } from "./selectors.js";
import { useStore } from "./store.js";
import { Words } from "./words.js";

const FORMATS = ["svg", "png", "pdf"].map((name) => [name, name.toUpperCase()]);

function Models() {
  const [models, busy, tests] = [useStore((s) => s.study?.models || []), useStore((s) => s.busy), useStore((s) => s.study?.history.tests || [])];
  if (!models.length) return html`<${Panel} title="Models"><p class="ui-note">No model is fitted yet. Press Run.</p><//>`;
  return html`
    <${Panel} title="Models" className="ui-models">
      <div class="ui-scroll" tabindex="0" role="region" aria-label="Table of models">
        <table>
          <thead><tr><th scope="col">Model</th>${["Reduced χ²", "Misfit (rms)", "Held-out error"].map((head) => html`<th scope="col" class="n"><${Words} text=${head} /></th>`)}<th scope="col"><span class="ui-hidden">Use</span></th></tr></thead>
          <tbody>
            ${models.map(
              (one) => html`
                <tr key=${one.group} class=${one.current ? "current" : ""}>
                  <th scope="row">${one.label}${one.current ? " (current)" : ""}${one.outdated && html` <span class="ui-tag warn" title=${one.outdated}>outdated</span>`}</th>
                  <td class="n">${digits(one.errors?.reduced_chi2)}</td>
                  <td class="n">${quantity(one.errors?.rms, one.errors?.rms === null || one.errors?.rms === undefined ? "" : one.errors?.rms_unit)}</td>
                  <td class="n">${quantity(one.errors?.heldout, one.errors?.heldout === null || one.errors?.heldout === undefined ? "" : one.errors?.heldout_unit)}</td>
                  <td><${Button} small label="Use" aria-label=${`Use ${one.label}`} why=${one.current ? "This is the current model." : null} busy=${busy.has(`use.${one.group}`)}
                    onClick=${() => change("use", { model: one.group }, `${one.label} is the current model.`, `use.${one.group}`)} /></td>
                </tr>`,
            )}
          </tbody>
        </table>
      </div>
      ${tests.map((words) => html`<p class="ui-note">${spaced(words)}</p>`)}
    <//>`;
}

function Changes() {
  const entries = useStore((s) => s.study?.history.entries || []);
  return html`
    <${Panel} title="Changes" aside=${html`<span class="ui-aside">${entries.length}</span>`}>
      ${entries.length ? null : html`<p class="ui-note">Nothing has been changed yet.</p>`}
      <ol class="ui-changes" reversed>
        ${[...entries].reverse().map((one) => html`<li key=${one.n}><span class="n">${one.n}</span><span>${spaced(one.words)}</span><span class="ui-note">${one.author} ${moment(one.at)}</span></li>`)}
      </ol>
    <//>`;
}

function Get({ what, label, icon = "download", why, more }) {
  const busy = useStore((s) => s.busy.has(`download.${what}`));
  return html`<${Button} icon=${icon} label=${label} why=${why} busy=${busy} onClick=${() => download(what, more)} />`;
}

function Downloads() {
  const [report, model, job] = [useStore((s) => s.study?.report), useStore((s) => s.study?.model), useStore(foreground)];
  const [kind, setKind] = useState("svg");
  const none = model ? null : "There are no results yet. Press Run.";
  const busy = job ? "Wait until the work ends, or cancel it." : null;
  const missing = report?.exists ? null : "Write the report first.";
  return html`
    <${Panel} title="Report">
      ${report?.outdated && html`<${Note} kind="warn">${report.outdated}<//>`}
      <div class="ui-buttons">
        <${Button} icon="report" kind=${report?.exists && !report.outdated ? "" : "primary"} label=${report?.exists ? "Write the report again" : "Write the report"}
          why=${none || busy} onClick=${() => start("report", {}, "Write the report")} />
        <${Get} what="report.html" label="Report (HTML)" why=${missing} />
        <${Get} what="report.pdf" label="Report (PDF)" why=${missing} />
      </div>
    <//>
    <${Panel} title="Data and figures">
      <div class="ui-buttons">
        <${Get} what="tables.zip" label="Tables (CSV)" why=${none} />
        <${Get} what="hdf5.zip" label="Everything (HDF5)" why=${none} />
        <${Get} what="repeat.py" label="Python script" why=${none} />
      </div>
      <div class="ui-buttons">
        <${Segments} label="Figures as" value=${kind} options=${FORMATS} onChange=${setKind} />
        <${Get} what="figures.zip" label="Figures" why=${none} more=${{ format: kind }} />
      </div>
      <p class="ui-note"><${Icon} name="good" /><span>The script repeats every step of this study without the page.</span></p>
    <//>`;
}

export const HistoryTab = () => html`
  <div class="ui-history">
    <div class="ui-work"><${Models} /><${Changes} /></div>
    <aside class="ui-side" aria-label="Files"><${ErrorStrip} /><${Downloads} /></aside>
  </div>`;
