// The current model: its equation, its effects with parameters and settings, more effects, and how it is fitted.

import { html, useEffect, useState } from "./hooks.js";
import { address, getJSON } from "./api.js";
import { addEffect, edit, start, valueOf } from "./actions.js";
import { Button, Choice, Figure, Panel, TextBox } from "./controls.js";
import { Convergence } from "./convergence.js";
import { EffectBlock } from "./effect_block.js";
import { spaced } from "./format.js";
import { Equation } from "./equation.js";
import { foreground, outdatedWords } from "./selectors.js";
import { say, useStore } from "./store.js";
import { Words } from "./words.js";

/** Effects that can be added and searches with their settings, read once per state of the study. */
function useCatalogue() {
  const [found, setFound] = useState({ effects: [], searches: { known: {} } }), revision = useStore((s) => s.study?.revision);
  useEffect(() => {
    getJSON("/api/effects").then(setFound, () => {});
  }, [revision]);
  return found;
}

function AddEffect({ catalogue, taken, why }) {
  const [text, setText] = useState(""), [name, setName] = useState("");
  const fits = (one) => `${one.name} ${one.what} ${one.looks_like}`.toLowerCase().includes(text.toLowerCase());
  const options = catalogue.filter((one) => !taken.includes(one.name) && fits(one));
  const chosen = options.find((one) => one.name === name) || options[0];
  return html`
    <${Panel} title="Add an effect">
      <div class="ui-box wide"><label for="effect-search">Search by name or by what it looks like</label>
        <input id="effect-search" type="search" value=${text} placeholder="bends upward at the fast end" onInput=${(e) => setText(e.target.value)} /></div>
      ${options.length
        ? html`
            <${Choice} label=${`Effect (${options.length})`} value=${chosen.name} options=${options.map((one) => [one.name, one.name])} onChange=${setName} />
            <p class="ui-equation small"><${Equation} text=${chosen.equation} /></p>
            <p class="ui-note">${spaced(chosen.looks_like ? `Looks like ${chosen.looks_like}.` : chosen.what)}</p>
            <${Button} icon="add" label=${`Add ${chosen.name}`} why=${why} onClick=${() => addEffect(chosen.name)} />`
        : html`<p class="ui-note">No effect matches "${text}".</p>`}
    <//>`;
}

/** "temperature = 20 degC, oil = none" as an object; numbers and true or false are read as such. */
function conditionsOf(text) {
  const pairs = text.split(/[,;\n]/).filter((one) => one.trim()).map((one) => one.split("=").map((part) => part.trim()));
  const bad = pairs.find((pair) => pair.length !== 2 || !pair[0] || !pair[1]);
  if (bad) throw new Error(`Expected conditions like "temperature = 20 degC, oil = none" but got "${bad.join(" = ")}".`);
  return Object.fromEntries(pairs.map(([key, value]) => [key, { true: true, false: false }[value] ?? valueOf(value)]));
}

/** Write keys of the study file that hold for the whole study. */
function StudyKeys() {
  const keys = useStore((s) => s.study?.keys);
  if (!keys) return null;
  const set = (key, read) => (text) => {
    try {
      edit("study", key, text ? read(text) : null, undefined, `${key} ${text ? "set" : "removed"}.`);
    } catch (error) {
      say(error.message, "bad");
    }
  };
  return html`
    <${Panel} title="Known before">
      <${TextBox} wide label="Prior: file of another set-up" value=${keys.prior} placeholder="other_set_up.prior.toml" onCommit=${set("prior", (text) => text)} />
      <${TextBox} wide label="Conditions, compared by frictrack batch" value=${keys.conditions} placeholder="temperature = 20 degC" onCommit=${set("conditions", conditionsOf)} />
      <${TextBox} wide label="Functions of z for an unexplained force" value=${keys.functions} placeholder="z^2*exp(-z); tanh(z)" onCommit=${set("functions", (text) => text.split(";").map((one) => one.trim()).filter(Boolean))} />
    <//>`;
}

/** Name of a setting; the papers' symbols of one letter stay as they are. */
const words = (key) => (key.length > 1 ? key[0].toUpperCase() + key.slice(1).replaceAll("_", " ") : key);

