// Dialogs: an outdated report, the contact sheet, keyboard shortcuts. The native element keeps the focus inside.

import { html, useEffect, useId, useRef } from "./hooks.js";
import { download, updateAndDownload } from "./actions.js";
import { Button } from "./controls.js";
import { Help } from "./help.js";
import { update, useStore } from "./store.js";

const close = () => update({ dialog: null });

function Frame({ title, children, wide }) {
  const box = useRef(), id = useId("dialog");
  useEffect(() => {
    const before = document.activeElement;
    box.current.showModal();
    return () => before?.focus?.();
  }, []);
  return html`
    <dialog ref=${box} class=${`ui-dialog ${wide ? "wide" : ""}`} aria-labelledby=${id} onClose=${close} onClick=${(e) => e.target === box.current && close()}>
      <div class="ui-dialog-head"><h2 id=${id}>${title}</h2><${Button} iconOnly kind="quiet" icon="cancel" label="Close" onClick=${close} /></div>
      ${children}
    </dialog>`;
}

const Outdated = ({ what, more, reason }) => html`
  <${Frame} title="This report is outdated">
    <p>${reason}</p>
    <div class="ui-dialog-actions">
      <${Button} kind="primary" label="Update and download" autofocus onClick=${() => updateAndDownload(what, more)} />
      <${Button} label="Download it as it is" onClick=${() => (close(), download(what, { ...more, anyway: 1 }))} />
      <${Button} kind="quiet" label="Cancel" onClick=${close} />
    </div>
  <//>`;

const Large = ({ src, title, alt }) => html`<${Frame} title=${title} wide><img class="ui-figure" src=${src} alt=${alt} /><//>`;

const Shortcuts = () => html`<${Frame} title="Keyboard"><${Help} /><//>`;

const KINDS = { outdated: Outdated, figure: Large, help: Shortcuts };

export function Dialogs() {
  const dialog = useStore((s) => s.dialog);
  return dialog ? html`<${KINDS[dialog.kind]} ...${dialog} />` : null;
}
