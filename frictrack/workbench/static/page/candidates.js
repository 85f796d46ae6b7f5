// Effects that may be missing. Hovering or focusing one draws its curve and prints the error now and with it; Add fits it.

import { html, useState } from "./hooks.js";
import { address } from "./api.js";
import { addEffect, change } from "./actions.js";
import { Button, Figure, Panel } from "./controls.js";
import { digits, quantity, spaced } from "./format.js";
import { Icon, Spinner } from "./icons.js";
import { foreground, outdatedWords } from "./selectors.js";
import { store, update, useStore } from "./store.js";
import { Words } from "./words.js";

const HOVER_MS = 90; // the pointer rests on a candidate, it does not only pass
const MAX_WEAK = 3; // candidates shown that explain less or are not significant

let timer = null;

/** A name that may be broken after its underscores. */
const breakable = (name) => name.split(/(?<=_)/).map((part) => html`${part}<wbr />`);

/** Draw the curve of a candidate soon; "" takes it away. */
function trySoon(name, wait = HOVER_MS) {
  clearTimeout(timer);
  timer = setTimeout(() => store.tried !== name && update({ tried: name }), wait);
}

/** Error now and with the candidate, as two bars and two numbers. */
function Errors({ curve, errors, words }) {
  if (curve?.pending) return html`<p class="ui-errors pending"><${Spinner} /><span>fitting ...</span></p>`;
  if (curve?.error) return html`<p class="ui-errors">${curve.error}</p>`;
  const found = curve?.errors || errors;
  if (!found) return words ? html`<p class="ui-candidate-what"><${Words} text=${`Held-out error ${words}`} /></p>` : null;
  const share = found.now ? Math.min(Math.abs(found.with / found.now), 1) : 1;
  return html`
    <div class="ui-errors" aria-label=${found.words || `error now ${digits(found.now)}, with it ${digits(found.with)} ${found.unit || ""}`}>
      <div class="ui-errors-bars" aria-hidden="true"><i style=${{ width: "100%" }}></i><i class="with" style=${{ width: `${Math.max(100 * share, 1)}%` }}></i></div>
      <p><span>now <b>${quantity(found.now, found.unit)}</b></span><span class="with">with it <b>${quantity(found.with, found.unit)}</b></span></p>
    </div>`;
}

function Details({ candidate }) {
  const rows = [
    ["What", candidate.what],
    ["Looks like", candidate.looks_like],
    ["Here", candidate.here],
    ["To confirm", candidate.confirm],
    ["Not distinguished from", candidate.passes ? (candidate.rivals || []).join(", ") : ""],
  ].filter(([, words]) => words);
  return html`
    <div class="ui-details">
      <dl>${rows.map(([head, words]) => html`<dt>${head}</dt><dd>${spaced(words)}</dd>`)}</dl>
      ${candidate.has_scan && html`<${Figure} src=${address("/api/figure", { name: `scan:${candidate.name}` })} title=${candidate.name} alt=${`Misfit over the parameters of ${candidate.name}`} />`}
    </div>`;
}

