// Motion of one run: velocity, acceleration and force, with the cut-off frequency and the free section.

import { html, useEffect, useState } from "./hooks.js";
import { address } from "./api.js";
import { edit, start } from "./actions.js";
import { Button, Choice, Figure, Note, Panel, RunPicker, TextBox } from "./controls.js";
import { digits, quantity, spaced, typed } from "./format.js";
import { Linked } from "./linked.js";
import { filmOf, foreground, outdatedWords } from "./selectors.js";
import { say, selectedRun, useStore } from "./store.js";

const PREVIEW_MS = 60; // after the last move of the slider

/** Index of the value that is nearest. */
const nearest = (values, to) => values.reduce((best, value, k) => (Math.abs(value - to) < Math.abs(values[best] - to) ? k : best), 0);

function Smoothing({ run, preview, onPreview }) {
  const { cutoff, smoothed_by: how, filters, filter } = run.motion;
  const why = useStore(foreground) ? "Wait until the work ends, or cancel it." : null;
  const hertz = cutoff?.options || [];
  const shown = preview ?? cutoff?.asked ?? cutoff?.chosen ?? hertz[0];
  const at = hertz.length ? nearest(hertz, shown) : 0;
  const takes = filters[filter.filter].takes;
  const set = (key, value, words) => (onPreview(null), edit("run", key, value, run.name, `Filter of ${run.name}: ${words}.`));
  const whole = (key) => (text) => {
    if (text && !/^\d+$/.test(text)) return say(`Expected a whole number but got "${text}".`, "warn");
    return set(key, text ? Number(text) : null, text ? `${key} ${text}` : `${key} chosen automatically`);
  };
  const cost = filter.filter === "structural" && cutoff?.noise && `In most frames: noise that passes ${quantity(cutoff.noise[at], cutoff.unit)}; signal lost ${quantity(cutoff.lost[at], cutoff.unit)}; ${cutoff.words}.`;
  const separate = () => set("cutoff", null, "cut-off removed");
  const use = () => set("cutoff", `${typed(hertz[at])} Hz`, `cut-off ${digits(hertz[at])} Hz`);
  return html`
    <${Panel} title="Smoothing">
      <p class="ui-note">${spaced(how)}</p>
      <${Choice} label="Filter" value=${filter.filter} options=${Object.entries(filters).map(([key, { words }]) => [key, words])}
        onChange=${(key) => set("filter", key, filters[key].words)} />
      ${takes.includes("order") && html`<${TextBox} label="Order" value=${String(filter.order ?? "")} placeholder="automatic" why=${why} onCommit=${whole("order")} />`}
      ${takes.includes("window") && html`<${TextBox} label="Window" value=${String(filter.window ?? "")} unit="frames" placeholder="automatic" why=${why} onCommit=${whole("window")} />`}
      ${takes.includes("causal") &&
      html`<${Choice} label="Direction" value=${String(Boolean(filter.causal))} options=${[["false", "forward and backward"], ["true", "forward only: delayed"]]}
        onChange=${(value) => set("causal", value === "true" || null, value === "true" ? "forward only" : "forward and backward")} />`}
      ${takes.includes("cutoff") && hertz.length > 1 &&
      html`
        <div class="ui-slider">
          <label for="cutoff">${filter.filter === "structural" ? "Cut-off of a plain low-pass" : "Cut-off"}</label><output for="cutoff">${digits(hertz[at])} Hz</output>
          <input id="cutoff" type="range" min="0" max=${hertz.length - 1} step="1" value=${at} aria-valuetext=${`${digits(hertz[at])} Hz`}
            onInput=${(e) => onPreview(hertz[e.target.value])} />
        </div>
        ${cost && html`<p class="ui-note">${spaced(cost)}</p>`}
        <div class="ui-row">
          <${Button} kind=${preview === null ? "" : "primary"} label="Use this cut-off" onClick=${use} why=${why} />
          <${Button} label=${filter.filter === "structural" ? "Separate automatically" : "Choose automatically"} icon="auto" onClick=${separate} why=${why || (cutoff.asked ? null : "No cut-off is given.")}
            title="Without a given cut-off" />
        </div>`}
    <//>`;
}

