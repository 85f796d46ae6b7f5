// Recordings, the film with what is drawn on it, the track with its quality, and the repair of lost frames.

import { html, useEffect, useState } from "./hooks.js";
import { address } from "./api.js";
import { change, edit, start, writeShape } from "./actions.js";
import { Button, Figure, Note, Panel, Segments } from "./controls.js";
import { count, spaced } from "./format.js";
import { Icon } from "./icons.js";
import { Linked } from "./linked.js";
import { HINTS } from "../plots/film_hints.js";
import { RepairPanel, useRepair } from "./repair_panel.js";
import { filmOf, foreground, outdatedWords } from "./selectors.js";
import { DropZone, FolderRecordings, StartView } from "./start_view.js";
import { selectedRun, update, useStore } from "./store.js";
import { Words } from "./words.js";

const TOOLS = [
  ["", "Look", "film"],
  ["target", "Target", "target"],
  ["polygon", "Outline", "polygon"],
  ["reference", "Reference", "reference"],
  ["ruler", "Ruler", "ruler"],
  ["exclude", "Exclude", "exclude"],
  ["obstacles", "Obstacle", "obstacle"],
  ["repair", "Repair", "repair"],
];

/** Runs of the study, each with what is known about it. */
function RunList() {
  const [runs, name] = [useStore((s) => s.study?.runs || []), useStore((s) => selectedRun(s.study, s.run)?.name)];
  return html`
    <${Panel} title="Recordings" className="ui-runlist">
      <ul>
        ${runs.map(
          (run, k) => html`
            <li key=${run.name}>
              <button type="button" aria-pressed=${String(run.name === name)} onClick=${() => update({ run: run.name, span: null, drawn: null })}>
                <span class="ui-dot" style=${{ background: `var(--ft-run-${k % 8})` }}></span>
                <span class="ui-run-title">${run.name}</span>
                <span class="ui-run-about">${[run.film ? count(run.film.frames, "frame") : run.kind, run.state].map((word) => html`<span>${word}</span> `)}</span>
                ${run.suspect?.length || run.warnings?.length ? html`<${Icon} name="warn" label="has something to look at" />` : null}
              </button>
              <${Button} iconOnly small kind="quiet" icon="remove" label=${`Leave ${run.name} out`} title=${`Leave ${run.name} out of the study; the film stays`}
                onClick=${() => change("leave_out", { run: run.name }, `${run.name} is left out. Undo takes it back.`, `leave.${run.name}`)} />
            </li>`,
        )}
      </ul>
      <${FolderRecordings} title="More in this folder" />
      <${DropZone} compact />
    <//>`;
}

/** Length of the line that was drawn; with it the line becomes the scale. */
function RulerLength({ shape }) {
  const [text, setText] = useState("");
  const use = (event) => {
    event.preventDefault();
    if (!text.trim()) return;
    edit("camera", "scale", { points: shape, length: text.trim() }, undefined, "Scale: the ruler that you drew.");
    update({ drawn: null });
  };
  return html`
    <form class="ui-ruler" onSubmit=${use}>
      <label for="ruler-length">This line is</label>
      <input id="ruler-length" autofocus placeholder="100 mm" value=${text} onInput=${(e) => setText(e.target.value)} />
      <button class="ui-button primary small" type="submit">Use as scale</button>
      <${Button} small kind="quiet" label="Drop it" onClick=${() => update({ drawn: null })} />
    </form>`;
}

function Tools({ run }) {
  const [tool, drawn] = [useStore((s) => s.tool), useStore((s) => s.drawn)];
  const shapes = run?.shapes || {};
  const remove = [
    ["target", "target"],
    ["reference", "reference"],
    ["exclude", "exclusions"],
    ["obstacles", "obstacles"],
  ].filter(([key]) => (Array.isArray(shapes[key]) ? shapes[key].length : shapes[key]));
  if (!run?.film) return null;
  return html`
    <div class="ui-tools">
      <${Segments} label="Draw on the film" value=${tool} options=${TOOLS} onChange=${(value) => update({ tool: value })} />
      ${drawn && html`<${RulerLength} shape=${drawn} />`}
      ${!drawn && html`<p class="ui-hint" aria-live="polite">${HINTS[tool]}</p>`}
      ${!drawn && remove.map(([key, words]) => html`<${Button} small kind="quiet" icon="cancel" label=${`Remove ${words}`} onClick=${() => edit("run", key, null, run.name, `${words} of ${run.name} removed.`)} />`)}
    </div>`;
}

