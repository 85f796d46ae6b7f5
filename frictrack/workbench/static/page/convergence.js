// Misfit over the generations of the running search.

import { html, useEffect, useState } from "./hooks.js";
import { useStore } from "./store.js";

const MISFIT = /misfit ([-+.\deE]+)/;
const WIDTH = 300, HEIGHT = 90;

export function Convergence() {
  const job = useStore((s) => (s.study?.job?.do === "fit" ? s.study.job : null));
  const [points, setPoints] = useState([]);
  useEffect(() => {
    const found = job && MISFIT.exec(job.what || "");
    if (!found) return;
    setPoints((old) => (job.done <= (old.at(-1)?.k ?? -1) ? [{ k: job.done, value: Number(found[1]) }] : [...old, { k: job.done, value: Number(found[1]) }]));
  }, [job?.id, job?.what]);
  if (points.length < 2) return null;
  const logs = points.map((one) => Math.log10(Math.max(one.value, 1e-300)));
  const low = Math.min(...logs), span = Math.max(...logs) - low || 1, last = points.at(-1).k - points[0].k || 1;
  const line = points.map((one, i) => `${(WIDTH * (one.k - points[0].k)) / last},${4 + (HEIGHT - 8) * (1 - (logs[i] - low) / span)}`);
  return html`
    <figure class="ui-convergence">
      <svg viewBox=${`0 0 ${WIDTH} ${HEIGHT}`} role="img" aria-label=${`Misfit of the search: ${points.at(-1).value}`}><polyline points=${line.join(" ")} /></svg>
      <figcaption>generation ${points.at(-1).k}: misfit ${points.at(-1).value}</figcaption>
    </figure>`;
}
