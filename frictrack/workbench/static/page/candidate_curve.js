// The curve of the candidate that is hovered, focused or tried, drawn over the current model.

import { useEffect, useState } from "./hooks.js";
import { address, pause } from "./api.js";
import { readPacked } from "./linked.js";
import { say, useStore } from "./store.js";

const RETRY_MS = 250; // while the server is fitting the candidate

/**
 * Draw the curve of the candidate in `store.tried`, with its label in the plot of this title; returns null, {name, pending: true} or {name, errors}.
 * Curves are kept for one state of the study.
 */
export function useCandidateCurve(parts, plot) {
  const [name, key] = [useStore((s) => s.tried), useStore((s) => `${s.study?.model?.group} ${s.study?.revision}`)];
  const [shown, setShown] = useState(null);
  const [kept] = useState(() => new Map());
  useEffect(() => {
    if (!parts || !name) {
      parts?.view.setCandidate(null, {});
      setShown(null);
      return undefined;
    }
    const abort = new AbortController();
    const draw = (found) => {
      parts.view.setCandidate(found.columns, { name, plot, label: found.scene.errors?.words || `with ${name}` });
      setShown({ name, errors: found.scene.errors });
    };
    const read = async () => {
      if (kept.has(`${key} ${name}`)) return draw(kept.get(`${key} ${name}`));
      setShown({ name, pending: true });
      for (;;) {
        const found = await readPacked(address("/api/candidate", { name }), parts.parsePacked, abort.signal);
        if (abort.signal.aborted) return undefined;
        if (found) {
          kept.set(`${key} ${name}`, found);
          return draw(found);
        }
        await pause(RETRY_MS);
      }
    };
    read().catch((error) => {
      if (error.name === "AbortError") return;
      setShown({ name, error: error.message });
      say(error.message, "warn");
    });
    return () => abort.abort();
  }, [parts, name, key, plot]);
  return shown;
}
