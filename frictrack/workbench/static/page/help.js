// The keyboard shortcuts of the page, as they are bound in keys.js and in the plots.

import { html } from "./hooks.js";

const GROUPS = [
  ["Page", [["1 to 5", "Film, Compare, Motion, Model, History"], ["Ctrl+Enter", "Run"], ["Ctrl+Z", "Undo"], ["Ctrl+Shift+Z", "Redo"], ["[ and ]", "previous and next run"], ["?", "this list"]]],
  ["Film", [["Space", "play or pause"], ["T", "draw the target"], ["R", "draw a ruler"], ["Escape", "put the tool away"]]],
  ["Plots (focus one with Tab)", [["← →", "next row"], ["Page up, Page down", "25 rows"], ["Shift with these", "select"], ["+ − 0", "zoom in, out, show all"], ["Escape", "clear the selection"]]],
  ["Mouse on plots", [["drag", "select"], ["Shift+drag", "add to the selection"], ["Alt+drag", "take from it"], ["Ctrl+wheel, Z+drag", "zoom"], ["double click", "show all"], ["arrows at the corner", "show this plot alone"]]],
];

export const Help = () => html`
  <div class="ui-help">
    ${GROUPS.map(([title, rows]) => html`<section><h3>${title}</h3><dl>${rows.map(([keys, words]) => html`<div><dt><kbd>${keys}</kbd></dt><dd>${words}</dd></div>`)}</dl></section>`)}
  </div>`;