function Candidate({ candidate, best, curve }) {
  const { name, passes } = candidate;
  const [open, setOpen] = useState(false);
  const [tried, busy] = [useStore((s) => s.tried === name), useStore(foreground)];
  const adding = busy?.do === "add_and_diagnose" && busy.arguments?.effect === name;
  const why = busy && !adding ? "Wait until the work ends, or cancel it." : null;
  const gap = candidate.behind ?? candidate.rank;
  const numbers = (candidate.numbers || []).filter((one) => !(candidate.errors && one.startsWith("held-out error")));
  const leave = (event) => !event.currentTarget.contains(event.relatedTarget) && !event.currentTarget.matches(":hover, :focus-within") && trySoon("", 200);
  return html`
    <li class=${`ui-candidate ${best ? "best" : ""} ${passes ? "" : "weak"} ${tried ? "tried" : ""}`} data-candidate=${name}
      onMouseEnter=${() => trySoon(name)} onMouseLeave=${leave} onFocusIn=${() => trySoon(name)} onFocusOut=${leave}>
      <div class="ui-candidate-head">
        <h3>${breakable(name)}</h3>
        <p class="ui-rank">${spaced(gap)}</p>
        <${Button} small label="Try" aria-label=${`Try ${name}`} kind=${tried ? "on" : best ? "" : "quiet"} onClick=${() => update({ tried: name })} />
        <${Button} small icon="add" label="Add" aria-label=${`Add ${name}`} kind=${best ? "primary" : passes ? "" : "quiet"} why=${why} busy=${adding}
          title=${`Add ${name}, fit, and diagnose again`} onClick=${() => addEffect(name)} />
      </div>
      ${(best || open) && html`<p class="ui-candidate-what">${candidate.looks_like || candidate.what}</p>`}
      <${Errors} curve=${tried && curve?.name === name ? curve : null} errors=${candidate.errors} words=${best || open ? candidate.error_with : ""} />
      ${(best || open) && numbers.length ? html`<p class="ui-numbers">${numbers.map((one) => html`<span><${Words} text=${one} /></span>`)}</p>` : null}
      <button type="button" class="ui-link ui-how" aria-expanded=${String(open)} aria-label=${`How ${name} is recognised`} onClick=${() => setOpen(!open)}>
        ${best ? html`<span>How it is recognised</span>` : null}<${Icon} name="more" />
      </button>
      ${open && html`<${Details} candidate=${candidate} />`}
    </li>`;
}

export function Candidates({ curve }) {
  const all = useStore((s) => s.study?.diagnosis?.candidates || []);
  const [more, setMore] = useState(false), complete = useStore((s) => s.study?.diagnosis?.complete !== false);
  const stale = useStore((s) => outdatedWords(s, "diagnosis", "model", "motion", "track"));
  if (!all.length) return null;
  const passing = all.filter((one) => one.passes), weak = all.filter((one) => !one.passes);
  const shown = [...passing, ...(more ? weak : weak.slice(0, passing.length ? 0 : MAX_WEAK))];
  return html`
    <${Panel} title="Candidates" className=${`ui-candidates ${stale ? "stale" : ""}`} aside=${html`<span class="ui-aside">${all.length} with some evidence${complete ? "" : ", estimating"}</span>`}>
      <ol>${shown.map((one) => html`<${Candidate} key=${one.name} candidate=${one} best=${one === passing[0]} curve=${curve} />`)}</ol>
      ${shown.length < all.length || more
        ? html`<button type="button" class="ui-link" aria-expanded=${String(more)} onClick=${() => setMore(!more)}>${more ? "Show fewer" : `Show ${all.length - shown.length} more`}</button>`
        : null}
    <//>`;
}

/** Write a formula of the unexplained force into the study file and fit with it. */
async function addFormula(effect) {
  if (await change("define", { effect }, `${effect.effect} defined in the study file.`)) addEffect(effect.effect);
}

/** The force that no effect explains, with formulas that describe it. */
export function Formulas() {
  const [diagnosis, busy] = [useStore((s) => s.study?.diagnosis), useStore(foreground)];
  if (!diagnosis?.unexplained && !diagnosis?.formulas?.length) return null;
  return html`
    <${Panel} title="Unexplained force">
      ${diagnosis.unexplained && html`<p class="ui-note">${spaced(diagnosis.unexplained)}</p>`}
      <ul class="ui-formulas">
        ${(diagnosis.formulas || []).map(
          (one) => html`
            <li>
              <code>${one.formula}</code><p class="ui-note">${spaced(one.words)}${one.needs?.length ? ` Needs ${one.needs.join(", ")}: add it first.` : ""}</p>
              <${Button} small icon="add" label="Add the formula" onClick=${() => addFormula(one.effect)}
                why=${one.needs?.length ? `Add ${one.needs.join(", ")} first.` : busy ? "Wait until the work ends, or cancel it." : null} />
            </li>`,
        )}
      </ul>
    <//>`;
}
