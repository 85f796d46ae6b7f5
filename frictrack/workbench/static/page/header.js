// First line of the page: name, tabs, Undo, Redo, Run with its progress, report, theme, help.

import { html } from "./hooks.js";
import { cancel, download, redo, runAll, start, undo } from "./actions.js";
import { Button } from "./controls.js";
import { Icon } from "./icons.js";
import { TABS } from "./tabs.js";
import { foreground, progressOf } from "./selectors.js";
import { toggleTheme, useTheme } from "./theme.js";
import { update, useStore } from "./store.js";

function TabList() {
  const tab = useStore((s) => s.tab);
  const step = (event) => {
    const names = TABS.map((one) => one.name);
    const to = { ArrowRight: names.indexOf(tab) + 1, ArrowLeft: names.indexOf(tab) - 1, Home: 0, End: names.length - 1 }[event.key];
    if (to === undefined) return;
    event.preventDefault();
    const name = names[(to + names.length) % names.length];
    update({ tab: name });
    document.getElementById(`tab-${name}`).focus();
  };
  return html`
    <div class="ui-tabs" role="tablist" aria-label="Views" onKeyDown=${step}>
      ${TABS.map(
        ({ name, title }) => html`
          <button
            type="button" role="tab" id=${`tab-${name}`} aria-controls="view" aria-selected=${String(tab === name)}
            tabindex=${tab === name ? 0 : -1} onClick=${() => update({ tab: name })}
          >${title}</button>`,
      )}
    </div>`;
}

/** Progress of the running job, with Cancel; without one the button Run. */
function RunButton() {
  const job = useStore(foreground);
  const { step, share: part } = useStore((s) => (foreground(s) ? progressOf(s, foreground(s)) : {}));
  const [asked, can, words, stopping] = [
    useStore((s) => s.busy.has("run")),
    useStore((s) => s.study?.exists && s.study.ready?.can_run),
    useStore((s) => (s.study?.exists ? s.study.ready?.words : "Choose recordings first.")),
    useStore((s) => s.busy.has("cancel")),
  ];
  if (job) {
    const share = part === null ? null : Math.round(100 * part);
    return html`
      <div class="ui-progress">
        <div
          class=${`ui-bar ${share === null ? "unknown" : ""}`} role="progressbar" aria-label=${`${job.words}, ${step}`}
          aria-valuemin="0" aria-valuemax="100" aria-valuenow=${share} style=${{ "--share": `${share ?? 30}%` }}
        ><span>${step}</span></div>
        <${Button} icon="cancel" label="Cancel" onClick=${cancel} busy=${stopping} />
      </div>`;
  }
  return html`<${Button} icon="run" kind=${`primary ${can ? "" : "unready"}`} label="Run" busy=${asked} onClick=${runAll}
    title=${can ? "Track, measure, fit and diagnose (Ctrl+Enter)" : words} />`;
}

function ReportButton() {
  const report = useStore((s) => s.study?.report);
  const [fitted, busy] = [useStore((s) => Boolean(s.study?.model)), useStore((s) => s.busy.has("download.report.html"))];
  const running = Boolean(useStore(foreground));
  if (!report?.exists) {
    const why = !fitted ? "There is no fitted model to report yet. Press Run." : running ? "Wait until the work ends, or cancel it." : null;
    return html`<${Button} icon="report" label="Report" why=${why} title="Write the report" onClick=${() => start("report", {}, "Write the report")} />`;
  }
  return html`
    <${Button} icon=${report.outdated ? "warn" : "report"} label="Report" busy=${busy} kind=${report.outdated ? "outdated" : ""}
      title=${report.outdated ? `Outdated: ${report.outdated}` : "Download the report"} onClick=${() => download("report.html")} />`;
}

export function Header() {
  const [name, history] = [useStore((s) => s.study?.name), useStore((s) => s.study?.history)];
  const [undoing, redoing, theme] = [useStore((s) => s.busy.has("undo")), useStore((s) => s.busy.has("redo")), useTheme()];
  return html`
    <header class="ui-header">
      <div class="ui-name" title=${name || ""}><img src="/static/icon.svg" alt="" width="22" height="22" /><h1>${name || "frictrack"}</h1></div>
      <${TabList} />
      <div class="ui-actions">
        <${Button} icon="undo" label="Undo" busy=${undoing} onClick=${undo} kind="quiet"
          why=${history?.can_undo ? null : "Nothing to undo"} title=${`${history?.undo_words || "Undo"} (Ctrl+Z)`} />
        <${Button} icon="redo" label="Redo" busy=${redoing} onClick=${redo} kind="quiet"
          why=${history?.can_redo ? null : "Nothing to redo"} title=${`${history?.redo_words || "Redo"} (Ctrl+Shift+Z)`} />
        <${RunButton} />
        <${ReportButton} />
        <${Button} icon=${theme === "dark" ? "light" : "dark"} iconOnly kind="quiet" onClick=${toggleTheme}
          label=${theme === "dark" ? "Light colours" : "Dark colours"} />
        <${Button} icon="help" iconOnly kind="quiet" label="Keyboard shortcuts (?)" onClick=${() => update({ dialog: { kind: "help" } })} />
      </div>
    </header>`;
}
