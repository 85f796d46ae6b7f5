// How the error has fallen from model to model, as a small line drawing with its numbers.

import { html } from "./hooks.js";
import { Panel } from "./controls.js";
import { digits, quantity } from "./format.js";
import { useStore } from "./store.js";

const WIDTH = 320, HEIGHT = 84, SIDE = 26, TOP = 22, FOOT = 18;

/** Heights of the errors on a logarithmic axis. */
function heights(values) {
  const logs = values.map((value) => Math.log10(Math.max(value, 1e-12)));
  const low = Math.min(...logs), span = Math.max(...logs) - low || 1;
  return logs.map((v) => TOP + (HEIGHT - TOP - FOOT) * (1 - (v - low) / span));
}

/** Models with a comparable error, and its name: the held-out error, else the misfit. */
function series(models) {
  const known = (key) => models.filter((one) => one.errors[key] !== null && one.errors[key] !== undefined);
  const held = known("heldout");
  if (held.length >= 2 || (held.length && held.length === models.length)) {
    return { name: "Held-out error", rows: held, value: (one) => one.errors.heldout, unit: held[0].errors.heldout_unit };
  }
  return { name: "Reduced χ²", rows: known("reduced_chi2"), value: (one) => one.errors.reduced_chi2, unit: "" };
}

export function ErrorStrip() {
  // errors of other measurements compare nothing: only models that are as new as the current one
  const models = useStore((s) => (s.study?.models || []).filter((one, k, all) => !one.outdated === !all.find((m) => m.current)?.outdated));
  const { name, rows, value, unit } = series(models);
  if (rows.length < 2) return null;
  const values = rows.map(value), at = heights(values);
  const x = (k) => SIDE + ((WIDTH - 2 * SIDE) * k) / (rows.length - 1);
  const words = `${name}: ${quantity(values[0], unit)} → ${quantity(values.at(-1), unit)}`;
  const plain = (one) => one.label.replace(/^\d+\. /, "");
  const label = (one, k) => (k && plain(one).startsWith(plain(rows[k - 1])) && plain(one).slice(plain(rows[k - 1]).length).trim()) || plain(one);
  return html`
    <${Panel} title=${name} className="ui-strip" aside=${html`<b class="ui-aside strong">${quantity(values[0], unit)} → ${quantity(values.at(-1), unit)}</b>`}>
      <svg viewBox=${`0 0 ${WIDTH} ${HEIGHT}`} role="img" aria-label=${words}>
        <polyline points=${at.map((y, k) => `${x(k)},${y}`).join(" ")} />
        ${rows.map(
          (one, k) => html`
            <g class=${one.current ? "current" : ""}>
              <circle cx=${x(k)} cy=${at[k]} r=${one.current ? 5 : 3.5}><title>${`${one.label}: ${quantity(values[k], unit)}`}</title></circle>
              <text x=${x(k)} y=${at[k] - 9} text-anchor="middle" class="value">${digits(values[k])}</text>
              <text x=${x(k)} y=${HEIGHT - 4} text-anchor=${k === 0 ? "start" : k === rows.length - 1 ? "end" : "middle"}
                dx=${k === 0 ? -SIDE + 2 : k === rows.length - 1 ? SIDE - 2 : 0}>${shorten(label(one, k), rows.length)}</text>
            </g>`,
        )}
      </svg>
    <//>`;
}

const shorten = (text, n) => (text.length > 60 / n ? `${text.slice(0, Math.floor(60 / n) - 1)}…` : text);
