// Texts in which the words of the glossary are explained where the pointer or the focus rests on them.

import { html } from "./hooks.js";
import { getJSON } from "./api.js";
import { spaced } from "./format.js";
import { update, useStore } from "./store.js";

/** Read the glossary once; without it the texts stay plain. */
export async function readGlossary() {
  const { pattern, meanings } = await getJSON("/api/glossary");
  update({ glossary: { pattern: new RegExp(pattern, "gi"), meaning: (word) => meanings[word] ?? meanings[word.replace(/s$/, "")] } });
}

export function Words({ text }) {
  const glossary = useStore((s) => s.glossary), plain = spaced(text), parts = [];
  let at = 0;
  for (const found of glossary ? plain.matchAll(glossary.pattern) : []) {
    parts.push(plain.slice(at, found.index), html`<abbr tabindex="0" title=${glossary.meaning(found[0].toLowerCase())}>${found[0]}</abbr>`);
    at = found.index + found[0].length;
  }
  return html`${[...parts, plain.slice(at)]}`;
}