function Free({ run }) {
  const { free } = run.motion;
  const why = useStore(foreground) ? "Wait until the work ends, or cancel it." : null;
  const write = (from, to) => edit("run", "free", [`${typed(from)} ms`, `${typed(to)} ms`], run.name, `Free section of ${run.name}: set.`);
  const set = (end) => (text) => {
    const value = Number.parseFloat(text.replace("ms", ""));
    if (Number.isNaN(value)) return say(`Expected a time such as "12.5 ms" but got "${text}".`, "warn");
    return end === "from" ? write(value, free.to_ms) : write(free.from_ms, value);
  };
  return html`
    <${Panel} title="Free section">
      <p class="ui-note">${free ? "Only friction acts here. Drag the ends in a plot or type them." : "No force without a mass."}</p>
      ${free?.reason && html`<p class="ui-note">Chosen: ${spaced(free.reason)}.</p>`}
      ${free &&
      html`
        <div class="ui-row">
          <${TextBox} label="From" value=${typed(free.from_ms)} unit="ms" onCommit=${set("from")} />
          <${TextBox} label="to" value=${typed(free.to_ms)} unit="ms" onCommit=${set("to")} />
        </div>
        <${Button} icon="auto" label="Detect" why=${why} onClick=${() => edit("run", "free", null, run.name, `Free section of ${run.name}: detected again.`)} />`}
    <//>`;
}

/** Cut-off that is previewed; moving the slider quickly asks only for the last one. */
function usePreview(run) {
  const [wanted, setWanted] = useState(null), [drawn, setDrawn] = useState(null);
  useEffect(() => {
    const timer = setTimeout(() => setDrawn(wanted), PREVIEW_MS);
    return () => clearTimeout(timer);
  }, [wanted]);
  useEffect(() => (setWanted(null), setDrawn(null)), [run?.name]);
  return [wanted, drawn, setWanted];
}

export function MotionTab() {
  const run = useStore((s) => selectedRun(s.study, s.run)), film = filmOf(run);
  const [stale, job] = [useStore((s) => outdatedWords(s, "track", "motion")), useStore(foreground)];
  const version = useStore((s) => s.study?.version);
  const [preview, drawn, setPreview] = usePreview(run);
  if (!run?.motion) {
    return html`
      <div class="ui-nothing">
        <h2>${run ? `${run.name} is not measured yet` : "No recording yet"}</h2>
        <p>Velocity, acceleration and force of each run appear here.</p>
        <${RunPicker} />
        ${run && html`<${Button} kind="primary" icon="run" label="Measure" onClick=${() => start("measure", { stage: "friction" }, "Measure")}
          why=${job ? "Wait until the work ends, or cancel it." : null} />`}
      </div>`;
  }
  const asked = run.motion.cutoff?.asked;
  const path = address("/api/plots", { view: "motion", run: run.name, cutoff: drawn ?? (stale ? asked : null) });
  const moved = ({ handle, span }) =>
    handle !== "range" &&
    edit("run", "free", span.map((v) => `${Number(v.toPrecision(4))} ms`), run.name, `Free section of ${run.name}: set.`);
  return html`
    <div class="ui-motion">
      <div class=${`ui-work ${stale ? "stale" : ""}`}>
        <${RunPicker} />
        <${Linked} path=${path} film=${film} large="Friction force" on=${{ moved }} />
      </div>
      <aside class="ui-side" aria-label="Settings of the motion">
        <${Smoothing} run=${run} preview=${preview} onPreview=${setPreview} />
        <${Free} run=${run} />
        ${stale && html`<${Note} kind="warn">${stale}<//>`}
        <${Button} icon="run" label="Measure again" onClick=${() => start("measure", { stage: "friction" }, "Measure again")}
          why=${job ? "Wait until the work ends, or cancel it." : stale ? null : "Nothing has changed since the last measurement."} />
        ${run.motion.cutoff && html`<${Panel} title="Noise and lost signal"><${Figure} title=${`Noise and lost signal, ${run.name}`}
          alt=${`Noise that passes and signal lost over the cut-off frequency, ${run.name}`} src=${address("/api/figure", { name: `cutoff:${run.name}`, v: version })} /><//>`}
        <${Panel} title="What a filter costs"><${Figure} title=${`What a filter costs, ${run.name}`}
          alt=${`Displacement, velocity, acceleration and force as measured, filtered and smoothed, ${run.name}`}
          src=${address("/api/figure", { name: `filters:${run.name}`, v: version })} /><//>
      </aside>
    </div>`;
}