function Fit({ searches, why }) {
  const [asked, setSearch] = useState(null), [all, setOver] = useState(null);
  const search = asked || searches.search || "varpro", over = all || searches.over || "all", known = searches.known[search] || {};
  const [seed, setSeed] = useState("0"), [model, setModel] = useState(""), [more, setMore] = useState({});
  const [group, searched, version] = [useStore((s) => s.study?.model?.group), useStore((s) => s.study?.model?.has_search), useStore((s) => s.study?.version)];
  const job = useStore(foreground);
  const box = ([key, { default: usual, choices }]) => {
    const set = (text) => setMore({ ...more, [key]: text });
    const options = choices || (typeof usual === "boolean" ? ["true", "false"] : null), now = more[key] || (options ? String(usual) : "");
    if (options) return html`<${Choice} key=${search + key} label=${words(key)} value=${now} options=${options.map((one) => [one, one])} onChange=${set} />`;
    return html`<${TextBox} key=${search + key} label=${words(key)} value=${now} placeholder=${usual ?? "automatic"} onCommit=${set} />`;
  };
  const fit = () => {
    const settings = Object.fromEntries(Object.entries(more).filter(([key, text]) => text && key in known));
    start("fit", { model: model || null, search, over: search === "varpro" ? "all" : over, seed: Number.parseInt(seed, 10) || 0, ...(Object.keys(settings).length ? { settings } : {}) }, `Fit ${model || "the model"}`);
  };
  return html`
    <${Panel} title="Fit">
      <${TextBox} wide label="Another model" value=${model} placeholder="tustin, or coulomb, viscous" onCommit=${setModel} />
      <div class="ui-row">
        <${Choice} label="Search" value=${search} options=${Object.keys(searches.known).map((name) => [name, name])} onChange=${setSearch} />
        <${Choice} label="Parameters" value=${over} options=${[["all", "all"], ["nonlinear", "nonlinear"]]} onChange=${setOver} />
        <${TextBox} label="Seed" value=${seed} onCommit=${setSeed} />
      </div>
      <div class="ui-row">${Object.entries(known).filter(([key]) => key !== "seed").map(box)}</div>
      <${Button} icon="run" kind="primary" label="Fit" why=${why} onClick=${fit} />
      ${job || !searched ? html`<${Convergence} />` : html`<${Figure} title=${`Search of ${group}`} alt="Lowest misfit, diversity and best parameters over the generations of the search"
        src=${address("/api/figure", { name: `search:${group}`, v: version })} />`}
    <//>`;
}

export function ModelTab() {
  const [model, job, ready] = [useStore((s) => s.study?.model), useStore(foreground), useStore((s) => s.study?.ready)];
  const stale = useStore((s) => outdatedWords(s, "model"));
  const catalogue = useCatalogue();
  const why = job ? "Wait until the work ends, or cancel it." : ready?.can_run === false ? ready.words : null;
  return html`
    <div class="ui-model">
      <div class=${`ui-work ${stale ? "stale" : ""}`}>
        ${model
          ? html`
              <section class="ui-panel ui-law" aria-label="Law">
                <p class="ui-equation"><${Equation} text=${model.equation} /></p>
                <p class="ui-note">${model.symbols}.</p>
                ${(model.remarks || []).map((words) => html`<p class="ui-note"><${Words} text=${words} /></p>`)}
              </section>
              <div class="ui-effects">${model.effects.map((one) => html`<${EffectBlock} key=${one.name} effect=${one} why=${why} />`)}</div>`
          : html`<div class="ui-nothing"><h2>No model is fitted yet</h2><p>Fit the model of the study file, or type another one at the right.</p></div>`}
      </div>
      <aside class="ui-side" aria-label="Effects and fit">
        <${AddEffect} catalogue=${catalogue.effects} taken=${model?.effects.map((one) => one.name) || []} why=${model ? why : "Fit a model first."} />
        <${Fit} searches=${catalogue.searches} why=${why} />
        <${StudyKeys} />
      </aside>
    </div>`;
}
