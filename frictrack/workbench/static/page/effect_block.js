// One effect of the model: its equation, fitted parameters, and their settings in the study file.

import { html, useState } from "./hooks.js";
import { edit, removeEffect } from "./actions.js";
import { Button, Choice, TextBox } from "./controls.js";
import { Equation } from "./equation.js";
import { spaced } from "./format.js";
import { Icon } from "./icons.js";
import { say, store } from "./store.js";

const PER_RUN = [["", "default"], ["true", "each run"], ["false", "all runs"]];
const PRIOR = /^([-+.\deE]+)\s*(?:±|\+\/-)\s*([-+.\deE]+)/;

/** Values of one setting of all parameters of an effect in the study file. */
function settingsOf(effect, key) {
  const found = {};
  for (const parameter of store.study.model.effects.find((one) => one.name === effect)?.parameters || []) {
    const value = parameter.settings?.[key];
    if (value !== null && value !== undefined) found[parameter.name] = value;
  }
  return found;
}

/** Write one setting of a parameter; null removes it. */
function write(effect, parameter, key, value) {
  const { [parameter]: _, ...others } = settingsOf(effect, key);
  const next = value === null ? others : { ...others, [parameter]: value };
  edit("effect", key, Object.keys(next).length ? next : null, effect, `${effect}.${parameter}: ${key.replace("_", " ")} ${value === null ? "removed" : "set"}.`);
}

const number = (text, what) => {
  const value = Number(text);
  if (!Number.isFinite(value)) throw new Error(`Expected a number for ${what} but got "${text}".`);
  return value;
};

const READ = {
  fix: (text) => (text === "" ? null : text === "free" ? false : number(text, "the fixed value")),
  prior: (text) => {
    if (!text) return null;
    const found = PRIOR.exec(text);
    if (!found || !Number(found[2])) throw new Error(`Expected a prior as mean ± standard deviation, like "60 ± 2", but got "${text}".`);
    return [Number(found[1]), Number(found[2])];
  },
  tie: (text) => text || null,
  per_run: (text) => (text === "" ? null : text === "true"),
};

const tell = (task) => {
  try {
    task();
  } catch (error) {
    say(error.message, "bad");
  }
};

const typed = (value) => (value === null || value === undefined ? "" : value === false ? "free" : String(value));
const sure = ([mean, std]) => `${mean} ± ${std}`;

function Settings({ effect, parameter }) {
  const { name, unit, settings = {}, bounds } = parameter;
  const set = (key) => (text) => tell(() => write(effect, name, key, READ[key](text)));
  const own = [settings.low ?? null, settings.high ?? null];
  const bound = (k) => (text) =>
    tell(() => {
      const next = [...own];
      next[k] = text === "" ? null : number(text, "a bound");
      const full = next.map((value, i) => value ?? (next.some((v) => v !== null) ? bounds?.[i] : null));
      if (full.some((v) => v === null || v === undefined) && full.some((v) => v !== null && v !== undefined)) throw new Error(`Expected both bounds of ${name} but got one; the library has no bound on the other side.`);
      write(effect, name, "bounds", full[0] === null || full[0] === undefined ? null : full);
    });
  return html`
    <div class="ui-settings">
      <${TextBox} label=${`${name}: fixed at`} value=${typed(settings.fix)} unit=${unit} onCommit=${set("fix")} />
      <${TextBox} label=${`${name}: at least`} value=${typed(own[0])} placeholder=${typed(bounds?.[0])} unit=${unit} onCommit=${bound(0)} />
      <${TextBox} label=${`${name}: at most`} value=${typed(own[1])} placeholder=${typed(bounds?.[1])} unit=${unit} onCommit=${bound(1)} />
      <${TextBox} label=${`${name}: prior`} value=${settings.prior ? sure(settings.prior) : ""} placeholder="mean ± std" unit=${unit} onCommit=${set("prior")} />
      <${TextBox} label=${`${name}: tied to`} value=${typed(settings.tie)} placeholder="2*effect.name" onCommit=${set("tie")} />
      <${Choice} label=${`${name}: per run`} value=${settings.per_run === null || settings.per_run === undefined ? "" : String(settings.per_run)} options=${PER_RUN} onChange=${set("per_run")} />
    </div>`;
}

/** Settings of a parameter in a few words, for the closed block. */
function inWords({ settings = {} }) {
  const { fix, low, high, prior, tie, per_run: per } = settings;
  const parts = [
    fix !== null && fix !== undefined && (fix === false ? "free" : `fixed at ${fix}`),
    (low ?? null) !== null && `${low} to ${high}`,
    prior && `prior ${sure(prior)}`,
    tie && `tied to ${tie}`,
    per !== null && per !== undefined && (per ? "per run" : "for all runs"),
  ];
  return parts.filter(Boolean).join(", ");
}

function Parameter({ effect, parameter }) {
  const [open, setOpen] = useState(false);
  const values = Object.entries(parameter.values || {}), words = inWords(parameter);
  return html`
    <li class="ui-parameter">
      <div class="ui-parameter-line">
        <b class="ui-symbol"><${Equation} text=${parameter.name} /></b>
        <span class="ui-parameter-value">${values.length ? values.map(([run, text]) => html`<span>${run && html`<i>${run}</i> `}${spaced(text).split(/(?<=,) /).map((part) => html`<span>${part}</span> `)}</span>`) : "no value yet: fit again"}</span>
        <button type="button" class="ui-link" aria-expanded=${String(open)} aria-label=${`Settings of ${effect}.${parameter.name}`} onClick=${() => setOpen(!open)}>${words || "Settings"}<${Icon} name="more" /></button>
      </div>
      ${open && html`<${Settings} effect=${effect} parameter=${parameter} />`}
    </li>`;
}

export function EffectBlock({ effect, why }) {
  return html`
    <section class="ui-panel ui-effect" aria-label=${effect.name}>
      <div class="ui-panel-head">
        <h2>${effect.name}</h2>
        <${Button} small kind="quiet" icon="cancel" label="Remove" aria-label=${`Remove ${effect.name}`} why=${why} onClick=${() => removeEffect(effect.name)} />
      </div>
      <p class="ui-equation small"><${Equation} text=${effect.equation} /></p>
      <ul>${effect.parameters.map((one) => html`<${Parameter} key=${one.name} effect=${effect.name} parameter=${one} />`)}</ul>
    </section>`;
}
