// The first view: drop or choose recordings, use those of the folder, or open the sample study.

import { html, useRef, useState } from "./hooks.js";
import { openSample, takeIn, upload } from "./actions.js";
import { Button } from "./controls.js";
import { count } from "./format.js";
import { Icon } from "./icons.js";
import { useStore } from "./store.js";

/** An area on which files can be dropped; it is also a button that opens a file dialog. */
export function DropZone({ compact }) {
  const input = useRef(), kinds = useStore((s) => (s.study?.suffixes || []).join());
  const [over, setOver] = useState(false), busy = useStore((s) => s.busy.has("upload"));
  const drop = (event) => {
    event.preventDefault();
    setOver(false);
    if (event.dataTransfer.files.length) upload([...event.dataTransfer.files]);
  };
  return html`
    <div class=${`ui-drop ${over ? "over" : ""} ${compact ? "compact" : ""}`} onDragOver=${(e) => (e.preventDefault(), setOver(true))}
      onDragLeave=${() => setOver(false)} onDrop=${drop}>
      ${!compact && html`<${Icon} name="film" /><p class="ui-drop-title">Drop films here</p>`}
      <${Button} icon="add" busy=${busy} small=${compact} label=${compact ? "Add recordings" : "Choose recordings"} onClick=${() => input.current.click()} />
      ${!compact && html`<p class="ui-note">High-speed films of a sliding mass, or tables of time and position. They are stored beside the study.</p>`}
      <input ref=${input} class="ui-hidden" type="file" multiple accept=${kinds} tabindex="-1" aria-hidden="true"
        onChange=${(e) => (e.target.files.length && upload([...e.target.files]), (e.target.value = ""))} />
    </div>`;
}

const about = (one) =>
  one.skipped || [one.width && `${one.width} × ${one.height} px`, one.frames && count(one.frames, "frame"), one.kind === "table" && "table"].filter(Boolean).join(", ");

/** Recordings of the folder that are not in the study: all are chosen until one is left out. */
export function FolderRecordings({ title = "In this folder", onPreview }) {
  const found = useStore((s) => (s.study?.recordings || []).filter((one) => !one.in_study));
  const [out, setOut] = useState(() => new Set());
  const busy = useStore((s) => s.busy.has("takeIn"));
  const usable = found.filter((one) => !one.skipped), chosen = usable.filter((one) => !out.has(one.name)).map((one) => one.name);
  if (!found.length) return null;
  const toggle = (name) => {
    const next = new Set(out);
    if (!next.delete(name)) next.add(name);
    setOut(next);
  };
  const all = chosen.length === usable.length;
  return html`
    <div class="ui-folder">
      <h2>${title}</h2>
      <ul>
        ${found.map(
          (one) => html`
            <li key=${one.name} class=${one.skipped ? "skipped" : ""}>
              <label><input type="checkbox" checked=${!one.skipped && !out.has(one.name)} disabled=${Boolean(one.skipped)} onChange=${() => toggle(one.name)} />
                <span>${one.name}</span></label>
              <span class="ui-note">${about(one)}</span>
              ${onPreview && !one.skipped && one.kind === "film" && html`<${Button} small iconOnly kind="quiet" icon="run" label=${`Play ${one.name}`} onClick=${() => onPreview(one)} />`}
            </li>`,
        )}
      </ul>
      <${Button} kind="primary" icon="folder" busy=${busy} why=${chosen.length ? null : "Choose at least one recording."}
        label=${all ? (usable.length === 1 ? "Use this recording" : `Use these ${usable.length}`) : `Use ${chosen.length} of ${usable.length}`}
        onClick=${() => takeIn(chosen)} />
    </div>`;
}

const STEPS = [
  ["film", "Film", "A high-speed camera looks at a sliding mass from the side. Several speeds or masses tell effects apart."],
  ["run", "Run", "Each film is tracked to about a hundredth of a pixel; the friction force follows from mass and deceleration."],
  ["search", "See what is missing", "A friction model is fitted. Where it fails, the page names the effect that explains the misfit; you add it and watch the error fall."],
];

export function StartView() {
  const [folder, busy, any] = [
    useStore((s) => s.study?.folder),
    useStore((s) => s.busy.has("sample")),
    useStore((s) => (s.study?.recordings || []).some((one) => !one.in_study)),
  ];
  return html`
    <div class="ui-start">
      <div class="ui-start-main">
        <h2 class="ui-start-title">From films of a sliding mass to its friction law</h2>
        <div class="ui-start-ways">
          <${DropZone} />
          <div class="ui-start-side">
            <${FolderRecordings} title=${`In ${folder?.split(/[/\\]/).pop() || "this folder"}`} />
            <div class="ui-sample">
              <${Icon} name="sample" />
              <div><h2>Open the sample study</h2><p class="ui-note">${any ? "Four simulated films with a hidden effect; they are opened in this folder." : "Four simulated films with a hidden effect: find it in a minute."}</p></div>
              <${Button} busy=${busy} label="Open" aria-label="Open the sample study" onClick=${openSample} why=${any ? "This folder has recordings already. Start frictrack app in an empty folder for the sample study." : null} />
            </div>
          </div>
        </div>
        <ol class="ui-steps">${STEPS.map(([icon, title, words]) => html`<li><${Icon} name=${icon} /><div><h3>${title}</h3><p>${words}</p></div></li>`)}</ol>
      </div>
    </div>`;
}
