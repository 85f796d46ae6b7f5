// Mend frames in which the target was lost: choose the frames, show the target in one of them (or interpolate, or leave them
// out), track again. A click marks the target in one frame, and goes to the next. What is mended is listed and can be taken back.

import { html, useEffect, useState } from "./hooks.js";
import { edit, start } from "./actions.js";
import { Button, Panel, TextBox } from "./controls.js";
import { Icon } from "./icons.js";
import { foreground } from "./selectors.js";
import { say, store, update, useStore } from "./store.js";

const MARK_PX = 20; // side of the box around a click, of which the middle counts
const HOW = {
  track: "tracked again from the target that you drew",
  interpolate: "interpolated",
  leave_out: "left out",
};

/** The repair that is being made: its frames, what shall be done with them, and the target that was drawn. */
export function useRepair(parts, run) {
  const span = useStore((s) => s.span);
  const [target, setTarget] = useState(null);
  useEffect(() => setTarget(null), [run?.name, span?.from, span?.to]);
  useEffect(() => {
    if (parts) parts.filmView.range = span;
  }, [parts, span, run?.name]);
  useEffect(() => {
    if (parts && span) parts.filmView.show(span.from);
  }, [parts, span?.from, run?.name]);
  return {
    target,
    near: () => {
      const last = (run?.film?.frames ?? 1) - 1, from = Math.min(parts?.filmView.number ?? 0, last);
      return { from, to: Math.min(from + 9, last) };
    },
    drawn: async ({ shape: drawn, frame }) => {
      const [x, y] = drawn, shape = drawn.length === 2 ? [x - MARK_PX / 2, y - MARK_PX / 2, MARK_PX, MARK_PX] : drawn;
      if (drawn.length === 2 && !store.span) {
        if (await write(run, { from: frame, to: frame, how: "track", target: shape }, "marked. Mark it in further frames, then press Update")) parts.filmView.show(frame + 1);
        return;
      }
      const inside = store.span && frame >= store.span.from && frame <= store.span.to;
      if (!inside) update({ span: { from: frame, to: Math.max(frame, (run.film?.frames ?? frame + 1) - 1) } });
      setTimeout(() => setTarget({ shape, frame }));
      say(`Target drawn in frame ${frame}. Press Track again.`);
    },
  };
}

const frames = ({ from, to }) => (from === to ? `frame ${from}` : `frames ${from} to ${to}`);

/** Write the repair into the study; true when it is there. */
function write(run, repair, words = HOW[repair.how]) {
  const kept = (run.repairs || []).filter((one) => one.to < repair.from || one.from > repair.to);
  const all = [...kept, repair].sort((a, b) => a.from - b.from);
  return edit("run", "repair", all, run.name, `${frames(repair)}: ${words}.`);
}

/** Write the repair and track again. */
async function mend(run, repair) {
  if (!(await write(run, repair))) return;
  update({ span: null, tool: "" });
  start("measure", { stage: "motion" }, "Track again");
}

function Suspects({ run }) {
  const span = useStore((s) => s.span);
  const choose = (one) => update({ span: { from: one.from, to: one.to }, tool: "repair" });
  if (!run.suspect?.length) return html`<p class="ui-note"><${Icon} name="good" /><span>${run.lost_words}${run.n_frames_lost ? " None needs a repair." : ""}</span></p>`;
  return html`
    <ul class="ui-spans">
      ${run.suspect.map(
        (one) => html`
          <li><button type="button" aria-pressed=${String(span?.from === one.from && span?.to === one.to)} onClick=${() => choose(one)}>
            <${Icon} name="warn" /><b>${frames(one)}</b><span>${one.words}</span>
          </button></li>`,
      )}
    </ul>`;
}

/** The chosen frames, and what to do with them. */
function Editor({ run, repair }) {
  const span = useStore((s) => s.span), job = useStore(foreground);
  if (!span) return null;
  const set = (key) => (text) => {
    const value = Number.parseInt(text, 10), last = (run.film?.frames ?? 1) - 1;
    if (Number.isNaN(value) || value < 0 || value > last) return say(`Expected a frame from 0 to ${last} but got "${text}".`, "warn");
    const next = { ...span, [key]: value };
    return update({ span: { from: Math.min(next.from, next.to), to: Math.max(next.from, next.to) } });
  };
  const why = job ? "Wait until the work ends, or cancel it." : null;
  const track = () => mend(run, { ...span, how: "track", target: repair.target.shape, frame: repair.target.frame });
  return html`
    <div class="ui-mend">
      <div class="ui-row"><${TextBox} label="From frame" value=${String(span.from)} onCommit=${set("from")} /><${TextBox} label="to frame" value=${String(span.to)} onCommit=${set("to")} /></div>
      <${Button} icon="target" kind=${repair.target ? "primary" : ""} label="Track again" onClick=${track}
        why=${why || (repair.target ? null : "Drag a box around the target in one of these frames first.")}
        title="Track these frames again from the target that you drew" />
      <div class="ui-row">
        <${Button} small label="Interpolate" why=${why} title="Join the positions before and after by a smooth curve" onClick=${() => mend(run, { ...span, how: "interpolate" })} />
        <${Button} small label="Leave out" why=${why} title="These frames have no position" onClick=${() => mend(run, { ...span, how: "leave_out" })} />
        <${Button} small kind="quiet" label="Close" onClick=${() => update({ span: null, tool: "" })} />
      </div>
      ${!repair.target && html`<p class="ui-note">Drag a box around the target on the film, in one of these frames.</p>`}
    </div>`;
}

function Mended({ run }) {
  if (!run.repairs?.length) return null;
  const drop = (k) => {
    const left = run.repairs.filter((_, j) => j !== k);
    edit("run", "repair", left.length ? left : null, run.name, `${frames(run.repairs[k])}: the repair is taken back.`);
  };
  return html`
    <h3>Mended</h3>
    <ul class="ui-spans mended">
      ${run.repairs.map(
        (one, k) => html`
          <li><button type="button" onClick=${() => update({ span: { from: one.from, to: one.to } })}><${Icon} name="repair" /><b>${frames(one)}</b><span>${HOW[one.how]}</span></button>
            <${Button} iconOnly small kind="quiet" icon="cancel" label=${`Take the repair of ${frames(one)} back`} onClick=${() => drop(k)} /></li>`,
      )}
    </ul>`;
}

export function RepairPanel({ run, repair }) {
  const span = useStore((s) => s.span);
  if (run.state === "new" && !run.repairs?.length && !span) return null;
  return html`
    <${Panel} title="Lost frames" className="ui-repair" aside=${run.n_frames_lost && run.suspect?.length ? html`<span class="ui-aside">${run.lost_words}</span>` : null}>
      <${Suspects} run=${run} />
      <${Editor} run=${run} repair=${repair} />
      ${!span && run.film && html`<${Button} small icon="repair" label="Choose frames" onClick=${() => update({ span: repair.near(), tool: "repair" })} />`}
      <${Mended} run=${run} />
    <//>`;
}
