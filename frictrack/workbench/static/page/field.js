// One field of the study: its text, and beside it how it is read, while it is typed.

import { html, useEffect, useId, useRef, useState } from "./hooks.js";
import { post } from "./api.js";
import { spaced } from "./format.js";
import { Icon, Spinner } from "./icons.js";

const CHECK_MS = 120; // after the last key

/** Ask the server how a text is read; nothing is written. The answer is given with its text: the box may hold a newer one already. */
function useCheck(name, text, run) {
  const [read, setRead] = useState({});
  useEffect(() => {
    if (text === null) return undefined;
    const abort = new AbortController();
    const timer = setTimeout(async () => {
      try {
        const answer = await post("/api/check", { fields: { [name]: text }, run }, { signal: abort.signal });
        setRead({ of: text, field: answer.fields[name] });
      } catch {
        /* a newer text is being checked, or the banner says that the server is gone */
      }
    }, CHECK_MS);
    return () => (clearTimeout(timer), abort.abort());
  }, [name, text, run]);
  return (typed) => (read.of === typed ? read.field : null);
}

/**
 * `field` is the Field of the state, without which nothing can be typed; `onCommit(text)` resolves to whether it was written. `run` is given for a field of one run.
 */
export function Field({ name, label, field, placeholder, run, onCommit, action, compact }) {
  const id = useId(name), box = useRef(), sent = useRef(null);
  const [text, setText] = useState(null); // null: as it is in the study
  const [saving, setSaving] = useState(false);
  const typed = text ?? field?.draft ?? null;
  const readingOf = useCheck(name, typed, run);
  const shown = (typed !== null && readingOf(typed)) || field || {};
  useEffect(() => {
    sent.current = null;
    if (document.activeElement !== box.current) setText(null);
  }, [field?.text, field?.source]);
  const commit = async () => {
    const typed = box.current.value; // not `text`, which may wait for the next drawing
    const wanted = typed.trim();
    if (wanted === (field?.text || "")) return setText(null);
    if (readingOf(typed)?.error) return; // said beside the box; nothing is written
    if (sent.current === wanted) return; // Enter has written it; the lost focus need not
    sent.current = wanted;
    setSaving(true);
    const written = await onCommit(wanted);
    setSaving(false);
    if (!written) sent.current = null;
    else if (document.activeElement !== box.current) setText(null);
  };
  const takeBack = () => {
    box.current.value = field?.text || ""; // at once: the lost focus may come before the next drawing
    setText(null);
  };
  const key = (event) => {
    if (event.key === "Enter") commit();
    if (event.key === "Escape") takeBack();
  };
  const change = (event) => {
    sent.current = null;
    setText(event.target.value);
  };
  const { error, warning, echo } = shown;
  const missing = !error && !(text ?? field?.text) && !echo && field?.needed;
  const kind = error ? "bad" : warning ? "warn" : "";
  return html`
    <div class=${`ui-field ${kind} ${compact ? "compact" : ""}`} data-missing=${String(Boolean(missing))} data-name=${name}>
      <div class="ui-field-head">
        <label for=${id} class=${compact ? "ui-hidden" : ""}>${label}</label>
        <output class="ui-echo" for=${id}>${saving ? html`<${Spinner} />` : missing ? "needed" : spaced(echo || "")}</output>
      </div>
      <div class="ui-field-row">
        <input
          id=${id} ref=${box} value=${text ?? field?.text ?? ""} placeholder=${placeholder} disabled=${!field} autocomplete="off" spellcheck="false" enterkeyhint="done"
          aria-invalid=${error ? "true" : null} aria-describedby=${`${id}-words`}
          onInput=${change} onBlur=${commit} onKeyDown=${key}
        />
        ${action}
      </div>
      <p class=${`ui-field-words ${kind}`} id=${`${id}-words`} aria-live="polite">
        ${kind ? html`<${Icon} name=${kind} />` : ""}${error || warning || ""}
      </p>
    </div>`;
}
