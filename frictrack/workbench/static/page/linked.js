// Plots, legend and film of one tab: one linked view, whose data are read again when the study has changed.

import { html, useEffect, useRef, useState } from "./hooks.js";
import { frameOf, request } from "./api.js";
import { Skeleton } from "./controls.js";
import { keepPlace, notePlace } from "./place.js";
import { say, useStore } from "./store.js";

const STRIP = 2.6; // a film that is wider than this times its height lies above the plots

/** Read packed columns; null while the server is still computing them. */
export async function readPacked(path, parse, signal) {
  const answer = await request(path, { signal });
  if (answer.status === 202) return null;
  return parse(await answer.arrayBuffer());
}

/** Load the scene of `path` into the view whenever the version of the study changes; the same bytes are not drawn twice. */
function useScene(parts, path, version) {
  const last = useRef({});
  const [has, setHas] = useState(false), jumps = useStore((s) => s.jumps);
  useEffect(() => {
    if (!parts || !path) return undefined;
    const abort = new AbortController();
    request(path, { signal: abort.signal })
      .then((answer) => answer.arrayBuffer())
      .then((buffer) => {
        const words = new Uint32Array(buffer, 0, buffer.byteLength >> 2);
        const old = last.current.words;
        const equal = last.current.path === path && old?.length === words.length && old.every((value, k) => value === words[k]);
        last.current = { path, words };
        if (!equal) {
          const { scene, columns } = parts.parsePacked(buffer);
          parts.noted?.();
          parts.view.setScene(scene, columns);
          keepPlace(parts);
          parts.noted = notePlace(parts.view);
        }
        setHas(true);
      })
      .catch((error) => {
        if (error.name === "AbortError" || error.gone) return;
        setHas(false);
        if (error.status !== 404) say(error.message, "bad");
      });
    return () => abort.abort();
  }, [parts, path, version]);
  useEffect(() => parts && keepPlace(parts), [jumps]);
  return has;
}

/**
 * Plots beside their film. `path` gives the data, `film` the recording that is shown first, `films` those that the cursor may lead
 * to; `large` is the title of the plot that
 * matters most; `on` has a listener for each event of the view; `ready(parts)` is called with {view, grid, legend, filmView}.
 */
export function Linked({ path, film, films, large, on = {}, ready, empty, className = "", tools, adjust }) {
  const boxes = { film: useRef(), legend: useRef(), grid: useRef() };
  const [parts, setParts] = useState(null), calls = useRef(on);
  const version = useStore((s) => `${s.study?.server} ${s.study?.version}`);
  calls.current = on;
  useEffect(() => {
    let made = null, ended = false;
    import("../plots/index.js").then((plots) => {
      if (ended) return;
      const view = new plots.LinkedView({ frame: frameOf });
      const grid = new plots.PlotGrid(boxes.grid.current, view, { large });
      const legend = new plots.Legend(boxes.legend.current, view), filmView = new plots.FilmView(boxes.film.current, view, { adjust });
      made = { view, grid, legend, filmView, parsePacked: plots.parsePacked };
      for (const name of Object.keys(on)) view.on(name, (event) => calls.current[name]?.(event));
      setParts(made);
      ready?.(made);
    });
    return () => {
      ended = true;
      ready?.(null);
      for (const part of made ? [made.grid, made.legend, made.filmView, made.view] : []) part.destroy?.();
    };
  }, []);
  const has = useScene(parts, path, version);
  useEffect(() => {
    if (!parts) return;
    parts.filmView.setFilm(film);
    parts.filmView.setFilms?.(films || (film ? [film] : []));
    if (path || parts.noted || !film) return;
    keepPlace(parts); // a film without plots
    parts.noted = notePlace(parts.view);
  }, [parts, JSON.stringify(film), JSON.stringify(films)]);
  useEffect(() => parts?.grid.setLarge?.(large), [parts, large]);
  const aspect = film ? film.width / film.height : 1, strip = film && aspect > STRIP;
  return html`
    <div class=${`ui-linked ${strip ? "strip" : ""} ${film ? "" : "no-film"} ${className}`}>
      <div class="ui-film">${tools}<div class="ui-film-box" style=${{ "--aspect": aspect.toFixed(3) }} ref=${boxes.film}></div></div>
      <div class="ui-legend" ref=${boxes.legend}></div>
      <div class="ui-plots" ref=${boxes.grid}></div>
      ${!has && html`<div class="ui-plots-empty">${empty || html`<${Skeleton} label="Reading the plots ..." height=${240} />`}</div>`}
    </div>`;
}
