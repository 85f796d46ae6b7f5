// Linked plots and film; see page_plots.md in docs/explanation.

export { FilmView } from "./film.js";
export { Legend } from "./legend.js";
export { LinkedView } from "./linked_view.js";
export { columnsOf, parsePacked } from "./packed.js";
export { PlotGrid } from "./plot_grid.js";