/** What a film shows that is not tracked yet. */
function Untracked({ run }) {
  const job = useStore(foreground);
  return html`
    <div class="ui-nothing small">
      <p>${run.name} is not measured yet. Press Run when mass, frame rate and scale above are right; or see first how well it is tracked.</p>
      <${Button} icon="target" label="Track every film" onClick=${() => start("measure", { stage: "motion" }, "Track every film")}
        why=${job ? "Wait until the work ends, or cancel it." : null} />
    </div>`;
}

/** Checks of the time base, notes and warnings of the tracker, contact sheet. */
function Quality({ run }) {
  const stale = useStore((s) => outdatedWords(s, "track"));
  if (run.state === "new") return null;
  return html`
    <${Panel} title="Track quality" className=${stale ? "stale" : ""}>
      ${(run.warnings || []).map((words) => html`<${Note} kind="warn">${spaced(words)}<//>`)}
      <dl class="ui-checks">
        ${(run.checks || []).map(
          (one) => html`
            <div class=${one.ok === false ? "bad" : ""}>
              <dt><${Icon} name=${one.ok === false ? "warn" : "good"} /><span><${Words} text=${one.check} /></span></dt><dd class="value">${spaced(one.value)}</dd><dd><${Words} text=${one.verdict} /></dd>
            </div>`,
        )}
      </dl>
      ${(run.notes || []).map((words) => html`<p class="ui-note"><${Words} text=${words} /></p>`)}
    <//>`;
}

function Sheet({ run }) {
  const version = useStore((s) => s.study?.version);
  if (!run.has_sheet) return null;
  return html`
    <${Panel} title="Contact sheet">
      <${Figure} src=${address("/api/sheet", { run: run.name, v: version })} title=${`Contact sheet of ${run.name}`} alt=${`contact sheet of the tracked target in ${run.name}`} />
    <//>`;
}

/** Where a mass, frame rate or scale of this run differs, it is typed here too. */
function OwnValues({ run }) {
  const own = ["mass", "fps", "scale"].filter((key) => run.fields?.[key]?.source === "run");
  return own.length ? html`<p class="ui-note">Own values of ${run.name}: ${own.map((key) => `${key} ${spaced(run.fields[key].echo || run.fields[key].text)}`).join(", ")}.</p>` : null;
}

export function FilmTab() {
  const run = useStore((s) => selectedRun(s.study, s.run));
  const [tool, exists, span] = [useStore((s) => s.tool), useStore((s) => s.study?.exists), useStore((s) => s.span)];
  const [parts, setParts] = useState(null);
  const repair = useRepair(parts, run);
  useEffect(() => parts?.filmView.setTool(tool), [parts, tool]);
  if (!exists || !run) return html`<${StartView} />`;
  const on = {
    drawn: (drawn) => (drawn.tool === "repair" ? repair.drawn(drawn) : writeShape(drawn)),
    range: ({ from, to }) => update({ span: { from, to } }),
  };
  const film = filmOf(run), tracked = run.state === "measured";
  return html`
    <div class=${`ui-film-tab ${tracked || span ? "" : "plain"}`}>
      <${RunList} />
      <div class="ui-work">
        <${Linked} path=${tracked ? address("/api/plots", { view: "track", run: run.name }) : null} film=${film} on=${on} ready=${setParts} className="wide-film" adjust
          tools=${html`<${Tools} run=${run} />`}
          empty=${tracked ? null : html`<${Untracked} run=${run} />`} />
      </div>
      ${(tracked || span) && html`<aside class="ui-side" aria-label="Quality of the track">
        ${run.film && html`<${RepairPanel} run=${run} repair=${repair} />`}
        <${Quality} run=${run} />
        <${OwnValues} run=${run} />
        <${Sheet} run=${run} />
      </aside>`}
    </div>`;
}
