// Equations of the catalogue as text with real sub- and superscripts: "F_c s + F_v v^2".

import { html } from "./hooks.js";

const GREEK = { delta: "δ", pi: "π", omega: "ω", tau: "τ" };
const letters = (text) => text.replace(/\b(delta|pi|omega|tau)\b/g, (word) => GREEK[word]);
const MARK = /([_^])(\{[^}]*\}|\([^)]*\)|[A-Za-z0-9]+(?:[.,_][A-Za-z0-9]+)*)/g;

/** Text between marks stays as it is; `_x` becomes a subscript and `^x` a superscript. */
function marked(text) {
  const parts = [];
  let at = 0;
  for (const found of text.matchAll(MARK)) {
    parts.push(text.slice(at, found.index));
    const inner = letters(found[2].replace(/^[{]|[}]$/g, ""));
    parts.push(found[1] === "_" ? html`<sub>${inner}</sub>` : html`<sup>${inner}</sup>`);
    at = found.index + found[0].length;
  }
  parts.push(text.slice(at));
  return parts.map((part) => (typeof part === "string" ? letters(part).replace(/(^|[\s(])-/g, "$1\u2212") : part));
}

/** Lines end between terms, if they can. */
export const Equation = ({ text }) => html`<span>${(text || "").split(/ (?=\+ )/).map((term) => html`<span>${marked(term)}</span> `)}</span>`;
