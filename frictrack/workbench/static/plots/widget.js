// The linked plots in a notebook (anywidget). Python joins this module and those that it imports to one text.

import { make, Listeners } from "./dom.js";
import { FilmView } from "./film.js";
import { Legend } from "./legend.js";
import { LinkedView } from "./linked_view.js";
import { columnsOf } from "./packed.js";
import { PlotGrid } from "./plot_grid.js";

const bytesOf = (value) => (value instanceof ArrayBuffer ? new Uint8Array(value) : new Uint8Array(value.buffer, value.byteOffset, value.byteLength));

/** Ask Python for frames of a film. */
function frameReader(model) {
  const waiting = new Map();
  let last = 0;
  const hear = async ({ id, error }, buffers) => {
    const asked = waiting.get(id);
    if (!asked) return;
    waiting.delete(id);
    if (error) return asked.reject(new Error(error));
    createImageBitmap(new Blob([bytesOf(buffers[0])], { type: "image/jpeg" })).then(asked.resolve, asked.reject);
  };
  model.on("msg:custom", hear);
  const frame = (film, n) => new Promise((resolve, reject) => {
    waiting.set(++last, { resolve, reject });
    model.send({ id: last, run: film.run, frame: n });
  });
  return { frame, end: () => model.off("msg:custom", hear) };
}

/** The notebook's theme: JupyterLab and VS Code say it on the body. */
function isDark() {
  const { body } = document;
  return body.dataset.jpThemeLight === "false" || body.classList.contains("vscode-dark");
}

function render({ model, el }) {
  const reader = frameReader(model), view = new LinkedView({ frame: reader.frame }), listeners = new Listeners();
  const [legendEl, filmEl, plotsEl] = ["legend", "film", "plots"].map((name) => make("div", { class: `fp-area-${name}` }));
  const root = make("div", { class: "fp-notebook" }, legendEl, filmEl, plotsEl);
  el.append(root);
  const theme = () => { root.dataset.theme = isDark() ? "dark" : "light"; view.say("theme"); };
  theme();
  const setScene = () => {
    const bytes = bytesOf(model.get("data"));
    view.setScene(model.get("scene"), columnsOf(model.get("scene"), bytes.slice().buffer));
    grid?.setLarge(model.get("scene").large || null);
  };
  const setFilms = () => {
    const films = model.get("films");
    root.classList.toggle("fp-without-film", !films.length);
    film.setFilms(films);
    film.setFilm(films[0] || null);
  };
  let grid = null;
  setScene();
  const legend = new Legend(legendEl, view), film = new FilmView(filmEl, view);
  grid = new PlotGrid(plotsEl, view, { large: model.get("scene").large || null });
  setFilms();
  listeners.end(view.on("selection", (chosen) => {
    model.set("rows", new DataView(view.chosen.slice(0, view.count).buffer));
    model.set("selection", chosen);
    model.save_changes();
  }));
  const observer = new MutationObserver(theme);
  observer.observe(document.body, { attributes: true, attributeFilter: ["data-jp-theme-light", "class"] });
  model.on("change:data", setScene);
  model.on("change:films", setFilms);
  return () => {
    observer.disconnect();
    model.off("change:data", setScene);
    model.off("change:films", setFilms);
    reader.end();
    for (const part of [legend, film, grid, listeners]) part.destroy();
  };
}

export default { render };
