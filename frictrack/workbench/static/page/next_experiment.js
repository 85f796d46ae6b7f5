// Experiments that would tell the remaining candidates apart.

import { html } from "./hooks.js";
import { Panel } from "./controls.js";
import { spaced } from "./format.js";
import { useStore } from "./store.js";

const MAX_SHOWN = 3;

export function NextExperiments() {
  const diagnosis = useStore((s) => s.study?.diagnosis);
  const [steps, words] = [diagnosis?.next || [], diagnosis?.next_words || []];
  if (!steps.length && !words.length) return null;
  return html`
    <${Panel} title="Next experiment">
      <ol class="ui-next">${steps.slice(0, MAX_SHOWN).map((step) => html`<li><b>${spaced(step.title)}</b> ${spaced(step.words)}</li>`)}</ol>
      ${words.map((one) => html`<p class="ui-note">${spaced(one)}</p>`)}
    <//>`;
}
