// Small controls that all tabs share: button, segmented choice, panel, run picker.

import { html, useEffect, useId, useRef, useState } from "./hooks.js";
import { edited } from "./actions.js";
import { pause } from "./api.js";
import { Icon, Spinner } from "./icons.js";
import { selectedRun, update, useStore } from "./store.js";

/**
 * A button. `why` disables it and says why (it keeps the focus, so that the reason can be read); `busy` shows a spinner. A click
 * that writes what was just typed counts for the button as it is after that.
 */
export function Button({ icon, label, onClick, why, busy, kind = "", small, title, children, iconOnly, ...more }) {
  const now = useRef();
  now.current = { why, onClick };
  const press = async (event) => {
    if (why || busy) event.preventDefault();
    if (busy || (why && !((await edited()) && (await pause(0), !now.current.why)))) return;
    now.current.onClick?.(event);
  };
  const text = children || label;
  return html`
    <button
      type="button"
      class=${`ui-button ${kind} ${small ? "small" : ""} ${iconOnly ? "bare" : ""}`}
      aria-disabled=${why || busy ? "true" : null}
      aria-busy=${busy ? "true" : null}
      aria-label=${iconOnly ? label : null}
      title=${why || title || (iconOnly ? label : null)}
      onClick=${press}
      ...${more}
    >
      ${busy ? html`<${Spinner} />` : icon && html`<${Icon} name=${icon} />`}${!iconOnly && html`<span>${text}</span>`}
    </button>`;
}

/** One of a few choices, as buttons side by side: `options` are [value, label, icon]. */
export function Segments({ label, value, options, onChange, iconsOnly }) {
  const press = (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!step) return;
    event.preventDefault();
    const buttons = [...event.currentTarget.querySelectorAll("button")];
    buttons[(buttons.indexOf(document.activeElement) + step + buttons.length) % buttons.length].focus();
  };
  return html`
    <div class="ui-segments" role="group" aria-label=${label} onKeyDown=${press}>
      ${options.map(
        ([key, words, icon]) => html`
          <button
            type="button"
            aria-pressed=${String(value === key)}
            aria-label=${iconsOnly ? words : null}
            title=${iconsOnly ? words : null}
            onClick=${() => onChange(key)}
          >
            ${icon && html`<${Icon} name=${icon} />`}${!iconsOnly && html`<span>${words}</span>`}
          </button>`,
      )}
    </div>`;
}

/** A titled part of the page. */
export function Panel({ title, aside, children, className = "", ...more }) {
  const id = useId("panel");
  return html`
    <section class=${`ui-panel ${className}`} aria-labelledby=${title ? id : null} ...${more}>
      ${title && html`<div class="ui-panel-head"><h2 id=${id}>${title}</h2>${aside}</div>`}
      ${children}
    </section>`;
}

/** A figure of the server; a click shows it large. */
export const Figure = ({ src, title, alt }) => html`
  <button type="button" class="ui-sheet" title="Show it large" onClick=${() => update({ dialog: { kind: "figure", src, title, alt } })}>
    <img class="ui-figure" src=${src} alt=${alt} loading="lazy" />
  </button>`;

/** A sentence with a mark of its kind: "good", "warn", "bad" or "" for a remark. */
export const Note = ({ kind = "", children, className = "" }) => html`
  <p class=${`ui-note ${kind} ${className}`}>${kind && html`<${Icon} name=${kind} />`}<span>${children}</span></p>`;

export const Skeleton = ({ label, height = 120 }) => html`
  <div class="ui-skeleton" style=${{ minHeight: `${height}px` }} role="status"><span>${label}</span></div>`;

/** Choose the run that is shown. */
export function RunPicker() {
  const [runs, name] = useStore((s) => [s.study?.runs || [], selectedRun(s.study, s.run)?.name]).slice();
  if (runs.length < 2) return null;
  return html`
    <div class="ui-segments ui-runs" role="group" aria-label="Run">
      ${runs.map(
        (run, k) => html`
          <button type="button" aria-pressed=${String(run.name === name)} onClick=${() => update({ run: run.name, span: null })}>
            <span class="ui-dot" style=${{ background: `var(--ft-run-${k % 8})` }}></span><span>${run.name}</span>
          </button>`,
      )}
    </div>`;
}

/** A labelled input whose text is written on Enter or when it loses the focus; Escape takes it back. */
export function TextBox({ label, value, onCommit, placeholder, unit, hidden, wide, why }) {
  const id = useId("box"), box = useRef(), sent = useRef(null);
  const [text, setText] = useState(null); // null: as it is in the study; what is typed outlives new states of the study
  useEffect(() => {
    if (document.activeElement === box.current && box.current.value !== sent.current) return;
    sent.current = null;
    setText(null);
  }, [value]);
  const commit = () => {
    const typed = box.current.value;
    if (typed.trim() === value || typed === sent.current) return; // Enter has sent it; the lost focus need not
    sent.current = typed;
    onCommit(typed.trim());
  };
  const takeBack = () => {
    box.current.value = value; // at once: the lost focus may come before the next drawing
    setText(null);
  };
  const key = (event) => {
    if (event.key === "Enter") commit();
    if (event.key === "Escape") takeBack();
  };
  return html`
    <div class=${`ui-box ${wide ? "wide" : ""}`}>
      <label for=${id} class=${hidden ? "ui-hidden" : ""}>${label}</label>
      <span class="ui-box-row">
        <input
          id=${id} ref=${box} value=${text ?? value} placeholder=${placeholder} disabled=${Boolean(why)} title=${why}
          onInput=${(event) => setText(event.target.value)} onBlur=${commit} onKeyDown=${key}
        />
        ${unit && html`<span class="ui-unit">${unit}</span>`}
      </span>
    </div>`;
}

/** A labelled choice from a list: `options` are [value, words]. */
export function Choice({ label, value, options, onChange, hidden }) {
  const id = useId("choice");
  return html`
    <div class="ui-box">
      <label for=${id} class=${hidden ? "ui-hidden" : ""}>${label}</label>
      <select id=${id} value=${value} onChange=${(event) => onChange(event.target.value)}>
        ${options.map(([key, words]) => html`<option value=${key} selected=${key === value}>${words}</option>`)}
      </select>
    </div>`;
}
